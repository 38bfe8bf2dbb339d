"""Time from the runner's sent command to its arrival at the robot, from a flight log and edge-hil's trace. Pure.

The bridge limits speeding up: a command that it writes unchanged at its next period can be matched with its arrival;
any other arrives in steps and is left out.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence

from tools.report.run_data import Record

TOLERANCE = 0.006
"""Largest difference between a command and its arrival, m/s and rad/s: a CAN frame rounds to 0.01 at worst."""
CHANGE = 4 * TOLERANCE
"""Smallest change between two commands whose arrival can be told apart, m/s and rad/s."""


def command_latencies_ms(
    ticks: Sequence[Record], wire: Sequence[Record], growth: Sequence[float] = (0.0, 0.0, 0.0)
) -> list[float]:
    """Return the latency of every command that can be matched, ms.

    `ticks`: /tick records of the flight log; `wire`: "wire" lines of the trace; `growth`: speeding up that the bridge
    permits in one period (m/s, m/s, rad/s). A command counts as sent at the end of its tick, and must arrive before the
    next one is sent.
    """
    moves = sorted((int(line["t_ns"]), line["velocity"]) for line in wire if line.get("velocity") is not None)
    stamps = [stamp for stamp, _ in moves]
    sent_ns = [int(tick["start_ns"] + tick["duration_ms"] * 1e6) for tick in ticks]
    found: list[float] = []
    for index in range(1, len(ticks) - 1):
        before, command = ticks[index - 1]["command"], ticks[index]["command"]
        if not _written_unchanged(before, command, growth):
            continue
        for stamp_ns, velocity in moves[bisect_left(stamps, sent_ns[index]) : bisect_left(stamps, sent_ns[index + 1])]:
            if all(abs(a - b) <= TOLERANCE for a, b in zip(velocity, command, strict=True)):
                found.append((stamp_ns - sent_ns[index]) / 1e6)
                break
    return found


def _written_unchanged(before: Sequence[float], command: Sequence[float], growth: Sequence[float]) -> bool:
    """Whether the command differs from the one before by CHANGE and no component grows by more than `growth`."""
    changes = any(abs(a - b) >= CHANGE for a, b in zip(before, command, strict=True))
    return changes and all(
        abs(b) <= (abs(a) if a * b > 0 else 0.0) + limit for a, b, limit in zip(before, command, growth, strict=True)
    )
