"""A plan that stands for long while the words mean to go on: the robot turns to where they lead."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import pi

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from edge.core.geometry import SE2
from edge.motion.controller import VelocityCommand
from edge.motion.recovery import TURNING, StandstillConfig, StandstillTurn
from edge.state.semantic import waypoints_now

CONFIG = StandstillConfig(wz_max_radps=1.0)
TICK_NS = 100_000_000
STANDS = VelocityCommand(0.0, 0.0, 0.0, SE2(0.01, 0.0, 0.0), "ok")
DRIVES = VelocityCommand(0.05, 0.0, 0.0, SE2(0.6, 0.0, 0.0), "ok")  # it speeds up from standing
THINKS = VelocityCommand(0.0, 0.0, 0.0, None, "thinking")
LEFT = ((0.0, 2.0), (0.0, 4.0), (0.0, 6.0))
AHEAD = ((2.0, 0.1), (4.0, 0.2), (6.0, 0.3))
Points = tuple[tuple[float, float], ...]


def free(wz_radps: float) -> float:
    """Nothing holds it."""
    return wz_radps


class Run:
    """Ticks of a robot that turns as `turns` lets it; the words were said where it stood at first."""

    def __init__(
        self, words: Points | None, config: StandstillConfig = CONFIG, turns: Callable[[float], float] = free
    ) -> None:
        self.stalemate, self.words, self.turns = StandstillTurn(config), words, turns
        self.pose, self.ticks = SE2(0.0, 0.0, 0.0), 0
        self.said: list[str] = []
        self.rates: list[float] = []

    def go(self, ticks: int, wanted: VelocityCommand = STANDS, speed_scale: float = 1.0) -> VelocityCommand:
        for _ in range(ticks):
            meant = None if self.words is None else waypoints_now(self.words, self.pose)[0]
            command = self.stalemate.step(wanted, meant, self.pose, self.ticks * TICK_NS, speed_scale)
            self.pose = self.pose @ SE2(0.0, 0.0, self.turns(command.wz_radps) * 0.1)
            self.ticks += 1
            self.said.append(command.reason)
            self.rates.append(command.wz_radps)
        return command

    def began(self) -> list[int]:
        """The ticks at which a turn begins."""
        return [k for k in range(1, len(self.said)) if self.said[k - 1] != TURNING == self.said[k]]


def test_it_stands_for_five_seconds_and_then_turns_to_what_was_said() -> None:
    run = Run(LEFT)
    run.go(100)
    assert run.began() == [50] and run.said[-1] == "ok"
    assert run.pose.theta_rad == pytest.approx(pi / 2, abs=0.16)


@given(st.floats(-3.1, 3.1), st.floats(0.3, 1.0))
def test_it_turns_the_short_way_within_the_limits(bearing_rad: float, wz_max_radps: float) -> None:
    assume(abs(abs(bearing_rad) - CONFIG.aside_rad) > 1e-4)  # waypoints are float32
    far = tuple((r * np.cos(bearing_rad), r * np.sin(bearing_rad)) for r in (2.0, 4.0, 6.0))
    run = Run(far, StandstillConfig(wz_max_radps=wz_max_radps))
    run.go(80, speed_scale=0.5)
    turned = [rate for rate, reason in zip(run.rates, run.said, strict=True) if reason == TURNING]
    assert all(abs(rate) <= min(0.5, wz_max_radps) * 0.5 and rate * bearing_rad >= 0 for rate in turned)
    assert bool(turned) == (abs(bearing_rad) >= CONFIG.aside_rad)


@pytest.mark.parametrize("words", [None, AHEAD, ((0.0, 0.9),) * 3, ((0.0, 0.0), (0.0, 0.8), (0.0, 1.4))])
def test_words_that_lead_ahead_or_mean_to_stop_or_say_nothing_leave_it_standing(words: Points | None) -> None:
    run = Run(words)
    run.go(300)
    assert set(run.said) == {"ok"}


@pytest.mark.parametrize("target", [SE2(0.3, 0.0, 0.0), SE2(0.0, 0.0, 0.4), SE2(-0.3, 0.0, 0.0)])
def test_a_plan_that_drives_or_turns_is_no_stalemate(target: SE2) -> None:
    run = Run(LEFT)
    run.go(200, replace(STANDS, target=target))
    assert set(run.said) == {"ok"}


def test_whatever_forces_zero_ends_a_turn() -> None:
    run = Run(LEFT)
    run.go(55)
    assert run.said[-1] == TURNING and run.go(1, THINKS) is THINKS


def test_halts_in_between_do_not_hide_a_stalemate() -> None:
    run = Run(LEFT)
    for _ in range(11):  # as sync mode drives: half a second of each generation
        run.go(5)
        run.go(20, THINKS)
    assert run.said.count(TURNING) == 5


def test_a_plan_that_drives_ends_a_turn_though_the_robot_has_yet_to_speed_up() -> None:
    run = Run(LEFT)
    run.go(55)
    assert run.go(1, replace(STANDS, target=SE2(0.1, 0.0, 0.0))).reason == TURNING  # it has not decided yet
    assert run.go(1, DRIVES) is DRIVES


def test_words_to_stop_end_a_turn() -> None:
    run = Run(LEFT)
    run.go(55)
    run.words = ((0.0, 0.0),) * 3
    assert run.go(1) is STANDS


def test_a_turn_that_something_holds_ends_after_two_seconds_and_is_tried_three_times_at_one_place() -> None:
    run = Run(LEFT, turns=lambda _: 0.0)
    run.go(600)
    assert run.began() == [50, 120, 190] and run.said.count(TURNING) == 60
    run.pose = SE2(1.0, 0.0, 0.0)
    run.go(60)
    assert len(run.began()) == 4


def test_one_that_turns_slowly_is_not_held() -> None:
    run = Run(LEFT, turns=lambda rate: 0.2 * rate)
    run.go(200)
    assert run.began() == [50] and run.pose.theta_rad > 1.0


def test_without_a_pose_or_at_no_speed_it_does_nothing() -> None:
    stalemate, meant = StandstillTurn(CONFIG), np.array(LEFT, np.float32)
    assert all(stalemate.step(STANDS, meant, None, k * TICK_NS) is STANDS for k in range(100))
    for speed_scale in (0.0, float("nan")):
        run = Run(LEFT)
        run.go(100, speed_scale=speed_scale)
        assert set(run.said) == {"ok"}


def test_a_configuration_that_makes_no_sense_is_refused() -> None:
    for odd in ({"after_s": 0.0}, {"done_rad": 0.5}, {"leads_on_m": 0.3}):
        with pytest.raises(ValueError, match="standstill: expected"):
            replace(CONFIG, **odd)
