"""Is the robot fit to be driven? Age and rate of its state, attitude, battery."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Protocol

from edge.findings import Finding
from edge.pose_history import StampedPose

TIPPED_RAD = math.radians(30.0)
LINK_WINDOW_NS = 2_000_000_000
LOSSY = 0.65
"""Share of the state messages of the first seconds: 10 % lost is no fault, half of them is (fault matrix, row 35)."""
BATTERY_HOLD_NS = 2_000_000_000
"""A battery's voltage sags under load: only what it says for this long counts."""


class Attitude(Protocol):
    """What the monitor reads of the robot's state."""

    @property
    def received_ns(self) -> int:
        """When it arrived."""

    @property
    def roll_rad(self) -> float:
        """About the forward axis."""

    @property
    def pitch_rad(self) -> float:
        """About the left axis."""


class Charge(Protocol):
    """What the monitor reads of the robot's battery."""

    @property
    def soc_percent(self) -> float:
        """State of charge."""


@dataclass(frozen=True)
class RobotWatchConfig:
    """When the robot's state is late, when it is too old, and how low the battery may be."""

    late_ms: float = 100.0
    stale_ms: float = 150.0
    """With a tick of 100 ms, its own duration and a bridge of 20 ms this keeps zero below 300 ms."""
    battery_low_percent: float = 20.0
    battery_empty_percent: float = 10.0

    def __post_init__(self) -> None:
        if not 0 < self.late_ms <= self.stale_ms:
            raise ValueError(f"expected 0 < late_ms ≤ stale_ms, found {self.late_ms} and {self.stale_ms}")
        if not 0 <= self.battery_empty_percent <= self.battery_low_percent <= 100:
            raise ValueError("expected 0 ≤ battery_empty_percent ≤ battery_low_percent ≤ 100")


class RobotMonitor:
    """Remembers how many state messages came and since when the battery has been low."""

    def __init__(self, config: RobotWatchConfig) -> None:
        self._config = config
        self._counts: deque[tuple[int, int]] = deque(maxlen=64)
        self._expected: float | None = None
        self._low_since_ns: int | None = None
        self._empty_since_ns: int | None = None

    def tilt(self, attitude: Attitude | None) -> tuple[Finding, ...]:
        """Tipped over or not; cheap enough to be asked between ticks."""
        if attitude is None or max(abs(attitude.roll_rad), abs(attitude.pitch_rad)) <= TIPPED_RAD:
            return ()
        roll, pitch = math.degrees(attitude.roll_rad), math.degrees(attitude.pitch_rad)
        return (Finding("tipped-over", f"roll {roll:.0f}°, pitch {pitch:.0f}°"),)

    def step(
        self, pose: StampedPose | None, states: int | None, battery: Charge | None, now_ns: int
    ) -> tuple[Finding, ...]:
        """Judge the newest pose, the count of state messages so far, and the battery; None: not known."""
        findings: list[Finding] = []
        age_ms = None if pose is None else (now_ns - pose.stamp_ns) / 1e6
        if age_ms is None or not 0 <= age_ms <= self._config.stale_ms:
            findings.append(Finding("odometry-stale", "no pose yet" if age_ms is None else f"{age_ms:.0f} ms old"))
        elif age_ms > self._config.late_ms:
            findings.append(Finding("odometry-late", f"{age_ms:.0f} ms old"))
        if states is not None:
            self._judge_link(states, now_ns, findings)
        if battery is not None:
            self._judge_battery(battery.soc_percent, now_ns, findings)
        return tuple(findings)

    def _judge_link(self, states: int, now_ns: int, findings: list[Finding]) -> None:
        self._counts.append((now_ns, states))
        while len(self._counts) > 1 and now_ns - self._counts[1][0] >= LINK_WINDOW_NS:
            self._counts.popleft()
        first_ns, first = self._counts[0]
        if now_ns - first_ns < LINK_WINDOW_NS:
            return
        rate_hz = (states - first) * 1e9 / (now_ns - first_ns)
        if self._expected is None:
            self._expected = rate_hz
        elif rate_hz < LOSSY * self._expected:
            findings.append(Finding("link-lossy", f"{rate_hz:.0f} of {self._expected:.0f} messages a second"))

    def _judge_battery(self, soc_percent: float, now_ns: int, findings: list[Finding]) -> None:
        config = self._config
        # A charge that is no number is not known, and a robot whose charge is not known is not driven on.
        empty = not soc_percent >= config.battery_empty_percent
        low = not soc_percent >= config.battery_low_percent
        self._empty_since_ns = (self._empty_since_ns or now_ns) if empty else None
        self._low_since_ns = (self._low_since_ns or now_ns) if low else None
        detail = f"{soc_percent:.0f} %"
        if self._empty_since_ns is not None and now_ns - self._empty_since_ns >= BATTERY_HOLD_NS:
            findings.append(Finding("battery-empty", detail))
        elif self._low_since_ns is not None and now_ns - self._low_since_ns >= BATTERY_HOLD_NS:
            findings.append(Finding("battery-low", detail))
