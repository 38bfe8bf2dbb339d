"""The contention benchmark tells ticks beside reasoning from ticks alone, and holds each figure to its bound."""

from __future__ import annotations

import pytest

from tools.bench.contention import BLOCK_S, Tick, allowed, block_ratios, summarise

BLOCK_NS = round(BLOCK_S * 1e9)


def blocks(*medians_ms: float, first: int = 0) -> list[Tick]:
    return [
        Tick((first + number) * BLOCK_NS + i * 100_000_000, ms, allowed((first + number) * BLOCK_NS))
        for number, ms in enumerate(medians_ms)
        for i in range(100)
    ]


@pytest.mark.parametrize(("first", "expected"), [(0, [1.5, 1.5]), (1, [1 / 1.5, 1 / 1.5])])
def test_a_ratio_is_of_neighbours_with_reasoning_over_without(first: int, expected: list[float]) -> None:
    assert block_ratios(blocks(15.0, 10.0, 15.0, first=first)) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("ticks", "missed", "check"),
    [
        (blocks(13.0, 10.0), 0, "ratio"),
        (blocks(10.0, 10.0), 1, "missed"),
        ([*blocks(10.0, 10.0), *blocks(150.0)[:5]], 0, "p999_ms"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_every_bound_can_be_broken(ticks: list[Tick], missed: int, check: str) -> None:
    result = summarise(ticks, missed=missed, generations=5, busy=0.9)
    checks = result["checks"]
    assert isinstance(checks, dict)
    assert [name for name, ok in checks.items() if not ok] == [check] and not result["ok"]


def test_a_run_of_one_phase_says_nothing() -> None:
    with pytest.raises(ValueError, match="alone"):
        summarise(blocks(10.0), missed=0, generations=5, busy=0.9)
