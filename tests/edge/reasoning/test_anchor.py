"""The planned capture of a generation's newest frame, and which frame is taken for it."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from edge.reasoning.anchor import EARLY_NS, LATE_NS, Anchor

S = 1_000_000_000
stamps = st.integers(0, 10**15)
durations = st.integers(0, 60 * S)


def test_the_newest_frame_is_planned_for_the_end_of_the_prefix() -> None:
    plan = Anchor.after(20 * S, 2 * S)
    assert plan.planned_ns == 22 * S
    assert [plan.older_ns(offset_s) for offset_s in (9.0, 6.0, 3.0)] == [13 * S, 16 * S, 19 * S]


@given(stamps, durations, durations)
def test_the_frame_taken_is_never_further_from_the_plan_than_allowed(begun: int, prefix: int, later: int) -> None:
    plan = Anchor.after(begun, prefix)
    stamp_ns = plan.choose(begun + later)
    assert stamp_ns is None or -EARLY_NS <= stamp_ns - plan.planned_ns <= LATE_NS


@given(stamps, durations)
def test_planned_for_now_it_is_the_frame_that_is_newest_now(begun: int, later: int) -> None:
    assert Anchor.now(begun).choose(begun + later) == begun


@given(stamps, durations, durations)
def test_no_older_frame_can_be_the_newest_too(begun: int, prefix: int, later: int) -> None:
    plan = Anchor.after(begun, prefix)
    stamp_ns = plan.choose(begun + later)
    assert stamp_ns is None or not plan.is_older(stamp_ns)
