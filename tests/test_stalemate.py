"""A plan that stands for long while the words mean to go on: the robot turns to what was said, or is sent back."""

from __future__ import annotations

from dataclasses import replace
from math import pi

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.back_off import BACKING_OFF, BackOff, BackOffConfig
from edge.controller import VelocityCommand
from edge.geometry import SE2
from edge.guidance import waypoints_now
from edge.stalemate import TURNING, Stalemate, StalemateConfig

CONFIG = StalemateConfig(wz_max_radps=1.0)
TICK_NS = 100_000_000
STANDS = VelocityCommand(0.0, 0.0, 0.0, SE2(0.01, 0.0, 0.0), "ok")
LEFT = ((0.0, 2.0), (0.0, 4.0), (0.0, 6.0))
AHEAD = ((2.0, 0.1), (4.0, 0.2), (6.0, 0.3))
Points = tuple[tuple[float, float], ...]


class Run:
    """Ticks of a robot that turns as it is told; the words were said where it stood at first."""

    def __init__(self, words: Points | None, config: StalemateConfig = CONFIG) -> None:
        self.stalemate, self.words, self.pose, self.ticks = Stalemate(config), words, SE2(0.0, 0.0, 0.0), 0
        self.said: list[str] = []
        self.turned: list[float] = []
        self.sent_back = 0

    def go(self, ticks: int, wanted: VelocityCommand = STANDS, speed_scale: float = 1.0) -> VelocityCommand:
        for _ in range(ticks):
            meant = None if self.words is None else waypoints_now(self.words, self.pose)[0]
            command, back = self.stalemate.step(wanted, meant, self.pose, self.ticks * TICK_NS, speed_scale)
            self.pose = self.pose @ SE2(command.vx_mps * 0.1, 0.0, command.wz_radps * 0.1)
            self.ticks += 1
            self.sent_back += back
            self.said.append(command.reason)
            self.turned.append(command.wz_radps)
        return command


def test_it_stands_for_five_seconds_and_then_turns_to_what_was_said() -> None:
    run = Run(LEFT)
    run.go(100)
    assert run.said.index(TURNING) == 50 and run.pose.theta_rad == pytest.approx(pi / 2, abs=0.16)
    assert run.said[-1] == "ok" and (run.pose.x_m, run.pose.y_m) == (0.0, 0.0) and not run.sent_back


@given(st.floats(-3.1, 3.1), st.floats(0.3, 1.0))
def test_it_turns_the_short_way_within_the_limits(bearing_rad: float, wz_max_radps: float) -> None:
    far = tuple((r * np.cos(bearing_rad), r * np.sin(bearing_rad)) for r in (2.0, 4.0, 6.0))
    run = Run(far, StalemateConfig(wz_max_radps=wz_max_radps))
    run.go(80, speed_scale=0.5)
    turned = [rate for rate, reason in zip(run.turned, run.said, strict=True) if reason == TURNING]
    assert all(abs(rate) <= min(0.5, wz_max_radps) * 0.5 + 1e-9 and rate * bearing_rad >= 0 for rate in turned)
    assert bool(turned) != bool(run.sent_back)


def test_where_that_is_ahead_it_is_sent_back() -> None:
    run = Run(AHEAD)
    run.go(51)
    assert run.sent_back == 1 and set(run.said) == {"ok"}


@pytest.mark.parametrize("words", [None, ((0.9, 0.0),) * 3, ((0.0, 0.0), (0.0, 0.8), (0.0, 1.4))])
def test_words_that_mean_to_stop_or_to_wait_or_say_nothing_leave_it_standing(words: Points | None) -> None:
    run = Run(words)
    run.go(300)
    assert set(run.said) == {"ok"} and not run.sent_back


@pytest.mark.parametrize("wanted", [replace(STANDS, vx_mps=0.3), replace(STANDS, wz_radps=0.4)])
def test_a_plan_that_drives_or_turns_is_no_stalemate(wanted: VelocityCommand) -> None:
    run = Run(LEFT)
    run.go(200, wanted)
    assert set(run.said) == {"ok"} and not run.sent_back


def test_whatever_forces_zero_ends_it_and_the_five_seconds_begin_anew() -> None:
    run = Run(LEFT)
    run.go(55)
    halted = VelocityCommand(0.0, 0.0, 0.0, None, "stale-frame")
    assert run.go(1, halted) == halted
    run.go(49)
    assert TURNING not in run.said[55:]


def test_a_plan_that_drives_off_meanwhile_is_done_as_it_says() -> None:
    run, drives = Run(LEFT), replace(STANDS, vx_mps=0.4)
    run.go(55)
    assert run.go(1, replace(STANDS, vx_mps=0.1)).reason == TURNING  # it has not decided yet
    assert run.go(1, drives) == drives


def test_a_robot_that_cannot_turn_is_sent_back_after_two_seconds() -> None:
    stalemate = Stalemate(CONFIG)
    meant = np.array(LEFT, np.float32)
    said = [stalemate.step(STANDS, meant, SE2(0.0, 0.0, 0.0), k * TICK_NS) for k in range(75)]
    assert [command.reason == TURNING for command, _ in said] == [50 <= k < 70 for k in range(75)]
    assert [k for k, (_, back) in enumerate(said) if back] == [70]


def test_one_that_turns_slowly_is_not() -> None:
    stalemate, pose = Stalemate(CONFIG), SE2(0.0, 0.0, 0.0)
    for k in range(200):
        meant = waypoints_now(LEFT, pose)[0]
        command, back = stalemate.step(STANDS, meant, pose, k * TICK_NS)
        pose = pose @ SE2(0.0, 0.0, 0.2 * command.wz_radps * 0.1)
        assert not back
    assert pose.theta_rad > 0.5


def test_sent_back_it_goes_though_the_plan_stands_further_each_time_as_far_as_it_has_come() -> None:
    back_off, pose, ways = BackOff(BackOffConfig(vx_min_mps=-0.4)), SE2(0.0, 0.0, 0.0), list[float]()
    drives = VelocityCommand(0.4, 0.0, 0.0, SE2(0.4, 0.0, 0.0), "ok")
    for k in range(25):
        back_off.step(drives, pose, k * TICK_NS)
        pose = pose @ SE2(0.04, 0.0, 0.0)
    for way in range(4):
        start, now_ns = pose, (100 + 100 * way) * TICK_NS
        back_off.send_back(pose, now_ns)
        for k in range(100):
            command = back_off.step(STANDS, pose, now_ns + k * TICK_NS)
            assert k > 0 or command.reason == BACKING_OFF or way > 2
            pose = pose @ SE2(command.vx_mps * 0.1, 0.0, command.wz_radps * 0.1)
        ways.append(start.x_m - pose.x_m)
    assert ways == pytest.approx([0.3, 0.6, 0.1, 0.0], abs=0.06) and pose.x_m >= 0.0


def test_a_configuration_that_makes_no_sense_is_refused() -> None:
    for odd in ({"after_s": 0.0}, {"there_rad": 0.5}, {"meant_m": 0.3}):
        with pytest.raises(ValueError, match="stalemate: expected"):
            replace(CONFIG, **odd)
