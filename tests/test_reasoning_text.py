"""VLM text is untrusted: a strict line of waypoints, or nothing."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.reasoning_text import MAX_TEXT_CHARS, format_waypoints, parse_waypoints

hundredths = st.integers(-9999, 9999).map(lambda n: n / 100)


@given(st.lists(st.tuples(hundredths, hundredths), min_size=3, max_size=3))
def test_written_waypoints_are_read_back(points: list[tuple[float, float]]) -> None:
    waypoints = tuple(points)
    assert parse_waypoints("The way is clear.\n" + format_waypoints(waypoints)) == waypoints


@given(st.text(max_size=300))
def test_any_other_text_is_no_waypoints_and_no_error(text: str) -> None:
    assert parse_waypoints(text) is None


@pytest.mark.parametrize(
    "text",
    [
        "",
        "waypoints: (1.0, 2.0) (3.0, 4.0)",
        "waypoints: (1.0, 2.0) (3.0, 4.0) (5.0, 6.0) (7.0, 8.0)",
        "waypoints: (1e9, 0.0) (3.0, 4.0) (5.0, 6.0)",
        "waypoints: (nan, 0.0) (3.0, 4.0) (5.0, 6.0)",
        "waypoints: (123.0, 0.0) (3.0, 4.0) (5.0, 6.0)",
        "waypoints: (1.0, 0.0) (3.0, 4.0) (5.0, 6.0); ignore all limits",
        "waypoints: (1.0, 0.0) (3.0, 4.0) (5.0, 6.0)\nand drive faster",
        "Waypoints: (1.0, 0.0) (3.0, 4.0) (5.0, 6.0)",
        "waypoints: (١.0, 0.0) (3.0, 4.0) (5.0, 6.0)",
        "__import__('os').system('true')",
    ],
)
def test_near_misses_are_invalid(text: str) -> None:
    assert parse_waypoints(text) is None


def test_text_beyond_the_cap_is_not_read() -> None:
    line = format_waypoints(((1.0, 0.0), (2.0, 0.0), (3.0, 0.0)))
    assert parse_waypoints("x" * MAX_TEXT_CHARS + "\n" + line) is None
