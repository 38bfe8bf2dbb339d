"""Detours from the described route lead mostly into an opening that can be mistaken for the correct one."""

from __future__ import annotations

from math import hypot

import numpy as np
import pytest

from sim_hil.benchmark.language.openings import Frame
from tests.support.train.training_scenarios import all_scenarios, scenarios
from tools.train.collect.steering import Detour, draw_detour, wrong_opening
from tools.train.drives.scenarios import Scenario

pytestmark = pytest.mark.slow

DRAWS = 12


def detours(scenario: Scenario, count: int = DRAWS) -> list[Detour | None]:
    return [
        draw_detour(scenario.site, scenario.episode.robot, scenario.task, 6.0, np.random.default_rng((seed, 5)))
        for seed in range(count)
    ]


def mistakes(scenario: Scenario, count: int = DRAWS) -> list[Detour]:
    drawn = (
        wrong_opening(scenario.site, scenario.episode.robot, scenario.task, np.random.default_rng((seed, 7)))
        for seed in range(count)
    )
    return [detour for detour in drawn if detour is not None]


def place(scenario: Scenario, after_m: float) -> tuple[float, float]:
    """On the told way."""
    corners = np.array(scenario.task.path)
    marks = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
    return float(np.interp(after_m, marks, corners[:, 0])), float(np.interp(after_m, marks, corners[:, 1]))


def test_it_is_to_somewhere_that_the_robot_fits_and_is_begun_before_the_ways_end() -> None:
    for scenario in all_scenarios():
        grid = scenario.site.robot_grid(scenario.episode.robot)
        for detour in detours(scenario, 4):
            assert detour is not None and grid.is_free(*detour.to)
            assert 0.0 <= detour.after_m <= scenario.told.length_m + 0.5 and detour.for_m >= 1.0


def test_some_take_a_wrong_opening_and_some_go_anywhere() -> None:
    scenario = scenarios("hospital")[1]
    wrong = {detour.to for detour in mistakes(scenario, 60)}
    share = sum(detour is not None and detour.to in wrong for detour in detours(scenario, 40)) / 40
    assert len(wrong) > 1 and 0.35 < share < 0.85


@pytest.mark.parametrize("kind", ["hospital", "office", "warehouse"])
def test_a_wrong_opening_leads_into_an_area_near_a_step_that_is_not_the_one_to_be_taken(kind: str) -> None:
    found = 0
    for scenario in scenarios(kind):
        for detour in mistakes(scenario):
            found += 1
            beside = []
            for step in scenario.told.steps:
                frame = Frame(step.ahead)
                ahead_m = frame.along(detour.to) - frame.along(step.at)
                side = "left" if frame.across(detour.to) > frame.across(step.at) else "right"
                beside.append(side != step.side or abs(ahead_m) > 0.5)
                near = hypot(detour.to[0] - step.at[0], detour.to[1] - step.at[1]) < 20.0
                assert near or len(scenario.told.steps) > 1
            assert any(beside) and any(area.contains(*detour.to) for area in scenario.scene.areas)
    assert found


def test_where_nothing_is_to_be_taken_there_is_no_wrong_opening() -> None:
    plain = [scenario for scenario in all_scenarios() if not scenario.told.steps]
    assert plain and not any(mistakes(scenario) for scenario in plain)
