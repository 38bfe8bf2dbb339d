"""What the robot's newest reports forbid, each danger by itself: its cause, and from when and how long it counts."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from firmware_bridge.core.dangers import NO_BATTERY, NO_STATE, DangerWatch, is_driven, is_moving
from firmware_bridge.core.robot_state import BatteryState, RobotState, reported_code
from firmware_bridge.core.step_types import Inputs, Report
from tests.support.robot.bridge_bench import MS, SAFETY, STILL, TABLE

T0 = 10**12
S = 1000 * MS
TIMEOUT_NS = 700 * MS


def at(now_ns: int = T0, **changes: object) -> RobotState:
    return replace(STILL, received_ns=now_ns, **changes)  # type: ignore[arg-type]


def watch(report: Report | None = None, *, estop: bool = False, **safety: object) -> DangerWatch:
    """A watch that has taken one report at T0: by default that of a robot that stands."""
    made = DangerWatch(replace(SAFETY, **safety), TABLE, TIMEOUT_NS)  # type: ignore[arg-type]
    made.note(Inputs(robot=Report(state=at()) if report is None else report, estop=estop), T0)
    return made


def cause(made: DangerWatch, after_ns: int = 0) -> str:
    danger = made.danger(T0 + after_ns)
    return "none" if danger is None else danger[0]


@pytest.mark.parametrize(
    ("codes", "accepted", "reported"),
    [
        ((), (0,), 0),
        ((), (), 0),
        ((3, 4), (0,), 3),
        ((3, 4), (0, 3), 4),
        ((3, 4, 5), (3, 5), 4),
        ((3, 4), (3, 4), 3),
    ],
)
def test_an_accepted_error_code_hides_no_other_one(
    codes: tuple[int, ...], accepted: tuple[int, ...], reported: int
) -> None:
    assert reported_code(codes, accepted) == reported


def test_a_standing_robot_is_no_danger_and_neither_is_none() -> None:
    assert cause(watch()) == cause(watch(Report())) == "none"
    assert DangerWatch(SAFETY, TABLE, TIMEOUT_NS).danger(T0) is None


@pytest.mark.parametrize(
    ("report", "expected", "lasts_ns"),
    [
        (Report(remote_estop=True), "estop", S),
        (Report(remote_in_use=True), "remote_takeover", S),
        (Report(foreign="sport 1008"), "second_commander", 2 * S),
        (Report(denied="Move"), "second_commander", 2 * S),
    ],
)
def test_a_persons_or_another_clients_act_counts_for_a_time(report: Report, expected: str, lasts_ns: int) -> None:
    made = watch(report)
    made.note(Inputs(), T0 + 1)  # it is over
    assert [cause(made, after_ns) for after_ns in (0, lasts_ns - 1, lasts_ns)] == [expected, expected, "none"]


@pytest.mark.parametrize(
    ("inputs", "expected"),
    [
        (Inputs(estop=True), "estop"),
        (Inputs(robot=Report(publishers="2 of rt/x")), "second_publisher"),
        (Inputs(robot=Report(writes_fail=True)), "link_down"),
        (Inputs(robot=Report(unsafe="no failsafe")), "unsafe_robot"),
    ],
)
def test_a_condition_counts_as_long_as_it_is_reported(inputs: Inputs, expected: str) -> None:
    made = watch()
    made.note(inputs, T0)
    assert cause(made) == expected
    made.note(Inputs(), T0)
    assert cause(made) == "none"


@pytest.mark.parametrize(
    ("report", "word"),
    [
        (Report(foreign="sport 1008"), "sport 1008"),
        (Report(denied="Move", foreign="sport 1008"), "denies Move"),
        (Report(publishers="2 of rt/x"), "2 of rt/x"),
        (Report(unsafe="no failsafe"), "no failsafe"),
        (Report(state=at(roll_rad=1.0, pitch_rad=-0.5)), "roll 57, pitch -29"),
        (Report(state=at(error_code=7)), "error 7"),
    ],
)
def test_the_reason_names_what_was_found(report: Report, word: str) -> None:
    danger = watch(report).danger(T0)
    assert danger is not None and word in danger[1]


@pytest.mark.parametrize("axis", ["roll_rad", "pitch_rad"])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_robot_is_tipped_beyond_30_degrees_to_any_side(axis: str, sign: int) -> None:
    assert cause(watch(Report(state=at(**{axis: sign * math.radians(30.0)})))) == "none"
    assert cause(watch(Report(state=at(**{axis: sign * math.radians(30.001)})))) == "tipped"


def test_only_the_error_codes_of_the_robot_file_are_accepted() -> None:
    assert cause(watch(Report(state=at(error_code=7)))) == "robot_error"
    assert cause(watch(Report(state=at(error_code=7)), accepted_error_codes=(0, 7))) == "none"


@pytest.mark.parametrize("change", [{"roll_rad": 1.0}, {"error_code": 7}])
def test_a_report_older_than_the_timeout_proves_nothing(change: dict[str, object]) -> None:
    made = watch(Report(state=at(**change)))
    assert cause(made, TIMEOUT_NS) != "none" and cause(made, TIMEOUT_NS + 1) == "none"


class TestObstacle:
    """What else forbids arming."""

    def armable(self, percent: int | None = 80, **safety: object) -> DangerWatch:
        battery = None if percent is None else BatteryState(T0, percent, 29.0, 1.0)
        return watch(Report(state=at(), battery=battery), **safety)

    def test_nothing_with_a_fresh_report_and_a_full_battery(self) -> None:
        assert self.armable().obstacle(T0) is None

    def test_no_report_or_one_older_than_the_timeout(self) -> None:
        assert DangerWatch(SAFETY, TABLE, TIMEOUT_NS).obstacle(T0) == NO_STATE
        assert self.armable().obstacle(T0 + TIMEOUT_NS) is None
        assert self.armable().obstacle(T0 + TIMEOUT_NS + 1) == NO_STATE

    def test_no_battery_report_or_one_older_than_ten_seconds(self) -> None:
        made = self.armable()
        for after_ns, expected in ((10 * S, None), (10 * S + 1, NO_BATTERY)):
            made.note(Inputs(robot=Report(state=at(T0 + after_ns))), T0 + after_ns)
            assert made.obstacle(T0 + after_ns) == expected
        assert self.armable(None).obstacle(T0) == NO_BATTERY

    def test_less_charge_than_the_robot_file_requires(self) -> None:
        assert self.armable(10).obstacle(T0) is None
        low = self.armable(9).obstacle(T0)
        assert low is not None and low[0] == "battery_low" and "9 %" in low[1] and "10 %" in low[1]

    def test_no_charge_at_all_where_the_robot_file_requires_none(self) -> None:
        assert self.armable(None, battery_min_percent=0).obstacle(T0) is None
        assert self.armable(0, battery_min_percent=0).obstacle(T0) is None

    def test_one_percent_is_a_requirement_too(self) -> None:
        assert self.armable(None, battery_min_percent=1).obstacle(T0) == NO_BATTERY

    def test_another_version_than_the_robot_files(self) -> None:
        made = self.armable()
        made.note(Inputs(robot=Report(version="9.9")), T0)
        other = made.obstacle(T0)
        assert other is not None and other[0] == "wrong_robot" and "is 9.9" in other[1]
        made.note(Inputs(robot=Report(version=TABLE.version)), T0)
        made.note(Inputs(), T0)  # the answer stays
        assert made.obstacle(T0) is None and made.version == TABLE.version


class TestMotion:
    def test_the_robot_moves_from_5_cm_a_second_or_a_fifth_of_a_radian_in_any_direction(self) -> None:
        for moving in ({"vx_mps": 0.05}, {"vy_mps": -0.05}, {"vx_mps": 0.04, "vy_mps": 0.04}, {"wz_radps": -0.2}):
            assert is_moving(at(**moving)) and is_driven(at(**moving), TABLE)
        for still in ({"vx_mps": 0.0499}, {"vx_mps": 0.03, "vy_mps": 0.03}, {"wz_radps": 0.1999}):
            assert not is_moving(at(**still)) and not is_driven(at(**still), TABLE)
        assert all(is_driven(at(mode=mode), TABLE) for mode in TABLE.moving_modes)

    def test_it_has_moved_lately_for_half_a_second(self) -> None:
        made = watch(Report(state=at(vx_mps=0.1)))
        made.note(Inputs(robot=Report(state=at())), T0 + 1)
        assert made.moved_lately(T0 + 500 * MS - 1) and not made.moved_lately(T0 + 500 * MS)
        assert not watch().moved_lately(T0)

    def test_a_report_older_than_200_ms_says_nothing_about_motion(self) -> None:
        made = watch(Report(state=at(vx_mps=0.3, vy_mps=0.4)))
        assert made.motion(T0 + 200 * MS) == ("moving", 0.5)
        assert made.motion(T0 + 200 * MS + 1) == ("unknown", -1.0)
        assert DangerWatch(SAFETY, TABLE, TIMEOUT_NS).motion(T0) == ("unknown", -1.0)

    def test_a_report_counts_only_if_it_came_after_the_stop(self) -> None:
        assert watch().motion(T0, T0 - 1)[0] == "still"
        assert watch().motion(T0, T0) == ("unknown", -1.0)

    def test_the_robot_is_still_200_ms_after_its_last_moving_report(self) -> None:
        made = watch(Report(state=at(vx_mps=0.1)))
        for after_ns, expected in ((200 * MS - 1, "moving"), (200 * MS, "still")):
            made.note(Inputs(robot=Report(state=at(T0 + after_ns))), T0 + after_ns)
            assert made.motion(T0 + after_ns) == (expected, 0.0)

    def test_a_still_report_is_not_believed_beside_a_second_publisher_a_moving_one_is(self) -> None:
        assert watch(Report(state=at(), publishers="2 of x")).motion(T0) == ("unknown", 0.0)
        assert watch(Report(state=at(vx_mps=0.1), publishers="2 of x")).motion(T0)[0] == "moving"


def test_the_instant_of_the_first_report_is_kept() -> None:
    made = DangerWatch(SAFETY, TABLE, TIMEOUT_NS)
    made.note(Inputs(), T0)
    assert made.first_report_ns is None
    for now_ns in (T0 + 1, T0 + 2):
        made.note(Inputs(robot=Report(state=at(now_ns))), now_ns)
    assert made.first_report_ns == T0 + 1 and made.robot == at(T0 + 2)
