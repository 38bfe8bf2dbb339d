"""Ring buffer of encoded frames: the control thread writes, the reasoning thread reads; nothing is encoded twice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from edge.geometry import SE2


@dataclass(frozen=True)
class EncodedFrame:
    """Visual tokens [1, N, D] of one frame, its capture stamp and the pose it was captured at."""

    stamp_ns: int
    T_odom_base: SE2
    tokens: npt.NDArray[np.float32]


class TokenRing:
    """The last `capacity` frames; lock-free for one writer (see `PoseHistory` for why that is sound)."""

    def __init__(self, capacity: int) -> None:
        self._slots: list[EncodedFrame | None] = [None] * capacity
        self._count = 0

    def put(self, frame: EncodedFrame) -> None:
        """Add the newest frame."""
        self._slots[self._count % len(self._slots)] = frame
        self._count += 1

    def select(self, offsets_s: Sequence[float], tolerance_s: float = 0.5) -> list[EncodedFrame]:
        """Frames at the newest stamp minus each offset, oldest first; those not there yet are left out.

        Paper, Algorithm 3 (SAMPLEFRAMESAVAILABLE): offsets are {0, 3, 6, 9} s and fewer frames are used at the start.
        """
        frames = [f for f in list(self._slots) if f is not None]
        if not frames:
            return []
        newest_ns = max(f.stamp_ns for f in frames)
        chosen: dict[int, EncodedFrame] = {}
        for offset_s in offsets_s:
            wanted_ns = newest_ns - round(offset_s * 1e9)
            nearest = min(frames, key=lambda f: abs(f.stamp_ns - wanted_ns))
            if abs(nearest.stamp_ns - wanted_ns) <= tolerance_s * 1e9:
                chosen[nearest.stamp_ns] = nearest
        return [chosen[stamp_ns] for stamp_ns in sorted(chosen)]
