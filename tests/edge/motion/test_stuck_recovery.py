"""A robot that is told to drive on and does not come on goes back through its own trail; nothing else reverses it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import hypot

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.geometry import SE2
from edge.motion.controller import VelocityCommand
from edge.motion.recovery import BACKING_OFF, BackOff, BackOffConfig

CONFIG = BackOffConfig(vx_min_mps=-0.4, wz_max_radps=1.0)
TICK_NS = 100_000_000
ON = VelocityCommand(0.4, 0.0, 0.2, SE2(0.4, 0.0, 0.0), "ok")
Moves = Callable[[SE2, VelocityCommand], SE2]


def glide(pose: SE2, command: VelocityCommand) -> SE2:
    """Nothing holds it."""
    return pose @ SE2(command.vx_mps * 0.1, 0.0, command.wz_radps * 0.1)


def wall_at(x_m: float) -> Moves:
    """Nothing holds it but a wall across its way; turning it, too, is held there."""

    def move(pose: SE2, command: VelocityCommand) -> SE2:
        there = glide(pose, command)
        return pose if there.x_m > x_m and command.vx_mps > 0 else there

    return move


class Run:
    """Ticks of a robot that does as it is told, as far as `moves` lets it."""

    def __init__(self, moves: Moves = glide, config: BackOffConfig = CONFIG, pose: SE2 | None = None) -> None:
        self.back_off, self.moves, self.pose, self.ticks = BackOff(config), moves, pose or SE2(0.0, 0.0, 0.0), 0
        self.said: list[str] = []
        self.poses = [self.pose]

    def go(self, ticks: int, wanted: VelocityCommand = ON, speed_scale: float = 1.0) -> VelocityCommand:
        for _ in range(ticks):
            command = self.back_off.step(wanted, self.pose, self.ticks * TICK_NS, speed_scale)
            self.pose = self.moves(self.pose, command)
            self.ticks += 1
            self.said.append(command.reason)
            self.poses.append(self.pose)
        return command


STRAIGHT = replace(ON, wz_radps=0.0)


def held(config: BackOffConfig = CONFIG, wanted: VelocityCommand = STRAIGHT) -> Run:
    """Driven a metre and then held at a wall, up to the first tick of its way back."""
    run = Run(wall_at(1.0), config)
    while BACKING_OFF not in run.said and run.ticks < 200:
        run.go(1, wanted)
    return run


def test_for_two_seconds_at_the_wall_it_does_as_told() -> None:
    run = held()
    first = run.said.index(BACKING_OFF)
    stood = sum(pose.x_m == run.poses[first].x_m for pose in run.poses[: first + 1])
    assert 14 <= stood <= 50 and set(run.said[:first]) == {"ok"}


def test_then_it_goes_back_slowly_about_as_far_as_it_was_told_to() -> None:
    run = held()
    at_the_wall = run.poses[-2].x_m
    while run.said[-1] == BACKING_OFF:
        assert run.go(1, STRAIGHT).vx_mps >= (-0.2 if run.said[-1] == BACKING_OFF else 0.0)
    assert at_the_wall - min(pose.x_m for pose in run.poses[-40:]) == pytest.approx(0.3, abs=0.05)


def test_it_goes_back_through_the_headings_that_it_came_by() -> None:
    def corner(pose: SE2, command: VelocityCommand) -> SE2:
        return pose if pose.y_m > 0.25 and command.vx_mps > 0 else glide(pose, command)

    run, turning = Run(corner), VelocityCommand(0.3, 0.0, 0.6, SE2(0.3, 0.1, 0.6), "ok")
    while BACKING_OFF not in run.said:
        run.go(1, turning)
    came, start = run.poses[:-1], run.poses[-2]
    while run.said[-1] == BACKING_OFF:
        run.go(1, turning)
        gaps = [
            (hypot(p.x_m - run.pose.x_m, p.y_m - run.pose.y_m), abs(p.theta_rad - run.pose.theta_rad)) for p in came
        ]
        assert any(gap_m < 0.08 and turned < 0.25 for gap_m, turned in gaps)
    assert run.poses[-2].theta_rad < start.theta_rad - 0.2


def test_where_it_has_not_come_from_anywhere_it_does_not_go() -> None:
    run = Run(lambda pose, _: pose)
    run.go(200, STRAIGHT)
    assert run.pose == SE2(0.0, 0.0, 0.0) and set(run.said) <= {"ok", BACKING_OFF}
    run = Run(lambda pose, command: pose if command.vx_mps > 0 else glide(pose, command))
    run.go(200, STRAIGHT)
    assert run.pose == SE2(0.0, 0.0, 0.0)


@given(st.floats(0.05, 0.8), st.floats(-1.0, 1.0), st.floats(0.3, 1.0))
def test_who_comes_on_is_never_sent_back(speed_mps: float, wz_radps: float, slip: float) -> None:
    run = Run(lambda pose, command: pose @ SE2(slip * command.vx_mps * 0.1, 0.0, command.wz_radps * 0.1))
    if abs(wz_radps) < 0.3 * speed_mps:  # who drives in circles is back where it was now and then
        run.go(100, VelocityCommand(speed_mps, 0.0, wz_radps, SE2(speed_mps, 0.0, 0.0), "ok"))
        assert set(run.said) == {"ok"}


@given(st.integers(1, 6), st.floats(0.3, 1.0))
def test_who_dithers_on_the_spot_is_not_held_by_anything(ticks: int, wz_radps: float) -> None:
    run = Run()
    for turn in range(60):
        sign = 1 if turn % 2 else -1
        run.go(ticks, VelocityCommand(0.0, 0.0, sign * wz_radps, SE2(0.0, 0.0, 0.3), "ok"))
    assert set(run.said) == {"ok"}


@pytest.mark.parametrize("reason", ["stale-frame", "no-semantic-state", "thinking"])
def test_whatever_forces_zero_ends_it_at_once(reason: str) -> None:
    run = held()
    zero = VelocityCommand(0.0, 0.0, 0.0, None, reason)
    assert run.go(1, zero) is zero


def test_a_plan_to_stand_ends_it_at_once() -> None:
    run = held()
    standing = VelocityCommand(0.01, 0.0, 0.0, SE2(0.01, 0.0, 0.0), "ok")
    assert run.go(1, standing) is standing


def test_halts_in_between_do_not_hide_a_wedge() -> None:
    run = Run(wall_at(0.5))
    for _ in range(20):  # as sync mode drives: half a second of each generation
        run.go(5, STRAIGHT)
        run.go(20, VelocityCommand(0.0, 0.0, 0.0, None, "thinking"))
    assert BACKING_OFF in run.said


def test_where_it_cannot_go_back_either_it_gives_up_in_a_second_and_tries_three_times_at_one_place() -> None:
    run = Run(wall_at(1.0))
    run.go(30, STRAIGHT)
    run.moves = lambda pose, _: pose
    run.go(600, STRAIGHT)
    tries = sum(a != BACKING_OFF == b for a, b in zip(run.said, run.said[1:], strict=False))
    assert tries == 3 and run.said.count(BACKING_OFF) <= 3 * 11


def ways_back_m(run: Run) -> list[float]:
    """How far it went on each way back."""
    ways, start = [], run.poses[0]
    for k, (before, now) in enumerate(zip(run.said, run.said[1:], strict=False)):
        if before != BACKING_OFF == now:
            start = run.poses[k + 1]
        if before == BACKING_OFF != now:
            ways.append(hypot(run.poses[k + 1].x_m - start.x_m, run.poses[k + 1].y_m - start.y_m))
    return ways


def test_held_again_at_one_place_it_goes_further_back_up_to_three_times_as_far() -> None:
    run = Run(wall_at(2.0))
    run.go(900, STRAIGHT)
    assert ways_back_m(run)[:5] == pytest.approx([0.3, 0.6, 0.9, 0.9, 0.9], abs=0.05)


def test_who_comes_free_is_not_sent_back() -> None:
    run = Run(wall_at(1.0))
    run.go(900, STRAIGHT)
    while run.said[-1] == BACKING_OFF:
        run.go(1, STRAIGHT)
    run.moves, before = glide, run.said.count(BACKING_OFF)
    run.go(100, STRAIGHT)
    assert run.said.count(BACKING_OFF) == before and run.pose.x_m > 4.0


def test_elsewhere_it_tries_again_as_at_first() -> None:
    run = Run(wall_at(1.0))
    run.go(300, STRAIGHT)
    run.moves = lambda pose, _: pose
    run.go(600, STRAIGHT)
    run.moves, before = wall_at(3.0), len(ways_back_m(run))
    run.go(300, STRAIGHT)
    assert ways_back_m(run)[before] == pytest.approx(0.3, abs=0.05)


def test_without_a_pose_nothing_is_known_of_a_wedge() -> None:
    back_off = BackOff(CONFIG)
    assert all(back_off.step(ON, None, tick * TICK_NS) is ON for tick in range(100))


def test_it_keeps_to_the_share_of_speed_that_the_supervisor_leaves() -> None:
    run = held()
    assert -0.1 - 1e-9 <= run.go(1, STRAIGHT, speed_scale=0.5).vx_mps < 0.0
    assert run.go(1, STRAIGHT, speed_scale=float("nan")) is STRAIGHT


@given(st.floats(0.01, 1.0), st.floats(-0.8, -0.01), st.floats(0.01, 1.0))
def test_the_way_back_never_leaves_the_robot_files_limits(
    wz_max_radps: float, vx_min_mps: float, speed_scale: float
) -> None:
    def corner(pose: SE2, command: VelocityCommand) -> SE2:
        return pose if pose.y_m > 0.25 and command.vx_mps > 0 else glide(pose, command)

    run, turning = (
        Run(corner, replace(CONFIG, wz_max_radps=wz_max_radps, vx_min_mps=vx_min_mps)),
        replace(ON, vx_mps=0.3, wz_radps=0.6),
    )
    for _ in range(120):
        command = run.go(1, turning, speed_scale)
        if command.reason == BACKING_OFF:
            assert vx_min_mps * speed_scale <= command.vx_mps <= 0.0
            assert abs(command.wz_radps) <= wz_max_radps * speed_scale
    assert BACKING_OFF in run.said


def test_a_robot_that_may_not_reverse_never_does() -> None:
    assert set(held(replace(CONFIG, vx_min_mps=0.0)).said) == {"ok"}
    run = held(replace(CONFIG, vx_min_mps=-0.05))
    assert -0.05 <= run.go(1, STRAIGHT).vx_mps <= 0.0


def test_numbers_that_make_no_sense_are_refused() -> None:
    with pytest.raises(ValueError, match="above 0"):
        replace(CONFIG, distance_m=0.0)
    with pytest.raises(ValueError, match="vx_min_mps"):
        replace(CONFIG, vx_min_mps=0.1)
