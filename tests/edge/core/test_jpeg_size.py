"""The size of a JPEG is read from its header; whatever is no JPEG has none."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.jpeg import jpeg_size


@pytest.mark.parametrize("progressive", [0, 1])
@pytest.mark.parametrize(("width", "height"), [(1280, 720), (448, 448), (33, 7)])
def test_the_size_is_the_pictures(width: int, height: int, progressive: int) -> None:
    picture = np.random.default_rng(0).integers(0, 255, (height, width, 3), dtype=np.uint8)
    _, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive])
    assert jpeg_size(encoded.tobytes()) == (width, height)


@given(st.binary(max_size=400), st.booleans())
def test_any_bytes_have_a_size_or_none(data: bytes, start: bool) -> None:
    size = jpeg_size(b"\xff\xd8" * start + data)
    assert size is None or all(0 <= side <= 65535 for side in size)


def test_segments_that_never_end_are_not_followed_for_ever() -> None:
    assert jpeg_size(b"\xff\xd8" + b"\xff\xe0\x00\x02" * 10**5) is None
