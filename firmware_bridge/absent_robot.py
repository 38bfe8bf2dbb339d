"""Waits for a link that appears after the bridge has started: a late cable, a late address, a late serial adapter.

Until then the bridge runs with an `AbsentRobot` in place of its backend: it keeps its sockets, its rules, its watchdog
and every emergency stop of an operator.
"""

from __future__ import annotations

from firmware_bridge.core.step_types import Report, Request


class AbsentRobot:
    """Stands in for a backend while its link is missing: reports that the robot cannot be commanded."""

    def __init__(self, reason: str) -> None:
        """`reason`: the missing link, in one line."""
        self.reason = reason

    def read(self, now_ns: int) -> Report:
        """Return a report with failing writes and no state, so that the core refuses to arm with `link_down`."""
        return Report(writes_fail=True)

    def write(self, request: Request) -> None:
        """Drop the request: there is nowhere to send it."""

    def dropped(self) -> tuple[int, int, int]:
        """Return the counts of impossible messages, states out of order and failed writes: all 0."""
        return 0, 0, 0

    def close(self) -> None:
        """Do nothing: nothing is open."""
