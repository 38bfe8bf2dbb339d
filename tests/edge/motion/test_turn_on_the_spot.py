"""The turn on the spot that an instruction begins with: as far as told, by odometry, and never against a hold."""

from __future__ import annotations

from math import copysign, degrees, pi

import pytest

from edge.core.geometry import SE2, wrap_angle
from edge.motion.controller import VelocityCommand
from edge.motion.turn_on_the_spot import TOLD, TurnConfig, TurnOnTheSpot
from edge.state.semantic import ToldTurn

PERIOD_NS = 100_000_000
WAITS = VelocityCommand(0.0, 0.0, 0.0, None, "no-semantic-state")
HELD = VelocityCommand(0.0, 0.0, 0.0, None, "camera-stopped")


class Robot:
    """Follows every yaw rate, `share` of it; the clock advances with each step."""

    def __init__(self, heading_rad: float = 0.0, share: float = 1.0, config: TurnConfig | None = None) -> None:
        self.turning = TurnOnTheSpot(config or TurnConfig(wz_max_radps=1.0))
        self.heading_rad, self.share, self.now_ns, self.turned_rad = heading_rad, share, 10**12, 0.0

    def step(
        self, turn: ToldTurn, command: VelocityCommand = WAITS, scale: float = 1.0, *, blind: bool = False
    ) -> VelocityCommand | None:
        pose = None if blind else SE2(1.0, 2.0, self.heading_rad)
        told = self.turning.step(turn, command, pose, self.now_ns, scale)
        moved_rad = 0.0 if told is None else self.share * told.wz_radps * PERIOD_NS / 1e9
        self.heading_rad = wrap_angle(self.heading_rad + moved_rad)
        self.turned_rad += moved_rad
        self.now_ns += PERIOD_NS
        return told

    def turn(self, turn: ToldTurn, at_most_s: float = 30.0) -> float:
        """Turn until it ends; return how long it took, s."""
        begun_ns = self.now_ns
        while self.step(turn) is not None:
            assert self.now_ns - begun_ns < at_most_s * 1e9
        return (self.now_ns - begun_ns) / 1e9


@pytest.mark.parametrize("turn_deg", [180, -180, 90, -90, 20])
@pytest.mark.parametrize("heading_rad", [0.0, 3.0, -2.0])
def test_the_robot_turns_as_far_as_it_is_told(turn_deg: float, heading_rad: float) -> None:
    robot = Robot(heading_rad)
    took_s = robot.turn(ToldTurn(turn_deg * pi / 180))
    assert degrees(robot.turned_rad) == pytest.approx(turn_deg, abs=6)
    assert took_s < abs(turn_deg) / 180 * pi / 0.5 + 2.0


def test_it_turns_on_the_spot_to_the_side_that_it_is_told() -> None:
    for side in (1.0, -1.0):
        told = Robot().step(ToldTurn(copysign(pi, side)))
        assert told == VelocityCommand(0.0, 0.0, side * 0.5, None, TOLD)


def test_it_turns_no_faster_than_the_robot_file_and_the_supervisor_allow() -> None:
    slow = Robot(config=TurnConfig(wz_max_radps=0.3)).step(ToldTurn(pi), scale=0.5)
    assert slow is not None and slow.wz_radps == pytest.approx(0.15)


@pytest.mark.parametrize("reason", ["ok", "arrived", "reasoning", "no-semantic-state"])
def test_it_turns_in_place_of_a_plan_and_of_waiting_for_one(reason: str) -> None:
    told = Robot().step(ToldTurn(pi), VelocityCommand(0.4, 0.0, 0.1, SE2(1.0, 0.0, 0.0), reason))
    assert told is not None and told.reason == TOLD and told.vx_mps == 0.0


@pytest.mark.parametrize(("scale", "blind"), [(1.0, False), (0.0, False), (float("nan"), False), (1.0, True)])
def test_a_hold_comes_first_and_the_turn_goes_on_after_it(scale: float, blind: bool) -> None:
    robot, turn = Robot(), ToldTurn(pi)
    for _ in range(20):
        robot.step(turn)
    before_rad = robot.turned_rad
    held = HELD if scale == 1.0 and not blind else WAITS
    for _ in range(100):
        assert robot.step(turn, held, scale, blind=blind) is held
    assert robot.turned_rad == before_rad
    robot.turn(turn)
    assert degrees(robot.turned_rad) == pytest.approx(180, abs=6)


def test_a_robot_that_cannot_turn_gives_up_after_three_seconds() -> None:
    assert Robot(share=0.0).turn(ToldTurn(pi)) == pytest.approx(3.1, abs=0.2)


def test_a_robot_that_turns_by_a_fifth_of_what_it_is_told_does_not_give_up() -> None:
    robot = Robot(share=0.2)
    robot.turn(ToldTurn(pi), at_most_s=60.0)
    assert degrees(robot.turned_rad) == pytest.approx(180, abs=6)


def test_another_turn_with_the_same_angle_is_another_turn() -> None:
    robot = Robot()
    robot.turn(ToldTurn(pi))
    robot.turn(ToldTurn(pi))
    assert degrees(robot.turned_rad) == pytest.approx(360, abs=12)


def test_a_turn_that_replaces_another_begins_anew() -> None:
    robot, first = Robot(), ToldTurn(pi)
    for _ in range(20):
        robot.step(first)
    before_rad = robot.turned_rad
    robot.turn(ToldTurn(-pi / 2))
    assert degrees(robot.turned_rad - before_rad) == pytest.approx(-90, abs=6)


def test_speeds_and_limits_are_above_zero() -> None:
    with pytest.raises(ValueError, match="above 0"):
        TurnConfig(wz_max_radps=0.0)
