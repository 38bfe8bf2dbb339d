"""Files that the model card reads: damaged ones are refused in one line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sim_hil.benchmark.conditions.conditions import Conditions, PolicySpec
from tools.train.config.checks import TrainError
from tools.train.pipeline.model_card import parameters, score

SUMMARY = {"episodes": 1, "sr": 1.0, "spl": 1.0, "cr": 0.0, "ne_m": 1.0, "finished": True}


@pytest.mark.parametrize("content", [b"", b"\x00" * 40, b"not tensors at all"])
def test_damaged_weights_are_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    path.write_bytes(content)
    with pytest.raises(TrainError, match=r"model\.safetensors: expected weights of edge-train"):
        parameters(path)


@pytest.mark.parametrize(
    "wrong",
    [
        {"summary": {"finished": True}},
        {"summary": {**SUMMARY, "sr": "high"}},
        {"summary": []},
        {"latency": []},
        {"suite": 5},
    ],
    ids=lambda wrong: json.dumps(wrong)[:30],
)
def test_scores_that_lack_what_the_card_shows_are_refused(wrong: dict[str, object], tmp_path: Path) -> None:
    conditions = Conditions(PolicySpec("still")).as_json()
    content = {"suite": "dynanav", "conditions": conditions, "latency": {}, "trained": True, "summary": SUMMARY}
    path = tmp_path / "result.json"
    path.write_text(json.dumps(content))
    assert score(path)["suite"] == "dynanav"
    path.write_text(json.dumps({**content, **wrong}))
    with pytest.raises(TrainError, match=r"result\.json: expected a result\.json of edge-bench"):
        score(path)
