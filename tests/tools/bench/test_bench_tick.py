"""The tick's benchmark: parts in turn, their sum as the tick."""

from __future__ import annotations

import pytest

from tools.bench.tick import PARTS, WARM_ROUNDS, measure


def test_contenders_take_turns_and_the_first_rounds_are_left_out() -> None:
    order: list[str] = []
    contenders = {
        name: {part: lambda name=name, part=part: order.append(f"{name} {part}") for part in PARTS} for name in "ab"
    }
    samples = measure(contenders, PARTS, 2)
    assert order[:4] == ["a encoder", "a action", "b encoder", "b action"]
    assert len(order) == 4 * (2 + WARM_ROUNDS)
    assert {
        len(values) for of_parts in samples.values() for units in of_parts.values() for values in units.values()
    } == {2}


def test_a_tick_is_the_sum_of_its_parts_and_only_of_both() -> None:
    contenders = {"a": {part: lambda: None for part in PARTS}}
    parts = measure(contenders, PARTS, 3)["a"]
    for unit in ("wall_ms", "cpu_ms"):
        both = [sum(pair) for pair in zip(*(parts[part][unit] for part in PARTS), strict=True)]
        assert parts["tick"][unit] == pytest.approx(both)
    assert set(measure(contenders, ["action"], 3)["a"]) == {"action"}
