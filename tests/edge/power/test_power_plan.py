"""The power plan of a manifest: numbers that no device and no policy can have are refused in one line."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest

from edge.artifacts.files import ArtifactError
from edge.power.governor.governor import Governor, GovernorConfig
from edge.power.governor.plan import STAGES, power_plan
from edge.safety.monitors.semantic import SemanticConfig

Edit = Callable[[dict[str, Any]], object]


def manifest() -> dict[str, Any]:
    """The parts of a manifest that the power plan needs."""
    stages = {name: {"energy_j": 1.0, "ms": 10.0, "calls": 5} for name in STAGES}
    return {
        "plan": {
            "max_delay_s": 10.0, "period_ms": 100, "generation_alone_ms": 50.0, "generation_ms": 60.0,
            "per_graph": stages,
        },
        "provenance": {
            "target": {
                "power": {"meter": "rapl", "budget_w": 25.0, "idle_w": {"value": 5.0}},
                "runtime": {"max_delay_s": 10.0},
            }
        },
    }  # fmt: skip


def stage(name: str, **values: object) -> Edit:
    return lambda m: m["plan"]["per_graph"][name].update(values)


def test_a_whole_plan_is_taken_by_governor_and_monitor() -> None:
    plan = power_plan(manifest(), 48)
    assert plan.model is not None and plan.model.period_s == pytest.approx(0.1)
    Governor(GovernorConfig(plan.budget_w, plan.max_new_tokens, plan.max_delay_s, plan.model))
    SemanticConfig(trained_delay_s=plan.max_delay_s)


@pytest.mark.parametrize(
    "change",
    [
        stage("decode", calls=math.inf), stage("decode", calls=10**400), stage("prefill", ms=10**400),
        stage("prefill", energy_j=1e300), stage("prefill", energy_j=-1.0), stage("prefill", energy_j=math.inf),
        lambda m: [stage(name, ms=0)(m) for name in ("prefill", "semantic_context")],
        lambda m: m["plan"].update(period_ms=1e-300), lambda m: m["plan"].update(generation_alone_ms=0),
        lambda m: m["plan"].update(max_delay_s=600.0), lambda m: m["plan"].update(max_delay_s="long"),
        lambda m: m["provenance"]["target"]["power"].update(budget_w=-5),
        lambda m: m["provenance"]["target"]["power"]["idle_w"].update(value=1e9),
    ],
)  # fmt: skip
def test_a_plan_with_an_impossible_number_is_refused_in_one_line(change: Edit) -> None:
    damaged = manifest()
    change(damaged)
    with pytest.raises(ArtifactError) as refusal:
        power_plan(damaged, 48)
    assert str(refusal.value).startswith("manifest.json: ") and "\n" not in str(refusal.value)
