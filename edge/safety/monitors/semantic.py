"""Checks the semantic state: its age, its text, and the failures of generations."""

from __future__ import annotations

from dataclasses import dataclass

from edge.safety.faults.findings import Finding
from edge.state.semantic import SemanticState

INVALID_IN_A_ROW = 3
_MAX_REPORTED_FAILURES = 5


@dataclass(frozen=True)
class SemanticConfig:
    """Permitted age of the semantic state. At `trained_delay_s` the speed begins to fall, `fade_s` later it is zero."""

    trained_delay_s: float = 10.0
    """The largest Δt that the policy was trained for (the targets' runtime.max_delay_s)."""
    fade_s: float = 5.0
    judge_text: bool = False
    """Whether three invalid texts in a row stop the robot; False for an untrained model."""

    def __post_init__(self) -> None:
        if not (0 < self.trained_delay_s <= 600 and 0 < self.fade_s <= 600):
            raise ValueError(f"semantic ages must be 0 to 600 s, found {self.trained_delay_s} and {self.fade_s}")


class SemanticMonitor:
    """Keeps the last generation and the count of invalid texts in a row."""

    def __init__(self, config: SemanticConfig) -> None:
        self._config = config
        self._generation: int | None = None
        self._invalid = 0
        self._failed = 0

    def step(self, semantic: SemanticState | None, failed: int, now_ns: int, invalid: int = 0) -> tuple[Finding, ...]:
        """Check the newest semantic state; `failed` counts the failed generations so far.

        `invalid`: number of texts in a row, up to now, that do not follow the grammar. A policy that is guided by
        waypoints never receives such a text, so the state does not show it.
        """
        findings: list[Finding] = []
        for _ in range(min(failed - self._failed, _MAX_REPORTED_FAILURES)):
            findings.append(Finding("reasoning-failed", f"{failed} in this run"))
        self._failed = max(self._failed, failed)
        self._count(semantic)
        if self._config.judge_text and max(self._invalid, invalid) >= INVALID_IN_A_ROW:
            findings.append(Finding("semantic-text-invalid"))
        if semantic is None:
            return tuple(findings)
        delay_s = semantic.delay_s(now_ns)
        over_s = delay_s - self._config.trained_delay_s
        if delay_s < 0:
            findings.append(Finding("semantic-delay-invalid", f"{-delay_s:.3f} s ahead"))
        elif over_s >= self._config.fade_s:
            findings.append(Finding("semantic-expired", f"{delay_s:.1f} s old"))
        elif over_s > 0:
            findings.append(Finding("semantic-old", f"{delay_s:.1f} s old", 1 - over_s / self._config.fade_s))
        return tuple(findings)

    def _count(self, semantic: SemanticState | None) -> None:
        if semantic is None:
            self._invalid = 0  # what was decided from those texts drives nothing any more
        if semantic is None or semantic.generation == self._generation:
            return
        self._generation = semantic.generation
        if semantic.waypoints is not None:
            self._invalid = 0
        elif semantic.text_complete:  # a text that was cut short proves nothing about the model
            self._invalid += 1
