"""What forbids motion, on a fake clock: what stops an armed robot, keeps it stopped, and refuses to arm it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import pytest

from firmware_bridge.core.link import Arm, Stop, Velocity
from firmware_bridge.core.step_types import Move, StopMotion
from firmware_bridge.unitree.messages import ids
from tests.support.robot.bridge_bench import MS, SAFETY, ZERO, Bench

STOP_MOVE = StopMotion()


def _foreign(bench: Bench) -> None:
    bench.step(foreign="sport 1008")


def _stick(bench: Bench) -> None:
    bench.step(remote_in_use=True)


def _remote_estop(bench: Bench) -> None:
    bench.step(remote_in_use=True, remote_estop=True)


def _local_estop(bench: Bench) -> None:
    bench.estop = True
    bench.step()


def _operator(bench: Bench) -> None:
    bench.step(operator=(Stop(),))


def _robot_reports(**state: float) -> Callable[[Bench], None]:
    def danger(bench: Bench) -> None:
        bench.robot = state
        bench.step()

    return danger


DANGERS = [
    (_foreign, "second_commander"),
    (_stick, "remote_takeover"),
    (_remote_estop, "estop"),
    (_local_estop, "estop"),
    (_operator, "estop"),
    (_robot_reports(pitch_rad=math.radians(31)), "tipped"),
    (_robot_reports(roll_rad=math.radians(-31)), "tipped"),
    (_robot_reports(error_code=17), "robot_error"),
    (lambda bench: bench.step(writes_fail=True), "link_down"),
    (lambda bench: bench.step(denied="StopMove"), "second_commander"),
    (lambda bench: bench.step(publishers="2 publishers of rt/sportmodestate"), "second_publisher"),
]
PRESSES = (_local_estop, _operator)  # at this computer
LATCHING = (_remote_estop, *PRESSES)


@pytest.mark.parametrize(("danger", "cause"), DANGERS)
class TestEveryDanger:
    def test_it_stops_a_driven_robot_in_the_same_step(self, danger, cause: str) -> None:
        bench = Bench().arm()
        bench.drive(500)
        bench.written.clear()
        danger(bench)
        assert bench.written == [(bench.now_ns, ZERO), (bench.now_ns, StopMotion(pressed=danger in PRESSES))]
        assert (bench.status.state, bench.status.cause) == ("stopped", cause)

    def test_it_refuses_to_arm_and_sends_nothing_but_a_press(self, danger, cause: str) -> None:
        bench = Bench()
        danger(bench)
        assert bench.status.blocked_by == cause
        bench.step(Arm())
        danger(bench)
        latched = danger in LATCHING
        assert (bench.status.state, bench.status.cause) == ("disarmed", "operator" if latched else cause)
        assert bench.status.reason.startswith("arm refused: ")
        sent = [ZERO, StopMotion(pressed=True)] if danger in PRESSES else []
        assert [request for _, request in bench.written] == sent

    def test_a_command_in_the_same_step_does_not_pass(self, danger, cause: str) -> None:
        bench = Bench().arm()
        bench.drive(500)
        danger(bench)
        bench.written.clear()
        bench.drive(1000)
        assert set(bench.moves()) <= {ZERO}

    def test_a_refused_arm_is_reported_as_arming_first(self, danger, cause: str) -> None:
        """A runner that asked must be able to tell a refusal from the state before it asked."""
        bench = Bench()
        danger(bench)
        assert bench.step(Arm()).status.state == ("disarmed" if danger in LATCHING else "arming")


def test_an_armed_robot_is_not_blocked() -> None:
    assert Bench().arm().status.blocked_by == "none"


def test_a_silent_robot_blocks_arming() -> None:
    bench = Bench(mode=None)
    bench.step()
    assert bench.status.blocked_by == "state_silent"


class TestBattery:
    def test_below_the_minimum_arming_is_refused(self) -> None:
        bench = Bench()
        bench.battery = 9
        bench.step()
        bench.ask_to_arm()
        assert (bench.status.state, bench.status.cause) == ("disarmed", "battery_low")
        assert bench.status.reason == "arm refused: the battery has 9 %, at least 10 % are needed"

    def test_at_the_minimum_it_arms(self) -> None:
        Bench(battery=10).arm()

    def test_without_a_report_it_is_not_armed(self) -> None:
        bench = Bench(battery=None)
        bench.ask_to_arm()
        assert bench.status.blocked_by == "battery_low"
        bench.wait(10_100)
        assert bench.status.reason == "arm refused: no battery report after 10 s"
        assert bench.written == []

    def test_a_first_report_that_comes_a_little_late_is_waited_for(self) -> None:
        bench = Bench(battery=None)
        bench.ask_to_arm()
        bench.wait(900)
        bench.battery = 80
        bench.step()
        bench.wait(100)
        assert bench.status.state == "armed"

    def test_an_old_report_is_none(self) -> None:
        bench = Bench()
        bench.step()
        bench.battery = None
        bench.wait(9_900)
        assert bench.status.blocked_by == "none"
        bench.wait(200)
        assert bench.status.blocked_by == "battery_low"

    def test_a_robot_file_without_a_minimum_charge_needs_no_battery_report(self) -> None:
        Bench(battery=None, safety=replace(SAFETY, battery_min_percent=0)).arm()

    def test_it_does_not_end_a_drive(self) -> None:
        bench = Bench().arm()
        bench.command()
        bench.battery = 3
        bench.step()
        assert bench.status.state == "armed"


class TestIdentity:
    def test_another_robot_is_refused_before_anything_moves(self) -> None:
        bench = Bench(mode=ids.MODE_LIE_DOWN, version="1.0.0.9")
        bench.ask_to_arm()
        assert (bench.status.state, bench.status.cause) == ("disarmed", "wrong_robot")
        assert bench.written == []

    def test_a_robot_without_an_identity_is_not_armed(self) -> None:
        bench = Bench(version=None)
        bench.step(Arm())
        bench.wait(10_100)
        assert bench.status.reason == "arm refused: the robot's sport service does not answer after 10 s"
        assert bench.written == []

    def test_its_identity_is_requested_at_every_arming(self) -> None:
        bench = Bench().arm()
        bench.step(Stop())
        bench.version = "1.0.0.9"
        bench.ask_to_arm()
        assert bench.status.cause == "wrong_robot"


@pytest.mark.parametrize(
    ("danger", "cause", "quiet_ms"), [(_foreign, "second_commander", 2000), (_stick, "remote_takeover", 1000)]
)
def test_arming_is_refused_until_the_other_commander_has_been_quiet(danger, cause: str, quiet_ms: int) -> None:
    bench = Bench().arm()
    danger(bench)
    bench.wait(quiet_ms - 100)
    bench.ask_to_arm()
    assert (bench.status.state, bench.status.cause) == ("stopped", cause)
    bench.wait(200)
    bench.arm()


class TestSecondCommander:
    def test_other_commanders_of_a_disarmed_robot_are_ignored(self) -> None:
        bench = Bench()
        for _ in range(50):
            bench.step(foreign="sport 1008")
            bench.wait(20)
        assert bench.written == []


class TestRemote:
    def test_sticks_never_end_the_zeros(self) -> None:
        """Stick messages are not authenticated: a forged one must not silence the bridge."""
        bench = Bench().arm()
        bench.drive(500)
        _stick(bench)
        bench.written.clear()
        for _ in range(100):
            _stick(bench)
            bench.wait(20)
        assert set(bench.moves()) == {ZERO} and len(bench.moves()) == pytest.approx(100, abs=3)

    def test_an_untouched_remote_changes_nothing(self) -> None:
        bench = Bench().arm()
        bench.step(remote_in_use=False)
        assert bench.status.state == "armed"


class TestStopAgain:
    def test_a_robot_that_goes_on_moving_is_stopped_again_until_it_has_been_still_for_half_a_second(self) -> None:
        bench = Bench().arm()
        bench.robot = {"vx_mps": 0.5}
        bench.drive(500)
        bench.step(Stop())
        bench.written.clear()
        bench.wait(1000)
        assert bench.calls().count(ids.STOP_MOVE) == pytest.approx(10, abs=1)
        bench.robot = {"vx_mps": 0.049}
        bench.wait(600)
        bench.written.clear()
        bench.wait(2000)
        assert bench.calls() == []
        assert len(bench.moves()) == pytest.approx(100, abs=3)

    @pytest.mark.parametrize("motion", [{"vx_mps": -0.06}, {"vy_mps": 0.06}, {"wz_radps": 0.3}])
    def test_motion_seen_long_after_the_stop_is_answered_too(self, motion: dict[str, object]) -> None:
        bench = Bench().arm()
        bench.step(Stop())
        bench.wait(5000)
        bench.robot, bench.mode = motion, ids.MODE_LOCOMOTION
        bench.written.clear()
        bench.wait(40)
        assert STOP_MOVE in [request for _, request in bench.written]

    def test_a_late_move_is_followed_by_a_zero_within_40_ms_whenever_it_comes(self) -> None:
        bench = Bench().arm()
        bench.drive(500)
        bench.step(Stop())
        bench.wait(10_000)
        zeros = [t for t, request in bench.written if request == ZERO and t > bench.now_ns - 9_900 * MS]
        gaps = [later - earlier for earlier, later in pairwise(zeros)]
        assert max(gaps) <= 40 * MS


class TestFoundMoving:
    """A fresh bridge; its predecessor may have died while driving."""

    @pytest.mark.parametrize("motion", [{"vx_mps": 0.3}, {"wz_radps": 0.5}, {}])
    def test_a_moving_robot_is_stopped_before_anything_else(self, motion: dict[str, object]) -> None:
        bench = Bench(mode=ids.MODE_BALANCE_STAND if motion else ids.MODE_LOCOMOTION, client=False, robot=motion)
        bench.step()
        assert [request for _, request in bench.written] == [ZERO, STOP_MOVE]
        assert (bench.status.state, bench.status.cause) == ("stopped", "robot_moving")

    def test_it_is_not_armed_before_it_stands_still(self) -> None:
        bench = Bench(robot={"vx_mps": 0.3})
        bench.ask_to_arm()
        bench.wait(2000)
        assert bench.status.state == "arming" and set(bench.calls()) == {ids.STOP_MOVE}
        bench.robot = {}
        bench.wait(40)
        assert bench.status.state == "armed"

    def test_the_swaying_of_a_robot_that_gets_up_is_no_reason_to_interrupt_it(self) -> None:
        bench = Bench(mode=ids.MODE_LIE_DOWN)
        bench.wait(1100)
        bench.ask_to_arm()
        bench.robot = {"vx_mps": 0.2}
        bench.wait(1000)
        assert bench.calls() == [ids.STAND_UP]

    def test_zeros_go_on(self) -> None:
        bench = Bench(client=False, robot={"vx_mps": 0.3})
        bench.wait(1000)
        assert set(bench.moves()) == {ZERO} and len(bench.moves()) == pytest.approx(50, abs=2)

    def test_a_stick_message_does_not_prevent_it(self) -> None:
        bench = Bench(client=False, robot={"vx_mps": 0.3})
        bench.step(remote_in_use=True)
        assert [request for _, request in bench.written] == [ZERO, STOP_MOVE]

    def test_a_robot_that_begins_to_move_later_is_left_to_its_commander(self) -> None:
        bench = Bench(client=False)
        bench.wait(1100)
        bench.robot = {"vx_mps": 0.3}
        bench.wait(1000)
        assert bench.written == []


def test_a_suspended_machine_wakes_up_stopped() -> None:
    bench = Bench().arm()
    bench.drive(500)
    bench.asleep_ns += 3_000 * MS
    bench.command()
    assert (bench.status.state, bench.status.cause) == ("stopped", "suspended")


def test_a_stalled_bridge_stops_before_it_reads_queued_commands() -> None:
    bench = Bench().arm()
    bench.drive(500)
    bench.now_ns += 2_000 * MS
    queued = [Velocity(1000 + i, bench.now_ns - (20 - i) * 100 * MS, 0.5, 0.0, 0.0) for i in range(21)]
    bench.written.clear()
    bench.step(*queued)
    bench.drive(500)
    assert set(bench.moves()) == {ZERO}
    assert bench.status.cause == "deadman"


def test_without_the_robots_state_zero_goes_out_after_the_deadmans_time_and_the_state_is_not_latched() -> None:
    bench = Bench().arm()
    bench.drive(1000)
    mode, bench.mode = bench.mode, None
    bench.drive(300)
    assert bench.moves()[-1] == ZERO and bench.status.state == "armed"
    bench.mode = mode
    bench.drive(1000)
    assert bench.moves()[-1].vx_mps == 0.5


def test_a_command_beyond_the_limits_is_clipped_and_counted() -> None:
    bench = Bench().arm()
    bench.drive(1000, vx=10.0)
    assert bench.moves()[-1] == Move(0.8, 0.0, 0.0)
    assert bench.core.clipped == 10
