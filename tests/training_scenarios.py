"""A few training scenarios of every kind, drawn once for all tests."""

from __future__ import annotations

from functools import cache

from tools.train.progress_labels import RouteProgress
from tools.train.scenarios import Scenario, scenario_group
from tools.train.sites import KINDS

SEED = 5
EACH = {"hospital": 2, "office": 2, "warehouse": 2, "sidewalk": 1, "corridor": 2}


@cache
def scenarios(kind: str) -> tuple[Scenario, ...]:
    """Some of one kind, all of one layout as a rule."""
    return tuple(scenario_group(SEED, KINDS.index(kind), {kind: 1.0}, EACH[kind]))


def all_scenarios() -> tuple[Scenario, ...]:
    """Those of every kind."""
    return tuple(scenario for kind in KINDS for scenario in scenarios(kind))


@cache
def progress_of(scenario: Scenario) -> RouteProgress:
    """Worked out once for each."""
    return RouteProgress(scenario)
