"""Figures of the live view's cost: blocks, missed ticks, ratios within a round, slopes."""

from __future__ import annotations

import pytest

from tools.bench.live_cost import (
    ALONE,
    CONDITIONS,
    FIVE,
    NONE,
    ONE,
    Block,
    Sample,
    orders,
    sample_of,
    slope_mib_per_h,
    summarise,
)
from tools.bench.live_cost import main as live_cost

MS = 1_000_000


def sample(condition: str, ticks_ms: list[float], cpu: float = 20.0) -> Sample:
    return Sample(condition, ticks_ms, 0, cpu, 0.0)


def test_a_block_has_the_ticks_of_its_time_and_the_periods_that_lack_one() -> None:
    ticks = [(k * 100 * MS, float(k)) for k in range(20) if k not in (7, 8)]
    found = sample_of(Block(ONE, 400 * MS, 1200 * MS, 0.4, 0.08), ticks)
    assert found.ticks_ms == [4.0, 5.0, 6.0, 9.0, 10.0, 11.0]
    assert found.missed == 2
    assert (found.runner_cpu, found.view_cpu) == (pytest.approx(50.0), pytest.approx(10.0))


def test_a_block_after_the_end_of_the_run_is_refused() -> None:
    with pytest.raises(ValueError, match="no tick"):
        sample_of(Block(ONE, 5_000 * MS, 6_000 * MS, 0.0, 0.0), [(0, 1.0)])


def test_a_ratio_compares_conditions_of_one_round() -> None:
    """The second round ran on a machine twice as slow, which is no cost of the view."""
    rounds = [[sample(name, [10.0 * k] * 50, 20.0 * k) for name in CONDITIONS] for k in (1, 2)]
    rounds = [[*one[:-1], sample(FIVE, [1.1 * one[0].ticks_ms[0]] * 50, one[0].runner_cpu)] for one in rounds]
    result = summarise(rounds)
    assert result["conditions"][ONE]["ratios"] == {"p50": 1.0, "p99": 1.0, "runner_cpu": 1.0}
    assert result["conditions"][FIVE]["ratios"]["p50"] == pytest.approx(1.1)
    assert result["ok"]


def test_the_order_turns_so_that_no_condition_is_always_the_first() -> None:
    found = list(orders(6))
    assert [bare_first for bare_first, _ in found] == [True, False] * 3
    assert {watched[0] for _, watched in found} == {ALONE, ONE, FIVE} and NONE not in found[0][1]


def test_a_slope_ignores_the_growth_of_the_first_third() -> None:
    samples = [(float(s), 50.0 + min(s, 300)) for s in range(1000)]
    assert slope_mib_per_h(samples) == pytest.approx(0.0, abs=1e-6)
    assert slope_mib_per_h([(float(s), s / 360) for s in range(1000)]) == pytest.approx(10.0)


def test_arguments_that_measure_nothing_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert live_cost(["--artifacts", "x", "--rounds", "0"]) == 2
    assert "expected --rounds" in capsys.readouterr().err
