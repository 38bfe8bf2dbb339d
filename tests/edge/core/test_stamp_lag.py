"""How late a message is, by its sender's clock."""

from __future__ import annotations

import pytest

from edge.core.stamp_lag import StampLag

S = 1_000_000_000
MS = 1_000_000


def lags_ms(*messages: tuple[float, float]) -> list[float]:
    """Delays of messages (sent at, arrived at), s, whose sender's clock is 1000 s ahead."""
    lag = StampLag()
    return [lag.of(round(arrived * S), round((sent + 1000) * S)) / MS for sent, arrived in messages]


def test_messages_as_quick_as_the_first_are_not_late() -> None:
    assert lags_ms((0.0, 0.05), (0.1, 0.15), (0.2, 0.25)) == [0, 0, 0]


def test_a_message_that_waited_in_a_queue_is_late_by_its_wait() -> None:
    first, *waited = lags_ms((0.0, 0.05), (0.1, 3.15), (0.2, 3.25))
    assert first == 0 and waited == pytest.approx([3000, 3000], abs=2), "what two clocks may drift apart in 3 s"


def test_a_queue_that_grows_without_end_never_counts_as_a_clock_that_was_set() -> None:
    assert lags_ms(*((k, 2.0 * k) for k in range(60)))[-1] > 58_900


def test_the_first_message_may_have_waited_itself() -> None:
    assert [round(lag) for lag in lags_ms((0.0, 1.0), (0.1, 0.2), (0.2, 0.8))] == [0, 0, 500]


def test_after_the_clock_was_set_delays_are_measured_anew() -> None:
    assert [round(lag) for lag in lags_ms((0.0, 0.0), (-100.0, 0.1), (-99.9, 0.5))] == [0, 0, 300]
    assert [round(lag) for lag in lags_ms((0.0, 0.0), (0.1, 20.1), (0.2, 20.5))] == [0, 0, 300]


def test_clocks_that_drift_apart_as_clocks_do_are_no_delay() -> None:
    assert lags_ms(*((k * (1 - 50e-6), float(k)) for k in range(0, 7200, 600)))[-1] == 0


def test_a_message_without_a_stamp_is_not_late() -> None:
    assert StampLag().of(5 * S, 0) == 0
