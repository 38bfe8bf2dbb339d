"""Synchronous reasoning: which frame may be a generation's newest (paper, appendix D: it stands and thinks).

A robot that was told to halt coasts on. What it sees then is not what it sees from where it will start to drive, and
the action expert of a blocking policy is told that it has not moved since.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from edge.core.geometry import SE2

STANDS_MPS = 0.1
STANDS_RADPS = 0.2
"""Slower than this a robot stands. A simulated Go2, still stepping on the spot, is within 2 cm of where it stays."""
SETTLE_S = 1.0
"""So long after the halt it is taken to stand whatever odometry says. In simulation a Go2 needed 0.4 to 0.6 s."""


def seen_standing(frames: Sequence[tuple[int, SE2]], halted_ns: int | None) -> bool:
    """Whether a generation may begin with the newest of these frames.

    `frames`: stamp, ns, and pose `T_odom_base` of the newest ones, oldest first; `halted_ns`: when the robot was told
    to stand, None in a mode that drives on. The speed is the mean between the newest two.
    """
    if not frames:
        return False
    if halted_ns is None:
        return True
    stamp_ns, T_odom_base = frames[-1]
    if stamp_ns < halted_ns:
        return False  # it still drives, or nothing has been seen since it was told to halt
    if stamp_ns - halted_ns >= SETTLE_S * 1e9:
        return True
    if len(frames) < 2:
        return False
    before_ns, T_odom_before = frames[-2]
    moved, seconds = T_odom_before.inverse() @ T_odom_base, (stamp_ns - before_ns) / 1e9
    return math.hypot(moved.x_m, moved.y_m) < STANDS_MPS * seconds and abs(moved.theta_rad) < STANDS_RADPS * seconds
