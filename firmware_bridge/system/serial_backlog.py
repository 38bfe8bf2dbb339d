"""Whether a serial line is behind with what was written to it, so that what is written now would arrive late. Pure."""

from __future__ import annotations

from typing import Final

MOST_WAITING: Final = 512
"""Bytes that may wait in the system, 90 ms at 57600 baud."""
PATIENCE_NS: Final = 40_000_000
"""Time for which more may wait, two steps of the bridge.

Linux's driver of USB lines (`cdc-acm`, /dev/ttyACM0) reports no bytes but 20 whole USB packets for each write under
way: 1280 for a zero velocity that leaves within a millisecond. One reading right after a write therefore says nothing.
"""


class SerialBacklog:
    """Judges the bytes that wait in one serial line."""

    def __init__(self) -> None:
        self._clear_ns: int | None = None

    def is_behind(self, waiting_bytes: int, now_ns: int) -> bool:
        """Return whether more than `MOST_WAITING` bytes have waited for `PATIENCE_NS`; call it before every write."""
        if waiting_bytes <= MOST_WAITING or self._clear_ns is None:
            self._clear_ns = now_ns
        return now_ns - self._clear_ns >= PATIENCE_NS
