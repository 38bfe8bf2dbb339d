"""The gate: a graph that is not the same model, by the target's own thresholds, does not leave the workshop."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from export.evaluation.metrics import ParityResult
from export.evaluation.task_error import TaskError, short
from export.targets.sections import GraphGate, TaskGate

PASS, WARN, FAIL = "PASS", "WARN", "FAIL"


class GateError(Exception):
    """A graph that is not the same model; its text says which and by how much."""


@dataclass(frozen=True)
class TaskResult:
    """What a graph's rounding does to the robot: the worst moment over all delays of the semantic state."""

    waypoint_cm: float
    heading_deg: float
    speed_mps: float
    turn_radps: float
    relative: float | None
    """Mean deviation as a share of how much the model's own plans vary; None when they do not vary."""
    by_delay_cm: tuple[tuple[float, float], ...]
    """(Δt in s, worst moment's waypoint deviation in cm) in order of Δt."""
    token_agreement: float | None = None
    """Mean share of the first greedy tokens before the first that differs; None for a graph that writes no text."""
    kv_cosine: float = 1.0
    """Of the semantic state to the exact one, lowest over the samples."""
    semantic: float | None = None
    """How far another semantic state moves the exact plans, as a share of how much they vary; None: they do not."""

    @classmethod
    def of(cls, error: TaskError) -> TaskResult:
        """The gate's figures of a measured task error."""
        return cls(
            waypoint_cm=error.waypoint_cm,
            heading_deg=error.heading_deg,
            speed_mps=error.speed_mps,
            turn_radps=error.turn_radps,
            relative=error.relative if math.isfinite(error.relative) else None,
            by_delay_cm=tuple((delay_s, errors.waypoint_mean_cm.max) for delay_s, errors in error.by_delay),
            token_agreement=error.token_agreement,
            kv_cosine=error.kv_cosine,
            semantic=short(error.semantic_cm / error.spread_cm) if error.spread_cm > 0 else None,
        )

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> TaskResult:
        """Inverse of `to_dict`."""
        pairs = tuple((float(delay_s), float(cm)) for delay_s, cm in content["by_delay_cm"])
        return cls(**{**content, "by_delay_cm": pairs})

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON form."""
        return {**vars(self), "by_delay_cm": [list(pair) for pair in self.by_delay_cm]}


@dataclass(frozen=True)
class Verdict:
    """PASS, WARN or FAIL with a line for every threshold that was crossed."""

    level: str
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True)
class GateResult:
    """What the gate found for one graph, where it ran it, and what it made of that."""

    parity: ParityResult
    task: TaskResult | None
    verdict: Verdict
    provider: str
    shipping_provider: str

    def to_dict(self) -> dict[str, Any]:
        """The manifest's `parity` section."""
        return {
            **self.parity.to_dict(),
            "task": None if self.task is None else self.task.to_dict(),
            "verdict": self.verdict.level,
            "reasons": list(self.verdict.reasons),
            "provider": self.provider,
            "shipping_provider_checked": self.provider == self.shipping_provider,
        }


def judge(
    parity: ParityResult, task: TaskResult | None, gate: GraphGate, task_gate: TaskGate, *, trained: bool = True
) -> Verdict:
    """Hold one graph's numbers against its thresholds; a comparison that is not a number fails.

    The logits of untrained weights are nearly ties, which any rounding decides otherwise: there another token warns,
    and text is not compared.
    """
    failed: list[str] = []
    warned: list[str] = []

    def at_least(what: str, found: float, limit: float | None, into: list[str]) -> None:
        if limit is not None and not found >= limit:
            into.append(f"{what} {found:.7g} (≥ {limit:g})")

    def at_most(what: str, found: float, limit: float | None, into: list[str]) -> None:
        if limit is not None and not found <= limit:
            into.append(f"{what} {found:.4g} (≤ {limit:g})")

    at_least("cosine", parity.cosine, gate.min_cosine, failed)
    at_least("cosine", parity.cosine, gate.warn_cosine, warned)
    at_most("max-abs", parity.max_abs, gate.max_abs, failed)
    at_least("difference between inputs", parity.min_difference, gate.min_difference, failed)
    if parity.top1 is not None:
        at_least("same token", parity.top1, gate.top1, failed if trained else warned)
    if task is not None:
        for name, unit in (("waypoint", "cm"), ("heading", "deg")):
            found = getattr(task, f"{name}_{unit}")
            at_most(f"{name} error in {unit}", found, getattr(task_gate, f"{name}_{unit}"), failed)
            at_most(f"{name} error in {unit}", found, getattr(task_gate, f"warn_{name}_{unit}"), warned)
        at_most("speed command error in m/s", task.speed_mps, task_gate.speed_mps, failed)
        at_most("turn command error in rad/s", task.turn_radps, task_gate.turn_radps, failed)
        relative = math.inf if task.relative is None else task.relative
        at_most("deviation as a share of the plans' spread", relative, task_gate.relative, failed)
        at_most("deviation as a share of the plans' spread", relative, task_gate.warn_relative, warned)
        at_least("cosine of the semantic state", task.kv_cosine, task_gate.kv_cosine, failed)
        at_least("cosine of the semantic state", task.kv_cosine, task_gate.warn_kv_cosine, warned)
        if trained and task.token_agreement is not None:
            at_least("share of the same text", task.token_agreement, task_gate.token_agreement, failed)
            at_least("share of the same text", task.token_agreement, task_gate.warn_token_agreement, warned)
        if task.semantic is None or not task.semantic >= task_gate.min_semantic:
            moved = 0.0 if task.semantic is None else task.semantic
            warned.append(
                f"the exact model's plans hardly follow the semantic state: another one moves them by {moved:.2g} of "
                f"their spread (≥ {task_gate.min_semantic:g}), so the task says little about the language model"
            )
    if failed:
        return Verdict(FAIL, tuple(failed))
    return Verdict(WARN, tuple(warned)) if warned else Verdict(PASS)


def worst(verdicts: Mapping[str, Verdict]) -> str:
    """The worst of several graphs' verdicts; raises ValueError without any."""
    return max((verdict.level for verdict in verdicts.values()), key=(PASS, WARN, FAIL).index)


def require(graph: str, verdict: Verdict) -> None:
    """Raise GateError when a graph failed."""
    if verdict.level == FAIL:
        raise GateError(f"{graph}: not the same model: {'; '.join(verdict.reasons)}")
