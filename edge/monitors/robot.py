"""Is the robot fit to be driven? Age and rate of its state, and its attitude. (Its battery: `edge.power`.)"""

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


@dataclass(frozen=True)
class RobotWatchConfig:
    """When the robot's state is late and when it is too old."""

    late_ms: float = 100.0
    stale_ms: float = 150.0
    """With a tick of 100 ms, its own duration and a bridge of 20 ms this keeps zero below 300 ms."""

    def __post_init__(self) -> None:
        if not 0 < self.late_ms <= self.stale_ms:
            raise ValueError(f"expected 0 < late_ms ≤ stale_ms, found {self.late_ms} and {self.stale_ms}")


class RobotMonitor:
    """Remembers how many state messages came, and how many were dropped."""

    def __init__(self, config: RobotWatchConfig) -> None:
        self._config = config
        self._malformed = 0
        self._counts: deque[tuple[int, int]] = deque(maxlen=64)
        self._expected: float | None = None

    def begin(self, malformed: int) -> None:
        """Reports that were dropped until now do not count."""
        self._malformed = malformed

    def urgent(self, attitude: Attitude | None, malformed: int) -> tuple[Finding, ...]:
        """What does not wait for a tick: a robot that tipped over, a report that had to be dropped (counted so far)."""
        findings: tuple[Finding, ...] = ()
        if malformed > self._malformed:
            self._malformed = malformed
            findings = (Finding("odometry-not-finite", f"{malformed} reports dropped so far"),)
        if attitude is None or max(abs(attitude.roll_rad), abs(attitude.pitch_rad)) <= TIPPED_RAD:
            return findings
        roll, pitch = math.degrees(attitude.roll_rad), math.degrees(attitude.pitch_rad)
        return (*findings, Finding("tipped-over", f"roll {roll:.0f}°, pitch {pitch:.0f}°"))

    def step(self, pose: StampedPose | None, states: int | None, now_ns: int) -> tuple[Finding, ...]:
        """Judge the newest pose and the count of state messages so far; None: not known."""
        findings: list[Finding] = []
        age_ms = None if pose is None else (now_ns - pose.stamp_ns) / 1e6
        if age_ms is None or not 0 <= age_ms <= self._config.stale_ms:
            findings.append(Finding("odometry-stale", "no pose yet" if age_ms is None else f"{age_ms:.0f} ms old"))
        elif age_ms > self._config.late_ms:
            findings.append(Finding("odometry-late", f"{age_ms:.0f} ms old"))
        if states is not None:
            self._judge_link(states, now_ns, findings)
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
