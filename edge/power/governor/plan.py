"""The power plan in a manifest: the meter, the budget and the modelled energy of every stage."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from edge.artifacts.files import MANIFEST_NAME, SEAL, ArtifactError, read_manifest
from edge.artifacts.manifest import Artifacts
from edge.artifacts.runtime import check_plan
from edge.power.meters.meter import MEASURED, MODELLED

STAGES: Final = ("vision_encoder", "action_expert", "prefill", "decode", "semantic_context")
"""Units of their counts: calls, calls, whole prompts, new tokens, calls."""
MOST: Final = 1e6
"""Largest plausible number of a power model, W, s or J."""
LEAST_S: Final = 1e-6
"""Smallest plausible duration of a period and a generation, s: no power above idle becomes infinite."""


@dataclass(frozen=True)
class PowerModel:
    """Energy above idle of a tick and of a generation's parts, and a generation's duration beside control."""

    idle_w: float
    period_s: float
    encode_j: float
    act_j: float
    prefill_j: float
    """The whole prompt."""
    token_j: float
    """One new token."""
    context_j: float
    before_text_s: float
    """Duration of a generation without new tokens, s: prefill and semantic context."""
    token_s: float
    tagged: str = MODELLED

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name != "tagged" and not 0 <= value <= MOST:
                raise ValueError(f"{name} must be 0 to {MOST:g}, found {value}")
        if min(self.period_s, self.before_text_s) < LEAST_S:
            raise ValueError(f"period_s and before_text_s must be at least {LEAST_S:g} s")
        if self.tagged not in (MEASURED, MODELLED):
            raise ValueError(f"tagged must be {MEASURED} or {MODELLED}, found {self.tagged!r}")

    @property
    def control_w(self) -> float:
        """Return the additional power of control above idle, W."""
        return (self.encode_j + self.act_j) / self.period_s

    def generation_s(self, tokens: int) -> float:
        """Return a generation's duration with that many new tokens, beside control, s."""
        return self.before_text_s + self.token_s * tokens

    def generation_j(self, tokens: int) -> float:
        """Return its energy above idle, J."""
        return self.prefill_j + self.context_j + self.token_j * tokens

    def reasoning_w(self, tokens: int) -> float:
        """Return the additional power of a running generation above idle and control, W."""
        return self.generation_j(tokens) / self.generation_s(tokens)


@dataclass(frozen=True)
class PowerPlan:
    """The target's power measurement and limit."""

    meter: str
    rail: str | None
    budget_w: float | None
    max_delay_s: float
    max_new_tokens: int
    model: PowerModel | None
    """None: the target has no power figures."""


def read_power_plan(artifacts: Artifacts) -> PowerPlan:
    """Read the power plan of verified artifacts; raises ArtifactError."""
    manifest = read_manifest(artifacts.directory)
    if manifest[SEAL] != artifacts.manifest_sha256:
        raise ArtifactError(f"{artifacts.directory / MANIFEST_NAME}: changed while it was being opened; start again")
    return power_plan(manifest, artifacts.runtime.max_new_tokens)


def power_plan(manifest: Mapping[str, Any], max_new_tokens: int) -> PowerPlan:
    """Build the power plan from a manifest's `plan` and its target's `power`; raises ArtifactError."""
    check_plan(manifest)
    try:
        plan = manifest["plan"]
        target = manifest["provenance"].get("target", {})
        power = target.get("power", {})
        budget_w = power.get("budget_w")
        return PowerPlan(
            meter=str(power.get("meter", "none")),
            rail=power.get("rail"),
            budget_w=None if budget_w is None else float(budget_w),
            max_delay_s=float(plan.get("max_delay_s", math.inf)),
            max_new_tokens=max_new_tokens,
            model=_model(plan, power),
        )
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError, ZeroDivisionError) as error:
        raise ArtifactError(f"{MANIFEST_NAME}: plan or target lacks what the power budget needs ({error!r})") from error


def _model(plan: Mapping[str, Any], power: Mapping[str, Any]) -> PowerModel | None:
    stages, idle = plan.get("per_graph", {}), power.get("idle_w")
    if idle is None or any(stages.get(name, {}).get("energy_j") is None for name in STAGES):
        return None
    joules = {name: float(stages[name]["energy_j"]) for name in STAGES}
    seconds = {name: float(stages[name]["ms"]) / 1e3 for name in STAGES}
    # Control slows all parts of a generation equally.
    alone_ms, beside_ms = float(plan["generation_alone_ms"]), plan["generation_ms"]
    slower = 1.0 if beside_ms is None else float(beside_ms) / alone_ms
    tokens = int(stages["decode"]["calls"])
    measured = all(stages[name].get("energy_tagged") == MEASURED for name in STAGES)
    return PowerModel(
        idle_w=float(idle["value"]),
        period_s=float(plan["period_ms"]) / 1e3,
        encode_j=joules["vision_encoder"],
        act_j=joules["action_expert"],
        prefill_j=joules["prefill"],
        token_j=joules["decode"] / tokens if tokens else 0.0,
        context_j=joules["semantic_context"],
        before_text_s=(seconds["prefill"] + seconds["semantic_context"]) * slower,
        token_s=seconds["decode"] * slower / tokens if tokens else 0.0,
        tagged=MEASURED if measured and idle.get("tag") == MEASURED else MODELLED,
    )
