"""The device that a manifest was made for: the target's figures and the plan, checked as they are read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from edge.artifacts.files import MANIFEST_NAME, ArtifactError
from edge.artifacts.runtime import MAX_CORES

GIB = 1 << 30
MAX_MEMORY_BYTES = 16384 * GIB
MAX_NUMBER = 2.0**53
"""Largest number of a target or a plan, and its negative: a larger one has no exact float, or rounds to infinity."""
MAX_PLANNED = 10_000_000
"""Largest plausible duration of a plan, ms (2.8 h), and number of tokens."""


@dataclass(frozen=True)
class TargetFacts:
    """The device that artifacts were exported for (`provenance.target`)."""

    name: str
    architectures: tuple[str, ...]
    cores: int
    memory_bytes: int
    """Memory that the model shares with all programs; a graphics card's own memory where it has one."""
    available_bytes: int
    """Part of it that is available to this program."""
    min_l4t: str | None
    power_mode: str
    budget_w: float | None
    own_memory: bool = False
    """Whether the memory is a graphics card's own; the machine's is then unknown."""

    def __post_init__(self) -> None:
        if not self.name or not self.architectures or not self.power_mode:
            raise ArtifactError(f"{MANIFEST_NAME}: provenance.target names no device, architecture or power mode")
        if not (1 <= self.cores <= MAX_CORES and 0 < self.available_bytes <= self.memory_bytes <= MAX_MEMORY_BYTES):
            raise ArtifactError(
                f"{MANIFEST_NAME}: provenance.target has {self.cores} cores, {self.available_bytes} of "
                f"{self.memory_bytes} bytes available: expected positive numbers of a device that exists"
            )


@dataclass(frozen=True)
class PlanFacts:
    """The plan's expectations of the device (`plan`)."""

    period_ms: float
    tick_ms: float
    """Duration of a tick during reasoning."""
    tick_alone_ms: float
    tick_error: float
    """Relative half width of the tick's error bar; 0 if the plan gives none."""
    prompt_tokens: int
    memory_bytes: int
    tagged: str
    """`measured` or `modelled`."""

    def __post_init__(self) -> None:
        for name in ("period_ms", "tick_ms", "tick_alone_ms", "prompt_tokens", "memory_bytes"):
            value, most = getattr(self, name), MAX_MEMORY_BYTES if name == "memory_bytes" else MAX_PLANNED
            if not 0 < value <= most:
                raise ArtifactError(f"{MANIFEST_NAME}: plan.{name} must be positive and at most {most}, found {value}")


def target_facts(manifest: Mapping[str, Any]) -> TargetFacts | None:
    """Facts of a manifest's target; None where it was written without one. Raises ArtifactError."""
    target = _mapping(manifest, "provenance").get("target")
    if target is None:
        return None
    if not isinstance(target, dict):
        raise ArtifactError(f"{MANIFEST_NAME}: provenance.target must be an object")
    device, power = _mapping(target, "device"), _mapping(target, "power")
    memory_gib, reserved_gib = _number(device, "memory_gib"), _number(device, "reserved_gib")
    architectures = target.get("arch")
    if not isinstance(architectures, list) or not all(isinstance(name, str) for name in architectures):
        raise ArtifactError(f"{MANIFEST_NAME}: provenance.target.arch must be a list of names")
    return TargetFacts(
        name=_text(target, "name") or "",
        architectures=tuple(architectures),
        cores=round(_number(device, "cores")),
        memory_bytes=round(memory_gib * GIB),
        available_bytes=round((memory_gib - reserved_gib) * GIB),
        min_l4t=_text(device, "min_l4t"),
        power_mode=_text(power, "mode") or "",
        budget_w=None if power.get("budget_w") is None else _number(power, "budget_w"),
        # Jetsons are the only graphics processors here that compute in the machine's own memory.
        own_memory=_text(device, "compute_capability") is not None and _text(device, "min_l4t") is None,
    )


def plan_facts(manifest: Mapping[str, Any]) -> PlanFacts | None:
    """Facts of a manifest's plan; None where it was written without one. Raises ArtifactError."""
    plan = _mapping(manifest, "plan")
    if not plan:
        return None
    return PlanFacts(
        period_ms=_number(plan, "period_ms"),
        tick_ms=_number(plan, "tick_ms"),
        tick_alone_ms=_number(plan, "tick_alone_ms"),
        tick_error=0.0 if plan.get("tick_error") is None else _number(plan, "tick_error"),
        prompt_tokens=round(_number(plan, "prompt_tokens")),
        memory_bytes=round(_number(plan, "memory_bytes")),
        tagged=_text(plan, "tagged") or "modelled",
    )


def _mapping(holder: Mapping[str, Any], key: str) -> dict[str, Any]:
    value = holder.get(key)
    if not isinstance(value, dict):
        raise ArtifactError(f"{MANIFEST_NAME}: {key} must be an object; export again")
    return value


def _number(holder: Mapping[str, Any], key: str) -> float:
    value = holder.get(key)
    if not isinstance(value, int | float) or isinstance(value, bool) or not -MAX_NUMBER <= value <= MAX_NUMBER:
        raise ArtifactError(f"{MANIFEST_NAME}: {key} must be a number up to 2^53, found {value!r}; export again")
    return float(value)


def _text(holder: Mapping[str, Any], key: str) -> str | None:
    value = holder.get(key)
    if value is not None and not isinstance(value, str):
        raise ArtifactError(f"{MANIFEST_NAME}: {key} must be text, found {value!r}; export again")
    return value
