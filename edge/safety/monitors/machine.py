"""Checks this machine: late ticks, a clock that jumped, sleep. (Its heat: `edge.power`.)"""

from __future__ import annotations

from collections import deque

from edge.safety.faults.findings import Finding

WINDOW_TICKS = 10
LATE_TICKS = 3
"""Late ticks of the last ten. openpilot: a model lags when more than 20 % of its frames drop (facts, "Figures")."""
OVERRUN_PERIODS = 2.0
GAP_NS = 1_000_000_000
"""Gap between two ticks above which this process counts as frozen or starved."""
SLEPT_NS = 100_000_000
"""Largest difference between the clock that counts sleep and the one that does not, unless the machine slept."""


class MachineMonitor:
    """Remembers the last ticks and the last readings of both clocks."""

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._late: deque[bool] = deque(maxlen=WINDOW_TICKS)
        self._last_ns: int | None = None
        self._asleep_ns: int | None = None

    def step(self, last_tick_ns: int | None, asleep_ns: int, now_ns: int) -> tuple[Finding, ...]:
        """Check the previous tick and the machine.

        `last_tick_ns`: from that tick's deadline to its command; `asleep_ns`: boot time less monotonic time, which
        grows by the time that the machine slept.
        """
        findings: list[Finding] = []
        if self._last_ns is not None and now_ns < self._last_ns:
            findings.append(Finding("clock-backwards", f"by {(self._last_ns - now_ns) / 1e6:.0f} ms"))
        gap_ns = 0 if self._last_ns is None else now_ns - self._last_ns
        slept_ns = 0 if self._asleep_ns is None else asleep_ns - self._asleep_ns
        if slept_ns > SLEPT_NS:
            findings.append(Finding("suspended", f"for {slept_ns / 1e9:.1f} s"))
        elif gap_ns > GAP_NS:
            findings.append(Finding("tick-overrun", f"none for {gap_ns / 1e9:.1f} s"))
        self._last_ns = now_ns
        self._asleep_ns = asleep_ns if self._asleep_ns is None else max(self._asleep_ns, asleep_ns)
        if last_tick_ns is not None:
            self._judge_ticks(last_tick_ns, findings)
        return tuple(findings)

    def _judge_ticks(self, last_tick_ns: int, findings: list[Finding]) -> None:
        self._late.append(last_tick_ns > self._period_ns)
        late = sum(self._late)
        if late >= LATE_TICKS:
            findings.append(Finding("tick-late", f"{late} of the last {WINDOW_TICKS} ticks"))
        if last_tick_ns > OVERRUN_PERIODS * self._period_ns:
            findings.append(Finding("tick-overrun", f"{last_tick_ns / 1e6:.0f} ms"))
