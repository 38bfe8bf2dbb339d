"""Recoveries: a robot that is stuck backs off along its own trail; one that stands turns to where its text leads."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import hypot, pi

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from edge.core.geometry import SE2, wrap_angle
from edge.motion.controller import VelocityCommand
from edge.motion.recovery import BACKING_OFF, TURNING, BackOff, BackOffConfig, StandstillConfig, StandstillTurn
from edge.state.semantic import waypoints_now

BACK = BackOffConfig(vx_min_mps=-0.4, wz_max_radps=1.0)
TURN = StandstillConfig(wz_max_radps=1.0)
TICK_NS = 100_000_000
DRIVES = VelocityCommand(0.4, 0.0, 0.0, SE2(0.4, 0.0, 0.0), "ok")
CURVES = VelocityCommand(0.3, 0.0, 0.6, SE2(0.3, 0.1, 0.6), "ok")
STANDS = VelocityCommand(0.0, 0.0, 0.0, SE2(0.01, 0.0, 0.0), "ok")
THINKS = VelocityCommand(0.0, 0.0, 0.0, None, "reasoning")
LEFT = ((0.0, 2.0), (0.0, 4.0), (0.0, 6.0))
AHEAD = ((2.0, 0.1), (4.0, 0.2), (6.0, 0.3))
Points = tuple[tuple[float, float], ...]
Moves = Callable[[SE2, VelocityCommand], SE2]


def glide(pose: SE2, command: VelocityCommand) -> SE2:
    """Nothing holds the robot."""
    return pose @ SE2(command.vx_mps * 0.1, 0.0, command.wz_radps * 0.1)


def wall_at(x_m: float) -> Moves:
    """A wall across the way holds the robot, and keeps it from turning."""
    return lambda pose, command: pose if glide(pose, command).x_m > x_m and command.vx_mps > 0 else glide(pose, command)


def corner(pose: SE2, command: VelocityCommand) -> SE2:
    return pose if pose.y_m > 0.25 and command.vx_mps > 0 else glide(pose, command)


def jammed(pose: SE2, _command: VelocityCommand) -> SE2:
    return pose


class Run:
    """Ticks of a robot that does as it is commanded, as far as `moves` lets it; its text was read at the first pose."""

    def __init__(
        self, recovery: BackOff | StandstillTurn, moves: Moves = glide, waypoints: Points | None = None
    ) -> None:
        self.recovery, self.moves, self.waypoints = recovery, moves, waypoints
        self.pose, self.ticks = SE2(0.0, 0.0, 0.0), 0
        self.commands: list[VelocityCommand] = []
        self.poses = [self.pose]

    def go(self, ticks: int, wanted: VelocityCommand = DRIVES, speed_scale: float = 1.0) -> VelocityCommand:
        for _ in range(ticks):
            now_ns = self.ticks * TICK_NS
            if isinstance(self.recovery, BackOff):
                command = self.recovery.step(wanted, self.pose, now_ns, speed_scale)
            else:
                ahead = None if self.waypoints is None else waypoints_now(self.waypoints, self.pose)[0]
                command = self.recovery.step(wanted, ahead, self.pose, now_ns, speed_scale)
            self.pose = self.moves(self.pose, command)
            self.ticks += 1
            self.commands.append(command)
            self.poses.append(self.pose)
        return command

    @property
    def reasons(self) -> list[str]:
        return [command.reason for command in self.commands]

    def began(self) -> list[int]:
        """Ticks at which a recovery begins."""
        reasons = self.reasons
        return [k for k in range(1, len(reasons)) if reasons[k - 1] == "ok" != reasons[k]]

    def backed_m(self) -> list[float]:
        """Distance of every drive back."""
        reasons = [*self.reasons, "ok"]
        ends = [next(k for k in range(start, len(reasons)) if reasons[k] == "ok") for start in self.began()]
        poses = [(self.poses[start], self.poses[end]) for start, end in zip(self.began(), ends, strict=True)]
        return [hypot(b.x_m - a.x_m, b.y_m - a.y_m) for a, b in poses]


# Back off


def stuck(config: BackOffConfig = BACK, wanted: VelocityCommand = DRIVES, moves: Moves | None = None) -> Run:
    """Driven a metre and then held at a wall, up to the first tick of the drive back."""
    run = Run(BackOff(config), moves or wall_at(1.0))
    while BACKING_OFF not in run.reasons and run.ticks < 200:
        run.go(1, wanted)
    return run


def test_after_two_seconds_at_the_wall_it_goes_back_slowly_about_as_far_as_configured() -> None:
    run = stuck()
    first = run.began()[0]
    stood = sum(pose.x_m == run.poses[first].x_m for pose in run.poses[: first + 1])
    assert 14 <= stood <= 50 and set(run.reasons[:first]) == {"ok"}
    while run.reasons[-1] == BACKING_OFF:
        assert run.go(1).vx_mps >= (-0.2 if run.reasons[-1] == BACKING_OFF else 0.0)
    assert run.poses[first].x_m - min(pose.x_m for pose in run.poses[first:]) == pytest.approx(0.3, abs=0.05)


def test_it_goes_back_through_the_poses_that_it_came_by() -> None:
    run = stuck(wanted=CURVES, moves=corner)
    came, start = run.poses[:-1], run.poses[-2]
    while run.reasons[-1] == BACKING_OFF:
        run.go(1, CURVES)
        gaps = [
            (hypot(p.x_m - run.pose.x_m, p.y_m - run.pose.y_m), abs(p.theta_rad - run.pose.theta_rad)) for p in came
        ]
        assert any(gap_m < 0.08 and turned < 0.25 for gap_m, turned in gaps)
    assert run.poses[-2].theta_rad < start.theta_rad - 0.2


TURNS = VelocityCommand(0.0, 0.0, 0.5, SE2(-0.4, 0.01, pi), "ok")


@pytest.mark.parametrize("since_m", [0.0, 0.1, 0.2, 0.6])
def test_after_a_turn_about_it_neither_turns_back_nor_reverses_the_way_it_first_came(since_m: float) -> None:
    run = Run(BackOff(BACK))
    run.go(50)
    while abs(run.pose.theta_rad) < pi - 0.05:
        run.go(1, TURNS)
    turned = run.pose
    run.moves = lambda pose, command: (
        pose if command.vx_mps and glide(pose, command).x_m < 2.0 - since_m else glide(pose, command)
    )
    run.go(600)
    assert max(abs(wrap_angle(pose.theta_rad - turned.theta_rad)) for pose in run.poses[-600:]) < 0.1
    assert max(pose.x_m for pose in run.poses[-600:]) <= 2.0 + 0.03
    assert (BACKING_OFF in run.reasons) == (since_m > 0.0)


def only_back(pose: SE2, command: VelocityCommand) -> SE2:
    return pose if command.vx_mps > 0 else glide(pose, command)


@pytest.mark.parametrize("moves", [jammed, only_back])
def test_it_backs_off_only_along_its_own_path(moves: Moves) -> None:
    run = Run(BackOff(BACK), moves)
    run.go(200)
    assert run.pose == SE2(0.0, 0.0, 0.0)


@given(st.floats(0.05, 0.8), st.floats(-0.24, 0.24), st.floats(0.3, 1.0))
def test_a_robot_that_makes_progress_is_never_sent_back(speed_mps: float, turn_share: float, slip: float) -> None:
    run = Run(BackOff(BACK), lambda pose, c: pose @ SE2(slip * c.vx_mps * 0.1, 0.0, c.wz_radps * 0.1))
    run.go(100, VelocityCommand(speed_mps, 0.0, turn_share * speed_mps, SE2(speed_mps, 0.0, 0.0), "ok"))
    assert set(run.reasons) == {"ok"}


@given(st.integers(1, 6), st.floats(0.3, 1.0))
def test_a_robot_that_turns_to_and_fro_on_the_spot_is_not_stuck(ticks: int, wz_radps: float) -> None:
    run = Run(BackOff(BACK))
    for turn in range(60):
        run.go(ticks, VelocityCommand(0.0, 0.0, wz_radps * (-1) ** turn, SE2(0.0, 0.0, 0.3), "ok"))
    assert set(run.reasons) == {"ok"}


@pytest.mark.parametrize("command", [THINKS, replace(THINKS, reason="stale-frame"), STANDS], ids=lambda c: c.reason)
def test_a_forced_zero_and_a_plan_to_stand_end_a_drive_back_at_once(command: VelocityCommand) -> None:
    assert stuck().go(1, command) is command


def test_where_it_cannot_go_back_either_it_gives_up_in_a_second_and_tries_three_times_at_one_place() -> None:
    run = Run(BackOff(BACK), wall_at(1.0))
    run.go(30)
    run.moves = jammed
    run.go(600)
    assert len(run.began()) == 3 and run.reasons.count(BACKING_OFF) <= 3 * 11
    run.moves = glide
    run.go(100)
    assert len(run.began()) == 3 and run.pose.x_m > 4.0


def test_stuck_again_at_one_place_it_goes_further_back_and_elsewhere_as_at_first() -> None:
    run = Run(BackOff(BACK), wall_at(2.0))
    run.go(900)
    assert run.backed_m()[:5] == pytest.approx([0.3, 0.6, 0.9, 0.9, 0.9], abs=0.05)
    run.moves, before = wall_at(5.0), len(run.backed_m())
    run.go(300)
    assert run.backed_m()[before] == pytest.approx(0.3, abs=0.05)


def held(moves: Moves, reason: str = "odometry-frozen") -> Run:
    """A robot that has driven 1 m and was then stopped for a second because its pose stayed."""
    run = Run(BackOff(BACK), moves)
    run.go(25)
    run.go(10, replace(STANDS, reason=reason))
    return run


@pytest.mark.parametrize("reason", ["odometry-frozen", "robot-blocked"])
def test_after_a_stop_because_its_pose_stayed_it_goes_back_first(reason: str) -> None:
    run = held(wall_at(1.0), reason)
    assert run.go(1).reason == BACKING_OFF
    run.go(40)
    assert run.backed_m()[0] == pytest.approx(0.3, abs=0.03)


def test_after_another_stop_it_drives_on() -> None:
    assert held(glide, "camera-stale").go(1).reason == "ok"


def test_a_robot_that_has_moved_away_since_such_a_stop_drives_on() -> None:
    run = held(glide)
    run.pose = run.pose @ SE2(0.2, 0.0, 0.0)
    assert run.go(1).reason == "ok"


def test_a_robot_that_has_turned_away_since_such_a_stop_drives_on() -> None:
    run = held(glide)
    run.pose = run.pose @ SE2(0.0, 0.0, 1.2)
    assert run.go(1).reason == "ok"


def test_such_a_stop_long_ago_is_forgotten() -> None:
    run = held(glide)
    run.go(101, replace(STANDS, reason="arrived"))
    assert run.go(1).reason == "ok"


@pytest.mark.parametrize(("stood_s", "backs_off"), [(20, True), (40, False)])
def test_a_trail_older_than_half_a_minute_is_not_driven_back_on(stood_s: int, backs_off: bool) -> None:
    run = Run(BackOff(BACK), wall_at(0.4))
    run.go(10)
    run.go(stood_s * 10, replace(STANDS, reason="arrived"))
    run.go(60)
    assert (BACKING_OFF in run.reasons) is backs_off


def test_stopped_so_again_and_again_it_gives_up_after_three_drives_back() -> None:
    run = held(glide)
    run.moves = jammed
    for _ in range(5):
        run.go(15)
        run.go(10, replace(STANDS, reason="odometry-frozen"))
    began = [k for k, reason in enumerate(run.reasons) if reason == BACKING_OFF != run.reasons[k - 1]]
    assert len(began) == 3 and run.reasons.count(BACKING_OFF) <= 3 * 11


@given(st.floats(0.01, 1.0), st.floats(-0.8, -0.01), st.floats(0.01, 1.0))
def test_a_drive_back_never_leaves_the_robot_files_limits(
    wz_max_radps: float, vx_min_mps: float, speed_scale: float
) -> None:
    run = Run(BackOff(replace(BACK, wz_max_radps=wz_max_radps, vx_min_mps=vx_min_mps)), corner)
    for _ in range(120):
        command = run.go(1, CURVES, speed_scale)
        if command.reason == BACKING_OFF:
            assert max(vx_min_mps, -BACK.speed_mps) * speed_scale <= command.vx_mps <= 0.0
            assert abs(command.wz_radps) <= wz_max_radps * speed_scale
    assert BACKING_OFF in run.reasons


def test_a_robot_that_may_not_reverse_never_does() -> None:
    assert set(stuck(replace(BACK, vx_min_mps=0.0)).reasons) == {"ok"}


# Turn at a standstill


def standing(waypoints: Points | None = LEFT, config: StandstillConfig = TURN, moves: Moves = glide) -> Run:
    return Run(StandstillTurn(config), moves, waypoints)


def test_it_stands_for_five_seconds_and_then_turns_to_where_its_text_leads() -> None:
    run = standing()
    run.go(100, STANDS)
    assert run.began() == [50] and run.reasons[-1] == "ok"
    assert run.pose.theta_rad == pytest.approx(pi / 2, abs=0.16)


@given(st.floats(-3.1, 3.1), st.floats(0.3, 1.0))
def test_it_turns_the_short_way_within_the_limits(bearing_rad: float, wz_max_radps: float) -> None:
    assume(abs(abs(bearing_rad) - TURN.aside_rad) > 1e-4)  # waypoints are float32
    far = tuple((r * np.cos(bearing_rad), r * np.sin(bearing_rad)) for r in (2.0, 4.0, 6.0))
    run = standing(far, StandstillConfig(wz_max_radps=wz_max_radps))
    run.go(80, STANDS, speed_scale=0.5)
    turned = [command.wz_radps for command in run.commands if command.reason == TURNING]
    assert all(abs(rate) <= min(0.5, wz_max_radps) * 0.5 and rate * bearing_rad >= 0 for rate in turned)
    assert bool(turned) == (abs(bearing_rad) >= TURN.aside_rad)


@pytest.mark.parametrize(
    ("waypoints", "target"),
    [
        *((waypoints, STANDS.target) for waypoints in (None, AHEAD, ((0.0, 0.9),) * 3, ((0.0, 0.0), (0.0, 1.4)))),
        *((LEFT, target) for target in (SE2(0.3, 0.0, 0.0), SE2(0.0, 0.0, 0.4), SE2(-0.3, 0.0, 0.0))),
    ],
)
def test_a_text_that_leads_ahead_or_stops_and_a_plan_that_moves_leave_it_standing(
    waypoints: Points | None, target: SE2
) -> None:
    run = standing(waypoints)
    run.go(300, replace(STANDS, target=target))
    assert set(run.reasons) == {"ok"}


@pytest.mark.parametrize(
    ("wanted", "waypoints"),
    [(THINKS, LEFT), (replace(STANDS, target=SE2(0.6, 0.0, 0.0)), LEFT), (STANDS, ((0.0, 0.0),) * 3)],
    ids=["a forced zero", "a plan that drives, though the robot has yet to speed up", "a text to stop"],
)
def test_what_ends_a_turn(wanted: VelocityCommand, waypoints: Points) -> None:
    run = standing()
    assert run.go(55, STANDS).reason == TURNING
    assert run.go(1, replace(STANDS, target=SE2(0.1, 0.0, 0.0))).reason == TURNING  # it has not decided yet
    run.waypoints = waypoints
    assert run.go(1, wanted) is wanted


@pytest.mark.parametrize(
    ("share", "turns"), [(0.0, [50, 120, 190]), (0.2, [50])], ids=["held: three tries of 2 s", "slow is not held"]
)
def test_a_turn_that_something_holds_ends_and_is_tried_three_times_at_one_place(share: float, turns: list[int]) -> None:
    run = standing(moves=lambda pose, command: pose @ SE2(0.0, 0.0, share * command.wz_radps * 0.1))
    run.go(600, STANDS)
    assert run.began() == turns
    assert run.reasons.count(TURNING) == 60 if share == 0 else run.pose.theta_rad > 1.0
    run.pose = SE2(1.0, 0.0, 0.0)
    run.go(60, STANDS)
    assert len(run.began()) == len(turns) + 1


# Both


@pytest.mark.parametrize(
    ("run", "wanted", "reason"),
    [(Run(BackOff(BACK), wall_at(0.5)), DRIVES, BACKING_OFF), (standing(), STANDS, TURNING)],
    ids=["stuck", "standstill"],
)
def test_halts_in_between_do_not_hide_it(run: Run, wanted: VelocityCommand, reason: str) -> None:
    for _ in range(20):  # as sync mode drives: half a second of each generation
        run.go(5, wanted)
        run.go(20, THINKS)
    assert reason in run.reasons


def test_without_a_pose_or_at_no_speed_there_is_no_recovery() -> None:
    back_off, turn, waypoints = BackOff(BACK), StandstillTurn(TURN), np.array(LEFT, np.float32)
    assert all(back_off.step(DRIVES, None, k * TICK_NS) is DRIVES for k in range(100))
    assert all(turn.step(STANDS, waypoints, None, k * TICK_NS) is STANDS for k in range(100))
    for speed_scale in (0.0, float("nan")):
        run = standing()
        run.go(100, STANDS, speed_scale)
        assert set(run.reasons) == {"ok"}
        assert stuck().go(1, DRIVES, speed_scale) is DRIVES


@pytest.mark.parametrize(
    ("config", "values", "message"),
    [
        (BACK, {"distance_m": 0.0}, "above 0"),
        (BACK, {"vx_min_mps": 0.1}, "vx_min_mps"),
        *(
            (TURN, values, "standstill: expected")
            for values in ({"after_s": 0.0}, {"done_rad": 0.5}, {"leads_on_m": 0.3})
        ),
    ],
)
def test_an_inconsistent_configuration_is_refused(
    config: BackOffConfig | StandstillConfig, values: dict[str, float], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        replace(config, **values)
