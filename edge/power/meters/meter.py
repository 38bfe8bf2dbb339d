"""What every power meter gives: one sample of the whole, its rails, and whether it was measured."""

from __future__ import annotations

import math
from collections.abc import Mapping
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
    """Power at one instant, in W."""

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
            raise ValueError(f"total_w must be 0 to {MOST_W:g} W, found {self.total_w}")
        if self.tagged not in (MEASURED, MODELLED):
            raise ValueError(f"tagged must be {MEASURED} or {MODELLED}, found {self.tagged!r}")


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


def is_power(value: float | None) -> bool:
    """A number of W that a meter may give: finite, not negative, not absurd."""
    return value is not None and math.isfinite(value) and 0.0 <= value <= MOST_W
