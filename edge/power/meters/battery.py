"""Power that leaves the robot's battery, from the voltage and current that the robot reports."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Protocol

from edge.power.meters.meter import MeterError, PowerSample

OLDEST_NS: Final = 5_000_000_000


class BatteryReading(Protocol):
    """What a robot says of its battery; `None` for what it does not say."""

    @property
    def received_ns(self) -> int:
        """Monotonic time of the reading."""

    @property
    def soc_percent(self) -> float | None:
        """State of charge."""

    @property
    def voltage_v(self) -> float | None:
        """Voltage of the pack."""

    @property
    def current_a(self) -> float | None:
        """Current; battery managers differ in the sign of discharge."""


ReadBattery = Callable[[], BatteryReading | None]


class BatteryMeter:
    """The whole robot: joints, computer and all. A budget for the computer cannot be held by it."""

    source = "battery"
    caveat: str | None = "the whole robot with its motors, not the computer alone"

    def __init__(self, read: ReadBattery) -> None:
        self._read = read

    def read(self, now_ns: int) -> PowerSample:
        """Voltage times the amount of current, whatever its sign; raises MeterError without a fresh reading."""
        reading = self._read()
        if reading is None or reading.voltage_v is None or reading.current_a is None:
            raise MeterError("battery: the robot reports no voltage and current")
        age_ns = now_ns - reading.received_ns
        if age_ns > OLDEST_NS:
            raise MeterError(f"battery: last reading {age_ns / 1e9:.1f} s ago, expected at most {OLDEST_NS / 1e9:g} s")
        power_w = reading.voltage_v * abs(reading.current_a)
        try:
            return PowerSample(reading.received_ns, power_w, {"battery": power_w}, source=self.source)
        except ValueError as error:
            raise MeterError(f"battery: {error}") from error
