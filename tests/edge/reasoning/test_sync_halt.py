"""Which frame a synchronous generation may begin with: one that a standing robot has captured."""

from __future__ import annotations

import pytest

from edge.core.geometry import SE2
from edge.reasoning.generation_cycle import seen_standing

HALT_NS = 5_000_000_000
TICK_NS = 100_000_000


def frames(after_ns: int, moved: SE2) -> list[tuple[int, SE2]]:
    """Two of them, 0.1 s apart, the newest so long after the halt."""
    there = SE2(3.0, -2.0, 2.5)
    return [(HALT_NS + after_ns - TICK_NS, there), (HALT_NS + after_ns, there @ moved)]


@pytest.mark.parametrize(
    ("moved", "stands"),
    [
        (SE2(0.0, 0.0, 0.0), True),
        (SE2(0.009, 0.0, 0.0), True),
        (SE2(0.011, 0.0, 0.0), False),
        (SE2(0.0, -0.011, 0.0), False),
        (SE2(0.0, 0.0, -0.019), True),
        (SE2(0.0, 0.0, 0.021), False),
    ],
)
def test_it_stands_below_a_tenth_of_a_metre_and_a_fifth_of_a_radian_a_second(moved: SE2, stands: bool) -> None:
    assert seen_standing(frames(3 * TICK_NS, moved), HALT_NS) is stands


def test_a_frame_from_before_the_halt_is_none_even_if_it_stood() -> None:
    assert not seen_standing(frames(-1, SE2(0.0, 0.0, 0.0)), HALT_NS)


@pytest.mark.parametrize(("after_ns", "expected"), [(10 * TICK_NS - 1, False), (10 * TICK_NS, True)])
def test_a_second_after_the_halt_odometry_is_not_asked_any_more(after_ns: int, expected: bool) -> None:
    assert seen_standing(frames(after_ns, SE2(0.05, 0.0, 0.0)), HALT_NS) is expected


def test_one_frame_tells_no_speed() -> None:
    assert not seen_standing(frames(TICK_NS, SE2(0.0, 0.0, 0.0))[1:], HALT_NS)


def test_without_a_halt_any_frame_will_do_but_there_must_be_one() -> None:
    assert seen_standing(frames(0, SE2(0.1, 0.0, 0.0)), None) and not seen_standing([], None)
