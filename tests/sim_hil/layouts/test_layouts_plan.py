"""Floor plans: where rectangles meet, what is opened, and the walls that remain."""

from __future__ import annotations

import pytest

from sim_hil.layouts.plan import LayoutError, Rect, shared_border, wall_lines

LEFT, RIGHT = Rect(0, 0, 4, 3), Rect(4, 1, 8, 5)


def total_m(lines: list[tuple[tuple[float, float], tuple[float, float]]]) -> float:
    return sum(abs(b[0] - a[0]) + abs(b[1] - a[1]) for a, b in lines)


def test_two_rooms_share_the_stretch_on_which_both_border() -> None:
    border = shared_border(LEFT, RIGHT)
    assert (border.along_x, border.at, border.low, border.high) == (False, 4, 1, 3)
    assert border.middle == (4, 2)


def test_rooms_that_meet_in_a_corner_share_nothing() -> None:
    with pytest.raises(LayoutError, match="do not touch"):
        shared_border(Rect(0, 0, 1, 1), Rect(1, 1, 2, 2))


def test_a_wall_between_two_rooms_is_built_once() -> None:
    lines = wall_lines([Rect(0, 0, 4, 3), Rect(4, 0, 8, 3)], [])
    assert sum(a[0] == b[0] == 4 for a, b in lines) == 1
    # Outline 2 * (8 + 3) and 3 m between them; corners are filled by no more than half a wall each.
    assert total_m(lines) == pytest.approx(25, abs=0.4)


def test_an_opening_leaves_a_gap_of_its_own_width() -> None:
    rooms = [Rect(0, 0, 4, 3), Rect(4, 0, 8, 3)]
    border = shared_border(*rooms)
    closed, opened = wall_lines(rooms, []), wall_lines(rooms, [border.cut(1.0, 2.2)])
    assert total_m(closed) - total_m(opened) == pytest.approx(1.2)
    assert not any(a[0] == b[0] == 4 and a[1] < 1.6 < b[1] for a, b in opened)


def test_a_rectangle_without_area_is_refused() -> None:
    with pytest.raises(LayoutError, match="without area"):
        Rect(1, 1, 1, 2)
