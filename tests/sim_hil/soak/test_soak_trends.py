"""Trends of a soak: one value a minute over legs of any machines, and the line through them with its interval."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sim_hil.soak.trends import SERIES, jitter_ms, trend, trends, windows

S = 1_000_000_000


def leg(begin_ns: int, minutes: int, first_ms: float, per_minute_ms: float) -> dict[str, Any]:
    """A leg with ten noisy ticks a minute."""
    at_s = np.arange(0, minutes * 60, 6)
    noise = np.random.default_rng(begin_ns % 97).normal(0, 0.2, len(at_s))
    tick_ms = [first_ms + per_minute_ms * t / 60 + float(each) for t, each in zip(at_s, noise, strict=True)]
    life = {"tick_ns": [begin_ns + int(t) * S for t in at_s], "tick_ms": tick_ms, "delay_s": [None] * len(at_s)}
    life |= {"ready_ns": [], "generation_ms": []}
    return {"begin_ns": begin_ns, "elapsed_s": 60.0 * minutes, "lives": [life], "command_ns": [], "command_gap_ms": []}


def test_a_growth_over_legs_of_two_machines_is_one_line() -> None:
    found = trends([leg(5 * S, 20, 10.0, 0.1), leg(900_000 * S, 20, 12.0, 0.1)])["tick_ms.p99"]
    assert found is not None
    assert found.number == 40
    assert found.per_h == pytest.approx(6.0, rel=0.1)
    assert found.low < 6.0 < found.high


def test_a_constant_figure_has_an_interval_around_zero() -> None:
    found = trends([leg(S, 40, 10.0, 0.0)])["tick_ms.p99"]
    assert found is not None and found.low < 0.0 < found.high


def test_a_short_soak_and_one_without_values_have_no_trend() -> None:
    short = trends([leg(S, 9, 10.0, 0.0)])
    assert set(short.values()) == {None}


def test_a_minute_without_values_is_left_out() -> None:
    first, second = leg(S, 5, 10.0, 0.0), leg(S, 5, 10.0, 0.0)
    first["elapsed_s"] = 600.0  # five minutes without a runner
    at_s, values = windows([first, second], SERIES["tick_ms.p99"])
    assert len(at_s) == len(values) == 10
    assert at_s[5] - at_s[4] == pytest.approx(360.0)


def test_outliers_do_not_bend_a_trend() -> None:
    values = np.full(40, 10.0)
    values[[3, 30]] = 500.0
    found = trend(np.arange(40) * 60.0, values)
    assert found is not None and found.per_h == pytest.approx(0.0, abs=1e-9)


def commands(gaps_ms: list[float], stalls_ms: list[tuple[float, float]] | None = None) -> dict[str, Any]:
    """A leg with these gaps between commands, the first of which begins at 1 s; stalls in ms after that."""
    end_ns = S + np.cumsum(np.array(gaps_ms) * 1e6).astype(int)
    leg = {"command_gap_ms": gaps_ms, "command_ns": end_ns.tolist()}
    if stalls_ms is not None:
        leg["stalls"] = [[S + round(a * 1e6), S + round(b * 1e6)] for a, b in stalls_ms]
    return leg


class TestJitter:
    def test_it_is_the_distance_from_the_period(self) -> None:
        assert jitter_ms(commands([20.0, 45.5, 9.0], [])).tolist() == pytest.approx([0.0, 25.5, 11.0])

    def test_a_stall_of_the_machine_in_a_late_gap_is_not_the_bridges(self) -> None:
        found = jitter_ms(commands([20.0, 45.0, 9.0], [(38.0, 60.0)]))
        assert found[:2].tolist() == pytest.approx([0.0, 5.0])

    def test_the_short_gap_after_a_stalled_one_is_the_machines_too(self) -> None:
        assert jitter_ms(commands([20.0, 45.0, 3.0, 3.0], [(40.0, 55.0)])).tolist() == pytest.approx(
            [0, 10.0, 2.0, 17.0]
        )

    @pytest.mark.parametrize(
        ("gap_ms", "stall_ms", "left_ms"),
        [(57.0, (2.0, 19.0), 37.0), (50.0, (0.0, 15.0), 30.0), (25.0, (3.0, 23.0), 2.0), (45.0, (10.0, 45.0), 0.0)],
    )
    def test_only_what_stalls_after_a_command_is_due_delays_it(
        self, gap_ms: float, stall_ms: tuple[float, float], left_ms: float
    ) -> None:
        assert jitter_ms(commands([gap_ms], [stall_ms])).tolist() == pytest.approx([left_ms])

    def test_a_stall_in_a_gap_in_time_does_not_explain_an_early_command(self) -> None:
        assert jitter_ms(commands([20.0, 5.5], [(2.0, 18.0)])).tolist() == pytest.approx([0.0, 14.5])

    def test_a_stall_of_one_processor_may_hold_the_bridge_after_a_command_that_it_sent_on_another(self) -> None:
        assert jitter_ms(commands([20.0, 45.0], [(10.0, 60.0)])).tolist() == pytest.approx([0.0, 5.0])

    def test_a_stall_elsewhere_changes_nothing(self) -> None:
        assert jitter_ms(commands([20.0, 45.0], [(0.0, 20.0), (65.0, 90.0)])).tolist() == pytest.approx([0.0, 25.0])

    @pytest.mark.parametrize("missing", [{}, {"stalls": None}])
    def test_a_leg_without_measured_stalls_has_none(self, missing: dict[str, None]) -> None:
        assert jitter_ms(commands([45.0]) | missing).tolist() == pytest.approx([25.0])
