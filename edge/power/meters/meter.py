"""One reading of a power meter, what every meter offers, and the meter that computes power from the plan instead."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Final, Protocol

MEASURED: Final = "measured"
MODELLED: Final = "modelled"
MOST_W: Final = 2000.0
"""Above it a reading is a fault of the meter: no device that this program runs on takes as much."""


class MeterError(RuntimeError):
    """A meter that is not there or cannot be read; its text is the one line to show."""


@dataclass(frozen=True)
class PowerSample:
    """Power at one instant, W. Raises MeterError for a total that no meter can have read."""

    stamp_ns: int
    """Monotonic time of the reading."""
    total_w: float
    rails: Mapping[str, float] = field(default_factory=dict)
    """Every rail that was read; they need not add up to the total, since rails may feed one another."""
    tagged: str = MEASURED
    source: str = ""
    """Which meter, and what its total covers."""

    def __post_init__(self) -> None:
        if not is_power(self.total_w):
            source = self.source or "power meter"
            raise MeterError(f"{source}: expected 0 to {MOST_W:g} W, found {self.total_w} W")


class PowerMeter(Protocol):
    """Reads power; may be slow and may fail, so it is only read from a thread of its own."""

    @property
    def source(self) -> str:
        """Which meter, and what its total covers."""

    @property
    def caveat(self) -> str | None:
        """What the total leaves out, in one line; None: nothing that is known."""

    def read(self, now_ns: int) -> PowerSample:
        """One sample; raises MeterError."""


def is_power(value: float) -> bool:
    """Whether a meter can have read this many W: finite, not negative, at most `MOST_W`."""
    return math.isfinite(value) and 0.0 <= value <= MOST_W


class BatteryReading(Protocol):
    """What a robot reports of its battery; None for what it does not report."""

    @property
    def received_ns(self) -> int:
        """Monotonic time of the reading."""

    @property
    def soc_percent(self) -> float | None:
        """State of charge."""


ReadBattery = Callable[[], BatteryReading | None]


class ModelledMeter:
    """Idle power and the energy of what has run since the last reading, by the plan's figures."""

    source = "the plan's model"
    caveat: str | None = "not a measurement"

    def __init__(self, idle_w: float, energy_j: Callable[[], float]) -> None:
        """`energy_j()` is the modelled energy above idle of everything that has run so far."""
        self._idle_w = idle_w
        self._energy_j = energy_j
        self._last: tuple[int, float] | None = None
        self._power_w = idle_w

    def read(self, now_ns: int) -> PowerSample:
        """Mean power since the previous reading; raises MeterError when the model gives no power."""
        energy_j = self._energy_j()
        if self._last is not None and now_ns > self._last[0]:
            self._power_w = self._idle_w + (energy_j - self._last[1]) * 1e9 / (now_ns - self._last[0])
        self._last = (now_ns, energy_j)
        return PowerSample(now_ns, self._power_w, {}, MODELLED, self.source)
