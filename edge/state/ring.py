"""Ring buffer of encoded frames: the control thread writes, the reasoning thread reads; nothing is encoded twice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from edge.core.geometry import SE2

Floats = npt.NDArray[np.float32]

TOLERANCE_S = 0.5
"""Largest distance of a frame's stamp from the requested instant, s."""


@dataclass(frozen=True)
class EncodedFrame:
    """Visual tokens [1, N, D] of one frame, its capture stamp and the pose it was captured at."""

    stamp_ns: int
    T_odom_base: SE2
    tokens: Floats


class TokenRing:
    """The last `capacity` frames; lock-free for one writer (see `PoseHistory` for why that is sound).

    With a `shape`, the tokens of every slot have a buffer that is allocated once: the writer encodes into
    `next_buffer()` and puts a frame with these tokens. Readers receive copies, never of a slot that was overwritten
    meanwhile.
    """

    def __init__(self, capacity: int, shape: Sequence[int] | None = None) -> None:
        if capacity < 2:
            raise ValueError(f"a token ring needs 2 slots or more, found {capacity}")
        self._slots: list[EncodedFrame | None] = [None] * capacity
        # Filled, so that no tick causes the first page fault.
        self._buffers = None if shape is None else [np.full(shape, 0, dtype=np.float32) for _ in range(capacity)]
        self._count = 0

    def next_buffer(self) -> Floats | None:
        """Drop the oldest frame and return its buffer for the next frame's tokens; None without buffers."""
        if self._buffers is None:
            return None
        index = self._count % len(self._slots)
        # Before the first write: a reader that is copying finds afterwards that the frame was dropped.
        self._slots[index] = None
        return self._buffers[index]

    def put(self, frame: EncodedFrame) -> None:
        """Add the newest frame."""
        self._slots[self._count % len(self._slots)] = frame
        self._count += 1

    @property
    def newest_ns(self) -> int | None:
        """Return the capture stamp of the newest frame, ns; None while there is none."""
        return max((frame.stamp_ns for frame in list(self._slots) if frame is not None), default=None)

    def newest(self, count: int) -> list[tuple[int, SE2]]:
        """Return stamp and pose of at most `count` of the newest frames, oldest first."""
        frames = [frame for frame in list(self._slots) if frame is not None]
        return [(frame.stamp_ns, frame.T_odom_base) for frame in sorted(frames, key=lambda frame: frame.stamp_ns)][
            -count:
        ]

    def nearest(self, stamp_ns: int, tolerance_s: float = TOLERANCE_S) -> EncodedFrame | None:
        """Return the frame captured nearest to an instant, with a copy of its tokens; None if none is near enough."""
        frames = [frame for frame in list(self._slots) if frame is not None]
        nearest = min(frames, key=lambda frame: abs(frame.stamp_ns - stamp_ns), default=None)
        if nearest is None or abs(nearest.stamp_ns - stamp_ns) > tolerance_s * 1e9:
            return None
        if self._buffers is None:
            return nearest
        own = replace(nearest, tokens=nearest.tokens.copy())
        return own if any(slot is nearest for slot in self._slots) else None
