"""Noise comes in marked bursts, DAgger alternates between policy and expert, and detours lead into wrong openings."""

from __future__ import annotations

import itertools
from math import hypot, isclose

import numpy as np
import pytest

from sim_hil.benchmark.language.openings import Frame
from tests.support.train.training_scenarios import all_scenarios, scenarios
from tools.train.collect.steering import (
    Detour,
    NoiseConfig,
    SharedControl,
    SteeringNoise,
    Velocity,
    draw_detour,
    wrong_opening,
)
from tools.train.drives.drive import EXPERT, NOISE
from tools.train.drives.scenarios import Scenario

WANTED: Velocity = (0.7, 0.0, 0.1)
POLICYS: Velocity = (0.2, 0.0, -0.4)


def _bursts(seed: int, ticks: int = 3000) -> list[tuple[Velocity, int]]:
    noise = SteeringNoise(np.random.default_rng(seed))
    return [noise.command(WANTED) for _ in range(ticks)]


def _runs(by: list[int]) -> list[tuple[int, int]]:
    """(who, ticks) of each stretch, without the first and the last, which are cut off."""
    return [(who, len(list(group))) for who, group in itertools.groupby(by)][1:-1]


def test_outside_a_burst_the_experts_command_is_not_touched() -> None:
    assert all(command == WANTED for command, by in _bursts(1) if by == EXPERT)


def test_bursts_and_pauses_last_as_long_as_they_should() -> None:
    config = NoiseConfig()
    runs = _runs([by for _, by in _bursts(2)])
    bursts, pauses = ([ticks / 10 for who, ticks in runs if who == kind] for kind in (NOISE, EXPERT))
    assert len(bursts) > 20
    assert config.burst_s[0] <= min(bursts) and max(bursts) <= config.burst_s[1]
    assert config.pause_s[0] - 0.2 <= min(pauses) and max(pauses) <= config.pause_s[1]


def test_a_burst_is_one_drifting_push_and_not_a_new_one_each_time() -> None:
    pairs = [
        (one[0][2] - 0.1, other[0][2] - 0.1)
        for one, other in itertools.pairwise(_bursts(3))
        if one[1] == other[1] == NOISE
    ]
    first, second = np.array(pairs).T
    assert np.corrcoef(first, second)[0, 1] > 0.6
    assert 0.3 < np.std(first) < 0.8


def test_nothing_is_commanded_beyond_what_a_robot_may_do() -> None:
    commands = [command for command, _ in _bursts(4)]
    assert all(-0.3 <= vx <= 1.1 and abs(wz) <= 1.2 for vx, _, wz in commands)


def _shared(beta: float, ticks: int = 4000) -> list[tuple[Velocity, int]]:
    shared = SharedControl(np.random.default_rng(1), beta)
    return [shared.command(WANTED, POLICYS) for _ in range(ticks)]


def test_the_experts_share_is_about_its_chance() -> None:
    assert isclose(np.mean([by == EXPERT for _, by in _shared(0.3, 20_000)]), 0.3, abs_tol=0.06)


def test_each_stretch_lasts_at_least_two_seconds() -> None:
    assert min(ticks for _, ticks in _runs([by for _, by in _shared(0.5)])) >= 20


DRAWS = 12


def detours(scenario: Scenario, count: int = DRAWS) -> list[Detour | None]:
    return [
        draw_detour(scenario.site, scenario.episode.robot, scenario.task, 6.0, np.random.default_rng((seed, 5)))
        for seed in range(count)
    ]


def mistake(scenario: Scenario, seed: int, into_m: float = 2.0) -> Detour | None:
    rng = np.random.default_rng((seed, 7))
    return wrong_opening(scenario.site, scenario.episode.robot, scenario.task, rng, into_m=into_m)


def mistakes(scenario: Scenario, count: int = DRAWS) -> list[Detour]:
    drawn = (mistake(scenario, seed) for seed in range(count))
    return [detour for detour in drawn if detour is not None]


def place(scenario: Scenario, after_m: float) -> tuple[float, float]:
    """On the told way."""
    corners = np.array(scenario.task.path)
    marks = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(corners, axis=0).T))])
    return float(np.interp(after_m, marks, corners[:, 0])), float(np.interp(after_m, marks, corners[:, 1]))


@pytest.mark.slow
def test_a_detour_leads_to_free_space_and_begins_before_the_routes_end() -> None:
    for scenario in all_scenarios():
        grid = scenario.site.robot_grid(scenario.episode.robot)
        for detour in detours(scenario, 4):
            assert detour is not None and grid.is_free(*detour.to)
            assert 0.0 <= detour.after_m <= scenario.route.length_m + 0.5 and detour.for_m >= 1.0


@pytest.mark.slow
def test_some_detours_take_a_wrong_opening_and_others_any_free_place() -> None:
    scenario = scenarios("hospital")[1]
    wrong = {detour.to for detour in mistakes(scenario, 60)}
    share = sum(detour is not None and detour.to in wrong for detour in detours(scenario, 40)) / 40
    assert len(wrong) > 1 and 0.35 < share < 0.85


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["hospital", "office", "warehouse"])
def test_a_wrong_opening_leads_into_an_area_near_a_step_that_is_not_the_one_to_be_taken(kind: str) -> None:
    found = 0
    for scenario in scenarios(kind):
        for detour in mistakes(scenario):
            found += 1
            beside = []
            for step in scenario.route.steps:
                frame = Frame(step.ahead)
                ahead_m = frame.along(detour.to) - frame.along(step.at)
                side = "left" if frame.across(detour.to) > frame.across(step.at) else "right"
                beside.append(side != step.side or abs(ahead_m) > 0.5)
                near = hypot(detour.to[0] - step.at[0], detour.to[1] - step.at[1]) < 20.0
                assert near or len(scenario.route.steps) > 1
            assert any(beside) and any(area.contains(*detour.to) for area in scenario.scene.areas)
    assert found


@pytest.mark.slow
def test_a_wrong_opening_can_be_entered_deeper() -> None:
    def lengths_m(into_m: float) -> list[float]:
        drawn = (mistake(scenario, seed, into_m) for scenario in all_scenarios() for seed in range(DRAWS))
        return [detour.for_m for detour in drawn if detour is not None]

    further_m = np.subtract(lengths_m(10.0), lengths_m(2.0))
    assert max(further_m) > 2.0 and min(further_m) >= 0


@pytest.mark.slow
def test_a_route_without_turns_has_no_wrong_opening() -> None:
    plain = [scenario for scenario in all_scenarios() if not scenario.route.steps]
    assert plain and not any(mistakes(scenario) for scenario in plain)
