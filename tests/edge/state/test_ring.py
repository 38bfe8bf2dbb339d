"""The token ring gives the VLM the encoded frame nearest to an instant, whole or not at all."""

from __future__ import annotations

import numpy as np
import pytest

from edge.core.geometry import SE2
from edge.state.ring import EncodedFrame, TokenRing

TOKENS = np.zeros((1, 4, 8), dtype=np.float32)


def filled(seconds: float, capacity: int = 120) -> TokenRing:
    ring = TokenRing(capacity)
    for i in range(round(seconds * 10) + 1):
        ring.put(EncodedFrame(i * 100_000_000, SE2(i * 0.05, 0, 0), TOKENS))
    return ring


def test_the_frame_nearest_to_an_instant_is_given() -> None:
    ring = filled(20.0)
    for wanted_s, found_s in ((11.0, 11.0), (14.04, 14.0), (14.06, 14.1), (20.4, 20.0)):
        frame = ring.nearest(round(wanted_s * 1e9))
        assert frame is not None and frame.stamp_ns == round(found_s * 1e9)


def test_a_frame_half_a_second_away_is_not_returned() -> None:
    ring = filled(4.0)
    assert ring.nearest(4_600_000_000) is None
    assert ring.nearest(4_600_000_000, tolerance_s=1.0) is not None


def test_an_empty_ring_gives_nothing() -> None:
    ring = TokenRing(8)
    assert (ring.newest_ns, ring.nearest(0)) == (None, None)


def test_the_newest_frames_are_listed_by_stamp_and_pose_oldest_first() -> None:
    assert filled(4.0).newest(2) == [(3_900_000_000, SE2(39 * 0.05, 0, 0)), (4_000_000_000, SE2(40 * 0.05, 0, 0))]
    assert filled(0.0).newest(2) == [(0, SE2(0, 0, 0))] and TokenRing(8).newest(2) == []


def test_a_full_ring_forgets_its_oldest_frame() -> None:
    ring = filled(20.0, capacity=120)
    assert ring.newest_ns == 20_000_000_000
    assert ring.nearest(8_000_000_000, tolerance_s=0.05) is None
    assert ring.nearest(8_100_000_000, tolerance_s=0.05) is not None


def encoded(ring: TokenRing, number: int) -> EncodedFrame:
    """What the control thread does with a new frame."""
    buffer = ring.next_buffer()
    assert buffer is not None
    buffer[:] = number
    frame = EncodedFrame(number, SE2(0, 0, 0), buffer)
    ring.put(frame)
    return frame


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
    frame = ring.nearest(1)
    assert frame is not None and frame.stamp_ns == 2


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
