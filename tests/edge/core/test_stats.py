"""Figures of a run: exact while they fit, within one percent afterwards, in memory that does not grow."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.stats import Samples, percentiles

values = st.lists(st.floats(0.001, 1e5), min_size=1, max_size=200)


@given(values)
def test_percentiles_are_values_that_occurred(numbers: list[float]) -> None:
    found = percentiles(numbers, "p50", "p99", "p999", "max")
    assert all(any(round(number, 4) == value for number in numbers) for value in found.values())


@given(values)
def test_beyond_what_is_kept_a_percentile_is_within_one_percent(numbers: list[float]) -> None:
    samples = Samples(exact=1)
    for number in numbers:
        samples.add(number)
    for point, share in (("p50", 50.0), ("p99", 99.0)):
        exact = float(np.percentile(numbers, share, method="inverted_cdf"))
        found = percentiles(samples, point)[point]
        assert found == pytest.approx(exact, rel=0.0101, abs=1e-4)
    assert percentiles(samples, "max")["max"] == round(max(numbers), 4)


def test_no_samples_have_no_percentiles() -> None:
    assert percentiles(Samples(), "p50", "max") == {"p50": None, "max": None}
    assert percentiles([], "p50") == {"p50": None}


def test_memory_does_not_grow_with_the_samples() -> None:
    samples = Samples(exact=10)
    before = sum(sys.getsizeof(value) for value in vars(samples).values())
    for number in range(5000):
        samples.add(float(number))
    assert sum(sys.getsizeof(value) for value in vars(samples).values()) <= before + 64
    assert len(samples) == 5000


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_values_that_are_not_finite_are_not_counted(value: float) -> None:
    samples = Samples()
    samples.add(value)
    assert len(samples) == 0
