"""Progress along a told way: it counts what the instruction counts, and knows where a stray belongs."""

from __future__ import annotations

import itertools
from math import atan2, cos, hypot, radians, sin

import numpy as np
import pytest

from edge.core.geometry import SE2
from edge.state.reasoning_text import Progress
from sim_hil.benchmark.language.openings import Frame
from sim_hil.benchmark.language.route import Step
from sim_hil.benchmark.policies.expert_route import RoutePlanner
from tests.support.train.training_scenarios import all_scenarios, progress_of, scenarios
from tools.train.config.collect import CORRIDOR, KINDS
from tools.train.drives.progress_labels import RouteProgress
from tools.train.drives.scenarios import Scenario

Points = list[tuple[float, float]]


def _told_way(scenario: Scenario) -> Points:
    """The told way's points, 0.1 m apart."""
    points: Points = []
    for a, b in itertools.pairwise(scenario.task.path):
        count = max(1, round(hypot(b[0] - a[0], b[1] - a[1]) / 0.1))
        points += [(a[0] + (b[0] - a[0]) * k / count, a[1] + (b[1] - a[1]) * k / count) for k in range(count)]
    return [*points, scenario.task.path[-1]]


def _expert_way(scenario: Scenario) -> Points:
    """Where the expert drives when nobody is about: with room to the walls."""
    episode = scenario.episode
    ground = scenario.site.planner_ground(episode.robot)
    planner = RoutePlanner(ground, episode.goal_xy, 0.8 * episode.threshold_m)
    line = planner.route(episode.start[:2], np.zeros((0, 2)), 150.0)
    return [(float(x), float(y)) for x, y in line]


def _index_of(step: Step, points: Points) -> int:
    """Index of the point that is nearest to a step's turn."""
    return min(range(len(points)), key=lambda i: hypot(points[i][0] - step.at[0], points[i][1] - step.at[1]))


def _said(progress: RouteProgress, points: Points) -> list[Progress]:
    """Progress at each point, heading for the next one."""
    ahead = [atan2(b[1] - a[1], b[0] - a[0]) for a, b in itertools.pairwise(points)]
    return [progress.at(SE2(x, y, heading)) for (x, y), heading in zip(points, [*ahead, ahead[-1]], strict=True)]


@pytest.mark.parametrize("way", [_told_way, _expert_way])
@pytest.mark.parametrize("kind", [CORRIDOR, *(pytest.param(k, marks=pytest.mark.slow) for k in KINDS if k != CORRIDOR)])
def test_a_robot_that_takes_the_kth_opening_has_passed_k_less_one(kind: str, way) -> None:  # type: ignore[no-untyped-def]
    for scenario in scenarios(kind):
        said = _said(progress_of(scenario), way(scenario))
        for index, step in enumerate(scenario.route.steps):
            before = [progress for progress in said if progress.step == index + 1]
            assert before, f"{scenario.episode.id}: step {index + 1} is never next"
            assert before[-1].passed == max(0, step.ordinal - 1), scenario.episode.id


@pytest.mark.slow
@pytest.mark.parametrize("way", [_told_way, _expert_way])
def test_progress_never_falls_back_along_the_way(way) -> None:  # type: ignore[no-untyped-def]
    for scenario in all_scenarios():
        said = [(progress.step, progress.passed) for progress in _said(progress_of(scenario), way(scenario))]
        assert said == sorted(said), scenario.episode.id


@pytest.mark.slow
def test_a_turn_is_done_once_the_robot_has_turned_by_25_degrees_or_is_a_metre_past_it() -> None:
    """As the runner's rule asks of it: a text that names the turn after it sooner would be refused."""
    checked = 0
    for scenario in all_scenarios():
        progress, way = progress_of(scenario), _told_way(scenario)
        for index, step in enumerate(scenario.route.steps):
            turn = _index_of(step, way)
            if step.side == "straight" or turn + 12 >= len(way):
                continue
            ahead_rad, sign = atan2(step.ahead[1], step.ahead[0]), 1 if step.side == "left" else -1
            at = {degrees: SE2(*way[turn + 8], ahead_rad + sign * radians(degrees)) for degrees in (0, 20, 30, 90)}
            if progress.at(at[90]).step != index + 2:
                continue  # in the area before the turn, or at the turn after it
            steps = [progress.at(pose).step for pose in (*at.values(), SE2(*way[turn + 11], ahead_rad))]
            assert steps == [index + 1, index + 1, index + 2, index + 2, index + 2], scenario.episode.id
            checked += 1
    assert checked >= 5


@pytest.mark.slow
def test_it_begins_with_the_first_turn_and_ends_on_the_last_leg() -> None:
    for scenario in all_scenarios():
        progress, steps = progress_of(scenario), len(scenario.route.steps)
        assert progress.at(SE2(*scenario.task.start)) == Progress(1, steps, 0)
        assert progress.at(SE2(*scenario.task.goal, 0.0)) == Progress(steps + 1, steps, 0)


@pytest.mark.slow
def test_a_robot_that_misses_the_turn_keeps_it_as_next_and_counts_the_opening() -> None:
    checked = 0
    for scenario in all_scenarios():
        progress, way = progress_of(scenario), _told_way(scenario)
        for index, step in enumerate(scenario.route.steps):
            if not step.counted or step.before_kind not in ("corridor", "aisle"):
                continue
            frame, taken = Frame(step.ahead), step.counted[step.ordinal - 1]
            turn = _index_of(step, way)
            x, y = frame.point(taken.high_m + 0.6, frame.across(way[max(0, turn - 8)]))
            said = progress.at(SE2(x, y, 0.0))
            if scenario.site.grid.clearance_m(x, y) < 0.2 or progress.strayed_m(SE2(x, y, 0.0)) > 4.0:
                continue  # a wall is there
            assert (said.step, said.steps) == (index + 1, len(scenario.route.steps)), scenario.episode.id
            assert said.passed >= step.ordinal, scenario.episode.id
            checked += 1
    assert checked >= 2


@pytest.mark.slow
def test_a_pose_off_the_floor_belongs_somewhere_too() -> None:
    for scenario in all_scenarios():
        for xy in ((1e3, 1e3), (-1e3, 0.0)):
            assert progress_of(scenario).at(SE2(*xy, 0.0)).steps == len(scenario.route.steps)


@pytest.mark.slow
def test_the_way_left_shrinks_metre_by_metre() -> None:
    for scenario in all_scenarios():
        progress, points = progress_of(scenario), _told_way(scenario)
        left = [progress.left_m(SE2(x, y, 0.0)) for x, y in points]
        assert left[0] == pytest.approx(scenario.route.length_m, abs=0.6)
        assert left[-1] == pytest.approx(0.0, abs=0.3)
        assert all(b <= a + 0.15 for a, b in itertools.pairwise(left))


@pytest.mark.slow
def test_behind_a_wall_one_has_strayed_by_the_way_round_it() -> None:
    scenario = scenarios("hospital")[0]
    grid, progress = scenario.site.grid, progress_of(scenario)
    rng, checked = np.random.default_rng(1), 0
    for x, y in _told_way(scenario)[::5]:
        for angle in rng.uniform(-3.14, 3.14, 12):
            there = (x + 2.5 * cos(angle), y + 2.5 * sin(angle))
            if not grid.is_free(*there) or grid.sees((x, y), there):
                continue
            straight_m = min(hypot(there[0] - a, there[1] - b) for a, b in _told_way(scenario))
            assert progress.strayed_m(SE2(*there, 0.0)) > straight_m - 0.15
            checked += 1
    assert checked >= 5
