"""The token ring gives the VLM the frames of the paper: now, and 3, 6 and 9 s before, as far as there are any."""

from __future__ import annotations

import numpy as np

from edge.geometry import SE2
from edge.ring import EncodedFrame, TokenRing

OFFSETS_S = (0.0, 3.0, 6.0, 9.0)
TOKENS = np.zeros((1, 4, 8), dtype=np.float32)


def filled(seconds: float, capacity: int = 120) -> TokenRing:
    ring = TokenRing(capacity)
    for i in range(round(seconds * 10) + 1):
        ring.put(EncodedFrame(i * 100_000_000, SE2(i * 0.05, 0, 0), TOKENS))
    return ring


def stamps_s(frames: list[EncodedFrame]) -> list[float]:
    return [frame.stamp_ns / 1e9 for frame in frames]


def test_a_full_history_gives_four_frames_three_seconds_apart_oldest_first() -> None:
    assert stamps_s(filled(20.0).select(OFFSETS_S)) == [11.0, 14.0, 17.0, 20.0]


def test_at_the_start_fewer_frames_are_used() -> None:
    assert stamps_s(filled(0.0).select(OFFSETS_S)) == [0.0]
    assert stamps_s(filled(4.0).select(OFFSETS_S)) == [1.0, 4.0]


def test_an_empty_ring_selects_nothing() -> None:
    assert TokenRing(8).select(OFFSETS_S) == []


def test_a_gap_in_the_frames_leaves_that_frame_out() -> None:
    ring = TokenRing(120)
    for second in (0.0, 7.0, 10.0):
        ring.put(EncodedFrame(round(second * 1e9), SE2(0, 0, 0), TOKENS))
    assert stamps_s(ring.select(OFFSETS_S)) == [7.0, 10.0]


def test_a_frame_is_never_given_twice() -> None:
    ring = TokenRing(8)
    ring.put(EncodedFrame(0, SE2(0, 0, 0), TOKENS))
    assert len(ring.select((0.0, 0.1, 0.2))) == 1
