"""The profile covers every graph and accounts for all of its nodes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tools.bench.profile import main


@pytest.mark.slow
def test_every_graph_is_profiled_by_operator(nano_dir: Path, tmp_path: Path) -> None:
    out = tmp_path / "profile.json"
    assert main(["--artifacts", str(nano_dir), "--context", "200", "--threads", "1", "--json", str(out)]) == 0
    found = json.loads(out.read_text())
    assert set(found) == {"vision_encoder", "language_model", "semantic_context", "action_expert"}
    layers = 4
    assert found["language_model"]["operators"]["GroupQueryAttention"]["nodes"] == layers
    for graph in found.values():
        assert graph["total_ms"] == pytest.approx(sum(entry["ms"] for entry in graph["operators"].values()))


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [["--graphs", "nothing"], ["--context", "0"], ["--context", "9999"]])
def test_a_graph_that_cannot_be_profiled_is_one_line(
    nano_dir: Path, wrong: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--artifacts", str(nano_dir), *wrong]) == 2
    assert capsys.readouterr().err.count("\n") == 1
