"""What is learned from a frame on: what the expert drove, or had chosen where somebody else steered."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest

from edge.core.geometry import SE2
from sim_hil.benchmark.policies.expert_motion import STEP_S, STEPS, Choice
from sim_hil.benchmark.policies.expert_route import SPACING_M
from tests.support.train.train_drives import arc
from tools.train.drives.drive import EXPERT, FUTURE_STEPS, NOISE
from tools.train.drives.futures import chosen_future, label_futures, relative

AHEAD = np.stack((np.arange(0.0, 10.0, SPACING_M), np.zeros(100)), axis=1)


def _choice(
    speed_mps: float, turn_radps: float = 0.0, y_m: float = 0.0, start: tuple[float, ...] = (0, 0, 0)
) -> Choice:
    """A plan at one speed and turning rate from `start`, by exact integration."""
    times = (np.arange(STEPS) + 1) * STEP_S
    heading = start[2] + turn_radps * times
    if turn_radps:
        radius = speed_mps / turn_radps
        x = start[0] + radius * (np.sin(heading) - np.sin(start[2]))
        y = start[1] - radius * (np.cos(heading) - np.cos(start[2]))
    else:
        x, y = start[0] + speed_mps * times * np.cos(start[2]), start[1] + speed_mps * times * np.sin(start[2])
    return Choice(speed_mps, turn_radps, np.stack((x, y + y_m), axis=1), heading, 0.0, 0.0)


# -- what was chosen --------------------------------------------------------------------------------------------------


def test_on_the_plan_the_label_is_the_plan() -> None:
    choice = _choice(0.6, 0.5)
    future = chosen_future(SE2(0.0, 0.0, 0.0), choice, AHEAD)
    at = np.arange(2, 41, 2) - 1  # every 0.2 s up to 4 s
    assert np.allclose(future[at, :2], choice.future, atol=1e-9)
    assert np.allclose(future[at, 2], choice.headings_rad, atol=1e-9)


def test_it_is_in_the_robots_frame_wherever_the_robot_is() -> None:
    here = (3.0, -2.0, 2.5)
    choice = _choice(0.6, 0.5, start=here)
    there = SE2(*here)
    c, s = np.cos(here[2]), np.sin(here[2])
    route = np.stack((here[0] + c * AHEAD[:, 0], here[1] + s * AHEAD[:, 0]), axis=1)
    at_home = chosen_future(SE2(0.0, 0.0, 0.0), _choice(0.6, 0.5), AHEAD)
    assert np.allclose(chosen_future(there, choice, route), at_home, atol=1e-9)


def test_a_heading_that_wraps_is_not_turned_the_long_way_round() -> None:
    choice = _choice(0.0, 0.5, start=(0.0, 0.0, 3.0))
    future = chosen_future(SE2(0.0, 0.0, 3.0), choice, AHEAD)
    assert np.allclose(future[:40, 2], 0.05 * np.arange(1, 41), atol=1e-9)


def test_after_the_plan_it_goes_on_along_a_way_that_bends() -> None:
    bend = 3.4  # m ahead; the plan of 4 s ends at 3.2
    before = AHEAD[AHEAD[:, 0] < bend + 0.01]
    line = np.vstack((before, np.stack((np.full(60, bend), SPACING_M * np.arange(1, 61)), axis=1)))
    future = chosen_future(SE2(0.0, 0.0, 0.0), _choice(0.8), line)
    assert future[49] == pytest.approx((3.4, 0.6, np.pi / 2), abs=0.15)


def test_at_the_ways_end_it_stands_and_does_not_turn_about() -> None:
    short = AHEAD[:13]  # 1.2 m
    choice = _choice(0.8)
    turning = Choice(0.8, 0.0, np.minimum(choice.future, 1.2), np.linspace(0.0, 3.0, STEPS), 0.0, 0.0)
    future = chosen_future(SE2(0.0, 0.0, 0.0), turning, short)
    standing = np.flatnonzero(np.hypot(future[:, 0] - 1.2, future[:, 1]) < 0.45)
    assert np.allclose(future[standing[1] :], future[standing[1]])
    assert future[-1, 0] == pytest.approx(0.85, abs=0.1)


# -- what was driven --------------------------------------------------------------------------------------------------


def _labels(by: np.ndarray, goes_on: bool = True) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    poses = arc(len(by))
    chosen = np.random.default_rng(3).normal(size=(len(by), FUTURE_STEPS, 3))
    return (*label_futures(poses, chosen, by, goes_on=goes_on), poses, chosen)


def test_the_experts_own_drive_is_labelled_with_itself() -> None:
    future, steps, poses, _ = _labels(np.full(120, EXPERT, np.uint8))
    for k in (0, 33, 69):
        assert np.allclose(future[k], relative(poses[k], poses[k + 1 : k + 51]))
    assert np.all(steps == FUTURE_STEPS)


def test_frames_whose_next_five_seconds_are_disturbed_take_the_experts_plan() -> None:
    by = np.full(200, EXPERT, np.uint8)
    by[100:110] = NOISE
    future, _, poses, chosen = _labels(by)
    disturbed = [k for k in range(150) if np.array_equal(future[k], chosen[k])]
    assert disturbed == list(range(51, 110))
    assert np.allclose(future[50], relative(poses[50], poses[51:101]))


def test_at_the_end_the_experts_plan_continues() -> None:
    poses = arc(100)
    plan = chosen_future(SE2(0.0, 0.0, 0.0), _choice(0.8), AHEAD)
    future, steps = label_futures(poses, np.tile(plan, (100, 1, 1)), np.full(100, EXPERT), goes_on=True)
    assert np.all(steps == FUTURE_STEPS)
    assert np.allclose(future[99], plan)
    last = SE2(*(float(v) for v in poses[99]))
    there = SE2(*(float(v) for v in poses[89])).inverse() @ last @ SE2(*(float(v) for v in plan[0]))
    assert np.allclose(future[89, 10], there.as_tuple(), atol=1e-9)


def test_before_a_fall_only_the_driven_steps_are_labelled() -> None:
    future, steps, poses, _ = _labels(np.full(100, EXPERT, np.uint8), goes_on=False)
    assert steps[49] == 50 and steps[50] == 49 and steps[98] == 1 and steps[99] == 0
    assert np.allclose(future[90, :9], relative(poses[90], poses[91:]))
    assert np.allclose(future[90, 9:], future[90, 8])
    assert np.allclose(future[99], 0.0)


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (2.0, -1.0, 3.1), (-4.0, 5.0, -2.0)])
def test_relative_equals_the_se2_composition(origin: tuple[float, float, float]) -> None:
    poses = np.array([(1.0, 2.0, 0.3), (-3.0, 0.5, -3.0), (0.0, 0.0, pi - 0.01)])
    expected = [(SE2(*origin).inverse() @ SE2(*(float(v) for v in pose))).as_tuple() for pose in poses]
    assert np.allclose(relative(np.array(origin), poses), expected, atol=1e-12)
