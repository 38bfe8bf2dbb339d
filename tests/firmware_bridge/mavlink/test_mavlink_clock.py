"""The autopilot's clock, learned by TIMESYNC over links of any delay."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge.mavlink.clock import MAX_AGE_NS, VehicleClock

MS = 1_000_000
S = 1_000_000_000
OFFSET_NS = -3_600 * S  # the rover was switched on an hour after this machine
DELAY = st.integers(0, 200 * MS)


def exchange(clock: VehicleClock, now_ns: int, there_ns: int, back_ns: int, offset_ns: int = OFFSET_NS) -> None:
    """One TIMESYNC whose request takes `there_ns` and whose answer takes `back_ns`."""
    assert clock.due(now_ns)
    clock.answer(now_ns + there_ns + offset_ns, now_ns, now_ns + there_ns + back_ns)


@given(trips=st.lists(st.tuples(DELAY, DELAY), min_size=1, max_size=30), age_ns=st.integers(0, 5 * S))
def test_a_report_is_timely_exactly_when_its_age_is_known_to_be_small(
    trips: list[tuple[int, int]], age_ns: int
) -> None:
    clock, now_ns = VehicleClock(), 7200 * S
    for there_ns, back_ns in trips:
        exchange(clock, now_ns, there_ns, back_ns)
        now_ns += S
    error_ns = 100 * MS  # half of the longest round trip's asymmetry
    if age_ns < MAX_AGE_NS - error_ns:
        assert clock.is_timely(now_ns + OFFSET_NS - age_ns, now_ns)
    elif age_ns > MAX_AGE_NS + error_ns:
        assert not clock.is_timely(now_ns + OFFSET_NS - age_ns, now_ns)


def test_a_report_from_the_future_is_not_timely() -> None:
    clock = VehicleClock()
    exchange(clock, 7200 * S, MS, MS)
    assert not clock.is_timely(7201 * S + OFFSET_NS + MAX_AGE_NS + 10 * MS, 7201 * S)


def test_an_answer_that_was_not_requested_changes_nothing() -> None:
    clock = VehicleClock()
    exchange(clock, 7200 * S, MS, MS)
    clock.answer(10**15, 7199 * S, 7200 * S + 10 * MS)
    assert clock.is_timely(7201 * S + OFFSET_NS, 7201 * S)


def test_a_repeated_answer_changes_nothing() -> None:
    clock = VehicleClock()
    exchange(clock, 7200 * S, MS, MS)
    clock.answer(10**15, 7200 * S, 7200 * S + 2 * MS)
    assert clock.is_timely(7201 * S + OFFSET_NS, 7201 * S)


def test_a_restarted_autopilots_clock_counts_from_its_first_answer() -> None:
    clock = VehicleClock()
    for second in range(10):
        exchange(clock, (7200 + second) * S, MS, MS)
    exchange(clock, 7210 * S, 50 * MS, 50 * MS, offset_ns=-7209 * S)
    assert clock.is_timely(7211 * S - 7209 * S, 7211 * S)


def test_it_asks_once_a_second() -> None:
    clock = VehicleClock()
    assert [clock.due(at * 100 * MS + 5 * S) for at in range(12)] == [True] + [False] * 9 + [True, False]
