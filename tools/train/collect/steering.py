"""Who steers, beside the expert: disturbances now and then, or the policy that is being taught."""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, sqrt
from typing import Final

import numpy as np

from tools.train.config.collect import RATE_HZ
from tools.train.drives.drive import EXPERT, NOISE, POLICY

Velocity = tuple[float, float, float]

_SPEED_MPS: Final = (-0.3, 1.1)  # what a disturbed command may be: no further than a robot's own limits go
_TURN_RADPS: Final = 1.2


@dataclass(frozen=True)
class NoiseLook:
    """Bursts of a disturbance: an Ornstein-Uhlenbeck process on the forward speed and on the turning rate."""

    burst_s: tuple[float, float] = (0.5, 2.0)
    pause_s: tuple[float, float] = (2.0, 10.0)
    keep_s: float = 0.7
    """How long a disturbance stays alike."""
    speed_mps: float = 0.3
    turn_radps: float = 0.6


class SteeringNoise:
    """Disturbs the expert's command in bursts; the same generator's state gives the same bursts."""

    def __init__(self, rng: np.random.Generator, look: NoiseLook | None = None) -> None:
        self._rng = rng
        self._look = look if look is not None else NoiseLook()
        self._left = -self._ticks(self._look.pause_s)  # below zero: ticks of pause to go, above: of burst
        self._offset = np.zeros(2)

    def _ticks(self, bounds_s: tuple[float, float]) -> int:
        return max(1, round(float(self._rng.uniform(*bounds_s)) * RATE_HZ))

    def command(self, wanted: Velocity) -> tuple[Velocity, int]:
        """What is commanded instead of `wanted`, and whether it is EXPERT's or NOISE."""
        look = self._look
        sigma = np.array((look.speed_mps, look.turn_radps))
        if self._left < 0:
            self._left += 1
            if self._left < 0:
                return wanted, EXPERT
            self._left = self._ticks(look.burst_s)
            self._offset = sigma * self._rng.standard_normal(2)
        keep = exp(-1 / RATE_HZ / look.keep_s)
        self._offset = keep * self._offset + sqrt(1 - keep * keep) * sigma * self._rng.standard_normal(2)
        self._left -= 1
        if self._left == 0:
            self._left = -self._ticks(look.pause_s)
        speed = min(max(wanted[0] + float(self._offset[0]), _SPEED_MPS[0]), _SPEED_MPS[1])
        turn = min(max(wanted[2] + float(self._offset[1]), -_TURN_RADPS), _TURN_RADPS)
        return (speed, wanted[1], turn), NOISE


class Shared:
    """The policy drives, and the expert in stretches: each stretch is the expert's with the chance `beta` (DAgger)."""

    STRETCH_S: Final = (2.0, 5.0)

    def __init__(self, rng: np.random.Generator, beta: float) -> None:
        if not 0 <= beta <= 1:
            raise ValueError(f"expected a chance of 0 to 1 for the expert, found {beta}")
        self._rng = rng
        self._beta = beta
        self._left = 0
        self._expert = False

    def command(self, wanted: Velocity, policys: Velocity) -> tuple[Velocity, int]:
        """What is commanded, of what the expert wants and what the policy says, and whose it is: EXPERT or POLICY."""
        if self._left == 0:
            self._left = max(1, round(float(self._rng.uniform(*self.STRETCH_S)) * RATE_HZ))
            self._expert = bool(self._rng.uniform() < self._beta)
        self._left -= 1
        return (wanted, EXPERT) if self._expert else (policys, POLICY)
