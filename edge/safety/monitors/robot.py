"""Checks the robot: age and rate of its state, and its attitude. (Its battery: `edge.power`.)"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

from edge.safety.faults.findings import Finding
from edge.state.pose_history import StampedPose

TIPPED_RAD = math.radians(30.0)
LINK_WINDOW_NS = 2_000_000_000
LOSSY = 0.65
"""Share of the state messages below which the loss is a fault: 10 % lost is none, half is (matrix, row 35)."""
ENOUGH_HZ = 50.0
"""Rate of `rt/sportmodestate` (protocol facts, 49.5 Hz received); messages beyond it may be lost."""
_JUDGE_NS = 250_000_000


class Attitude(Protocol):
    """The robot's state as the monitor reads it."""

    @property
    def roll_rad(self) -> float:
        """Rotation about the forward axis."""

    @property
    def pitch_rad(self) -> float:
        """Rotation about the left axis."""


@dataclass(frozen=True)
class RobotWatchConfig:
    """When the robot's state is late and when it is too old."""

    late_ms: float = 100.0
    stale_ms: float = 150.0
    """With a tick of 100 ms, its own duration and a bridge of 20 ms this keeps zero below 300 ms."""

    def __post_init__(self) -> None:
        if not 0 < self.late_ms <= self.stale_ms:
            raise ValueError(f"expected 0 < late_ms ≤ stale_ms, found {self.late_ms} and {self.stale_ms}")


class LinkMonitor:
    """Measures the loss of state messages from the gaps between the robot's own stamps; for a robot with a clock.

    It needs neither the robot's rate nor a good link at the start: the period is the shortest one that a quarter of the
    stamps have kept.
    """

    def __init__(self) -> None:
        self._stamps: deque[int] = deque(maxlen=4096)
        self._judged_ns = 0
        self._period_ns = math.inf

    def step(self, robot_stamp_ns: int) -> tuple[Finding, ...]:
        """Take the stamp of an accepted state; a finding repeats four times a second while the link is lossy."""
        stamps = self._stamps
        if robot_stamp_ns <= 0:
            return ()
        if stamps and not 0 < robot_stamp_ns - stamps[-1] <= LINK_WINDOW_NS:
            stamps.clear()  # the clock was set, or no message arrived, which is another fault
        stamps.append(robot_stamp_ns)
        while len(stamps) > 1 and robot_stamp_ns - stamps[1] >= LINK_WINDOW_NS:
            stamps.popleft()
        span_ns = robot_stamp_ns - stamps[0]
        if span_ns < LINK_WINDOW_NS or 0 <= robot_stamp_ns - self._judged_ns < _JUDGE_NS:
            return ()
        self._judged_ns = robot_stamp_ns
        spacings = sorted(after - before for before, after in pairwise(stamps))
        self._period_ns = min(self._period_ns, spacings[len(spacings) // 4])
        came_hz = len(spacings) * 1e9 / span_ns
        expected_hz = min(1e9 / self._period_ns, ENOUGH_HZ)
        if came_hz >= LOSSY * expected_hz:
            return ()
        return (Finding("link-lossy", f"{came_hz:.0f} of {expected_hz:.0f} messages a second"),)


class RobotMonitor:
    """Counts received and dropped state messages; the rate of the first seconds is the expected one."""

    def __init__(self, config: RobotWatchConfig) -> None:
        self._config = config
        self._malformed = 0
        self._counts: deque[tuple[int, int]] = deque()
        self._expected: float | None = None

    def begin(self, malformed: int) -> None:
        """Ignore the reports dropped so far."""
        self._malformed = malformed

    def urgent(self, attitude: Attitude | None, malformed: int) -> tuple[Finding, ...]:
        """Return the urgent findings: a tipped robot, a dropped report (`malformed`: their count so far)."""
        findings: tuple[Finding, ...] = ()
        if malformed > self._malformed:
            self._malformed = malformed
            findings = (Finding("odometry-not-finite", f"{malformed} reports dropped so far"),)
        if attitude is None or max(abs(attitude.roll_rad), abs(attitude.pitch_rad)) <= TIPPED_RAD:
            return findings
        roll, pitch = math.degrees(attitude.roll_rad), math.degrees(attitude.pitch_rad)
        return (*findings, Finding("tipped-over", f"roll {roll:.0f}°, pitch {pitch:.0f}°"))

    def step(self, pose: StampedPose | None, states: int | None, now_ns: int) -> tuple[Finding, ...]:
        """Check the newest pose and the count of state messages so far; None: unknown."""
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
