"""A power reading, the interface of all meters, and the meter that computes power from the plan."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final, Protocol

MEASURED: Final = "measured"
MODELLED: Final = "modelled"
MOST_W: Final = 2000.0
"""Largest plausible reading, W: no supported device draws more."""


class MeterError(RuntimeError):
    """A missing or unreadable meter; the message is one line."""


@dataclass(frozen=True)
class PowerSample:
    """Power at one instant, W. Raises MeterError for a total that no meter can have read."""

    stamp_ns: int
    """Monotonic time of the reading."""
    total_w: float
    rails: Mapping[str, float] = field(default_factory=dict)
    """Power of every rail; rails may feed one another, so the sum can differ from the total."""
    tagged: str = MEASURED
    source: str = ""
    """Meter, and the coverage of its total."""

    def __post_init__(self) -> None:
        if not is_power(self.total_w):
            source = self.source or "power meter"
            raise MeterError(f"{source}: expected 0 to {MOST_W:g} W, found {self.total_w} W")


class PowerMeter(Protocol):
    """A power meter; reading may be slow and may fail, so only a separate thread reads it."""

    @property
    def source(self) -> str:
        """Meter, and the coverage of its total."""

    @property
    def caveat(self) -> str | None:
        """Consumers outside the total, in one line; None: no known ones."""

    def read(self, now_ns: int) -> PowerSample:
        """Read one sample; raises MeterError."""


def is_power(value: float) -> bool:
    """Return whether a reading in W is plausible: finite, not negative, at most `MOST_W`."""
    return math.isfinite(value) and 0.0 <= value <= MOST_W


class BatteryReading(Protocol):
    """A robot's battery report; None for a value that it does not report."""

    @property
    def received_ns(self) -> int:
        """Monotonic time of the reading."""

    @property
    def soc_percent(self) -> float | None:
        """State of charge."""


ReadBattery = Callable[[], BatteryReading | None]


class ModelledMeter:
    """Meter that computes idle power plus the energy since the last reading from the plan's figures."""

    source = "the plan's model"
    caveat: str | None = "not a measurement"

    def __init__(self, idle_w: float, energy_j: Callable[[], float]) -> None:
        """`energy_j()` returns the modelled energy above idle so far, J."""
        self._idle_w = idle_w
        self._energy_j = energy_j
        self._last: tuple[int, float] | None = None
        self._power_w = idle_w

    def read(self, now_ns: int) -> PowerSample:
        """Return the mean power since the previous reading; raises MeterError when the model gives no power."""
        energy_j = self._energy_j()
        if self._last is not None and now_ns > self._last[0]:
            self._power_w = self._idle_w + (energy_j - self._last[1]) * 1e9 / (now_ns - self._last[0])
        self._last = (now_ns, energy_j)
        return PowerSample(now_ns, self._power_w, {}, MODELLED, self.source)
