"""Signals of a DBC file as numbers in SI units: a few integer operations a signal, defined for all bytes. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

UNITS: Final = {
    "speed": {"m/s": 1.0, "mm/s": 1e-3, "cm/s": 1e-2, "km/h": 1 / 3.6},
    "rotation": {
        "rad/s": 1.0,
        "mrad/s": 1e-3,
        "deg/s": math.pi / 180,
        "rpm": math.tau / 60,
        "1/min": math.tau / 60,
    },
    "length": {"m": 1.0, "mm": 1e-3, "cm": 1e-2},
    "angle": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180},
    "time": {"s": 1.0, "ms": 1e-3},
    "share": {"%": 1.0},
    "voltage": {"V": 1.0, "mV": 1e-3},
    "current": {"A": 1.0, "mA": 1e-3},
}
"""Units of each kind of quantity, as the DBC file writes them, in SI units (charge in percent)."""


@dataclass(frozen=True)
class Signal:
    """One signal: its bits in a message of `length` bytes, and its physical value raw * `scale` + `offset`.

    `shift`: position of the lowest bit in the message read as one integer, whose byte order is `order`.
    """

    message: str
    name: str
    length: int
    shift: int
    bits: int
    order: str
    signed: bool
    scale: float
    offset: float
    low: float
    high: float
    kind: str = ""  # of UNITS

    def __str__(self) -> str:
        return f"{self.message}.{self.name}"

    def raw(self, data: bytes) -> int:
        """Return the signal's bits as an integer; `data` has `length` bytes."""
        whole = int.from_bytes(data, "big" if self.order == "big" else "little")
        value = whole >> self.shift & ((1 << self.bits) - 1)
        return value - (1 << self.bits) if self.signed and value >> (self.bits - 1) else value

    def decode(self, data: bytes) -> float | None:
        """Return the physical value; None if it is outside the DBC's range, as an invalid value is."""
        value = self.raw(data) * self.scale + self.offset
        slack = abs(self.scale) / 2
        return value if self.low - slack <= value <= self.high + slack else None

    def encode(self, value: float) -> int:
        """Return the bits of a finite value at their place in the message, clipped to the DBC's range."""
        clipped = min(max(value, self.low), self.high)
        raw = round((clipped - self.offset) / self.scale)
        least = -(1 << (self.bits - 1)) if self.signed else 0
        raw = min(max(raw, least), least + (1 << self.bits) - 1)
        return (raw & ((1 << self.bits) - 1)) << self.shift
