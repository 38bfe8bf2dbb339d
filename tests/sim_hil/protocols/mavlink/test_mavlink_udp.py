"""The impaired UDP link: reproducible loss, delay, duplication and reordering, as often as requested."""

from __future__ import annotations

import statistics
from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_hil.protocols.impairment import ImpairedDirection, Impairment

COUNT = 4000
PERIOD_S = 0.01


def arrivals(plan: Impairment, times_s: Sequence[float], seed: int = 1) -> list[list[float]]:
    """Return the delays, s, of all copies of each packet sent at `times_s`, on a clock of 1 ms."""
    direction, found = ImpairedDirection[int](seed, 0), list[list[float]]()
    for number, sent_s in enumerate(times_s):
        direction.put(number, plan, sent_s)
        found.append([])
        for arrived in direction.take(sent_s):
            found[arrived].append(sent_s)
    end_s = times_s[-1] if times_s else 0.0
    for step in range(2000):
        for arrived in direction.take(end_s + step * 1e-3):
            found[arrived].append(end_s + step * 1e-3)
    return found


def regular(count: int = COUNT) -> list[float]:
    return [number * PERIOD_S for number in range(count)]


def share(flags: Sequence[bool]) -> float:
    return sum(flags) / len(flags)


def test_a_perfect_link_delivers_every_packet_once_at_once() -> None:
    assert arrivals(Impairment(), regular(10)) == [[time_s] for time_s in regular(10)]


def test_the_same_seed_gives_the_same_arrivals_and_another_one_does_not() -> None:
    plan = Impairment(loss_percent=20, delay_ms=20, jitter_ms=5, duplicate_percent=10, reorder_percent=5)
    assert arrivals(plan, regular(300), 4) == arrivals(plan, regular(300), 4) != arrivals(plan, regular(300), 5)


@pytest.mark.slow
@given(st.lists(st.floats(0, 1), min_size=50, max_size=50))
def test_the_lost_and_duplicated_packets_do_not_depend_on_the_time_of_sending(gaps: list[float]) -> None:
    plan = Impairment(loss_percent=30, loss_burst=3, duplicate_percent=20)
    times = [sum(gaps[:index]) for index in range(50)]
    assert list(map(len, arrivals(plan, times))) == list(map(len, arrivals(plan, regular(50))))


@pytest.mark.parametrize("burst", [1.0, 5.0])
def test_packets_are_lost_at_the_given_share_in_bursts_of_the_given_length(burst: float) -> None:
    lost = [not copies for copies in arrivals(Impairment(loss_percent=20, loss_burst=burst), regular())]
    assert share(lost) == pytest.approx(0.2, abs=0.04)
    lengths = [len(run) for run in "".join("x" if gone else "." for gone in lost).split(".") if run]
    assert statistics.mean(lengths) == pytest.approx(max(burst, 1.25), rel=0.2)


def test_at_a_loss_of_100_percent_nothing_arrives() -> None:
    assert not any(arrivals(Impairment(loss_percent=100), regular(50)))


def test_jitter_spreads_the_delay_and_keeps_the_order() -> None:
    times = [copies[0] for copies in arrivals(Impairment(delay_ms=50, jitter_ms=10), regular())]
    assert times == sorted(times)
    delays = [arrived - sent for arrived, sent in zip(times, regular(), strict=True)]
    assert min(delays) >= 0.0 and statistics.mean(delays) == pytest.approx(0.06, abs=0.01)
    assert statistics.stdev(delays) > 0.004


def test_reordered_packets_are_overtaken() -> None:
    times = [copies[0] for copies in arrivals(Impairment(reorder_percent=10, reorder_ms=25), regular())]
    late = [arrived - sent >= 0.02 for arrived, sent in zip(times, regular(), strict=True)]
    assert share(late) == pytest.approx(0.1, abs=0.02) and times != sorted(times)


def test_duplicated_packets_arrive_twice_at_the_given_share() -> None:
    copies = [len(each) for each in arrivals(Impairment(duplicate_percent=25), regular())]
    assert set(copies) == {1, 2} and share([count == 2 for count in copies]) == pytest.approx(0.25, abs=0.03)


@pytest.mark.parametrize(
    "wrong",
    [{"loss_percent": 101}, {"delay_ms": -1}, {"delay_ms": 1e9}, {"jitter_ms": float("nan")}, {"loss_burst": 0.5}],
)
def test_an_impossible_impairment_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(wrong))}: expected"):
        Impairment(**wrong)
