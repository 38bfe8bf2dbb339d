"""The full-size comparison counts what differs; it is run by hand, so its measures are held here."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tools.bench.parity_1b import compare, main


def outputs() -> dict[str, Any]:
    rng = np.random.default_rng(0)
    return {
        "visual_tokens": rng.standard_normal((2, 8, 4)),
        "last_layer_kv": rng.standard_normal((1, 20, 8)),
        "logits": rng.standard_normal((5, 30)),
        "text": np.arange(6),
    }


def missed(theirs: dict[str, Any], ours: dict[str, Any]) -> list[str]:
    return [measure for measure, row in compare(theirs, ours).items() if not row.get("kept", True)]


def test_the_same_outputs_keep_every_bound() -> None:
    assert missed(outputs(), outputs()) == []


@pytest.mark.parametrize("name", ["visual_tokens", "last_layer_kv", "logits"])
def test_one_changed_number_misses_the_largest_difference(name: str) -> None:
    ours = outputs()
    ours[name].flat[-1] += 2e-3
    assert missed(outputs(), ours) == [f"{name} max-abs"]


def test_tokens_count_up_to_the_first_that_differs() -> None:
    ours = outputs() | {"text": np.array([0, 1, 9, 3, 4, 5])}
    rows = compare(outputs(), ours)
    assert rows["greedy tokens identical"] == {"value": 2, "bound": 6, "kept": False}


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [["--frames", "0"], ["--frames", "9"], ["--model", "7b"], ["--json", "/"]])
def test_bad_arguments_are_refused_before_anything_is_built(arguments: list[str]) -> None:
    assert main(arguments) == 2
