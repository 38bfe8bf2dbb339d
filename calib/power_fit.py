"""Energy of each stage from average power of phases that ran different mixtures of them; pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from edge.power.governor.plan import STAGES

MIN_R2: Final = 0.9
MAX_CHECK_ERROR: Final = 0.15
"""Thresholds of ours: below, the fit predicts too little of what a run will draw."""
_SWEEPS: Final = 20_000


class FitError(ValueError):
    """Phases from which nothing can be fitted; its text is the one line to show."""


@dataclass(frozen=True)
class Phase:
    """What ran during a time, and the energy that the meter gave for it."""

    name: str
    seconds: float
    energy_j: float
    counts: Mapping[str, float]
    check: bool = False
    """Left out of the fit, to test it: a mixture as in a run."""

    def __post_init__(self) -> None:
        if not (self.seconds > 0 and np.isfinite(self.energy_j)):
            raise FitError(f"phase {self.name}: {self.seconds} s and {self.energy_j} J, expected a time and an energy")
        unknown = sorted(set(self.counts) - set(STAGES))
        if unknown:
            raise FitError(f"phase {self.name}: {unknown[0]!r} is no stage")

    @property
    def power_w(self) -> float:
        """Average power."""
        return self.energy_j / self.seconds


@dataclass(frozen=True)
class Fit:
    """Idle power and energy above it of one unit of each stage, with standard errors, and how far to trust them."""

    idle_w: float
    idle_error_w: float
    stage_j: Mapping[str, float]
    error_j: Mapping[str, float]
    r2: float
    """Share of the variation of power between phases that the fit explains."""
    check_error: float
    """Largest relative error of the power of a phase that was left out."""

    def power_w(self, phase: Phase) -> float:
        """Power of a phase by the fit, W."""
        return self.idle_w + sum(self.stage_j[name] * n for name, n in phase.counts.items()) / phase.seconds

    @property
    def weak(self) -> tuple[str, ...]:
        """Why the fit must not be used; empty when it may."""
        reasons = []
        if not self.r2 >= MIN_R2:
            reasons.append(f"the fit explains {self.r2:.2f} of the variation of power, expected {MIN_R2} or more")
        if not self.check_error <= MAX_CHECK_ERROR:
            reasons.append(
                f"it misses a mixture that it was not fitted to by {100 * self.check_error:.0f} %, "
                f"expected at most {100 * MAX_CHECK_ERROR:.0f} %"
            )
        return tuple(reasons)

    def to_dict(self) -> dict[str, Any]:
        """Return the fit as JSON values."""
        return {
            "idle_w": self.idle_w,
            "idle_error_w": self.idle_error_w,
            "stage_j": dict(self.stage_j),
            "error_j": dict(self.error_j),
            "r2": self.r2,
            "check_error": self.check_error,
        }


def fit_energy(phases: Sequence[Phase]) -> Fit:
    """Least squares on average power with nothing below zero; raises FitError when phases do not tell stages apart."""
    fitted = [phase for phase in phases if not phase.check]
    design = np.array(
        [[1.0, *(phase.counts.get(name, 0.0) / phase.seconds for name in STAGES)] for phase in fitted]
    ).reshape(-1, 1 + len(STAGES))
    power = np.array([phase.power_w for phase in fitted])
    scale = np.linalg.norm(design, axis=0) if len(fitted) else np.zeros(1 + len(STAGES))
    missing = [name for name, norm in zip(("idle", *STAGES), scale, strict=True) if norm == 0]
    if missing or np.linalg.matrix_rank(design / scale) < design.shape[1]:
        what = ", ".join(missing) or "all of them, each in another mixture"
        raise FitError(f"{len(fitted)} phases do not tell the stages apart: run {what}")
    solution = non_negative(design / scale, power) / scale
    residual = power - design @ solution
    freedom = max(1, len(fitted) - design.shape[1])
    covariance = np.linalg.inv((design / scale).T @ (design / scale)) * float(residual @ residual) / freedom
    errors = np.sqrt(np.diag(covariance)) / scale
    spread = float(((power - power.mean()) ** 2).sum())
    found = Fit(
        idle_w=float(solution[0]),
        idle_error_w=float(errors[0]),
        stage_j={name: float(value) for name, value in zip(STAGES, solution[1:], strict=True)},
        error_j={name: float(value) for name, value in zip(STAGES, errors[1:], strict=True)},
        r2=1.0 - float(residual @ residual) / spread if spread > 0 else 0.0,
        check_error=0.0,
    )
    checks = [abs(found.power_w(p) - p.power_w) / p.power_w for p in phases if p.check and p.power_w > 0]
    return Fit(**{**vars(found), "check_error": max(checks, default=float("inf"))})


def non_negative(
    design: npt.NDArray[np.float64], target: npt.NDArray[np.float64], tolerance: float = 1e-12
) -> npt.NDArray[np.float64]:
    """x ≥ 0 that minimises |design x − target|², by cyclic coordinate descent: the problem is convex and small."""
    gram, moment = design.T @ design, design.T @ target
    solution = np.zeros(design.shape[1])
    for _ in range(_SWEEPS):
        before = solution.copy()
        for i in range(len(solution)):
            step = (moment[i] - float(gram[i] @ solution)) / gram[i, i]
            solution[i] = max(0.0, solution[i] + step)
        if np.abs(solution - before).max() <= tolerance * max(1.0, float(np.abs(solution).max())):
            break
    return solution
