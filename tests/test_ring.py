"""The token ring gives the VLM the frames of the paper: now, and 3, 6 and 9 s before, as far as there are any."""

from __future__ import annotations

import numpy as np
import pytest

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


def test_frames_can_be_counted_back_from_another_instant() -> None:
    assert stamps_s(filled(20.0, 256).select(OFFSETS_S, 16_000_000_000)) == [7.0, 10.0, 13.0, 16.0]


def encoded(ring: TokenRing, number: int) -> EncodedFrame:
    """What the control thread does with a new frame."""
    buffer = ring.next_buffer()
    assert buffer is not None
    buffer[:] = number
    frame = EncodedFrame(number, SE2(0, 0, 0), buffer)
    ring.put(frame)
    return frame


def test_a_slot_keeps_its_buffer() -> None:
    ring = TokenRing(3, shape=(1, 4, 8))
    frames = [encoded(ring, number) for number in range(6)]
    assert [frames[i].tokens is frames[i + 3].tokens for i in range(3)] == [True] * 3
    assert len({id(frame.tokens) for frame in frames}) == 3


def test_tokens_given_to_a_reader_survive_the_slots_next_frame() -> None:
    ring = TokenRing(2, shape=(1, 4, 8))
    encoded(ring, 1)
    frame = ring.nearest(1)
    encoded(ring, 2)
    encoded(ring, 3)
    assert frame is not None and (frame.tokens == 1).all()


def test_a_frame_whose_buffer_is_being_written_is_not_given() -> None:
    ring = TokenRing(2, shape=(1, 4, 8))
    encoded(ring, 1)
    encoded(ring, 2)
    ring.next_buffer()
    assert stamps_s(ring.select((0.0,), newest_ns=1)) == [2e-9]


def test_a_frame_that_was_overwritten_while_it_was_copied_is_not_given() -> None:
    ring = TokenRing(2, shape=(1, 4, 8))

    class Overwritten(np.ndarray):
        """Tokens whose copying takes so long that the writer comes round."""

        def copy(self, order: str = "C") -> np.ndarray:
            ring.next_buffer()
            return np.array(self)

    buffer = ring.next_buffer()
    assert buffer is not None
    ring.put(EncodedFrame(1, SE2(0, 0, 0), buffer.view(Overwritten)))
    encoded(ring, 10**9)
    assert ring.nearest(1) is None


@pytest.mark.parametrize("capacity", [0, 1])
def test_a_ring_without_a_slot_to_spare_is_refused(capacity: int) -> None:
    with pytest.raises(ValueError, match="2 slots"):
        TokenRing(capacity)
