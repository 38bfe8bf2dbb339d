"""The benchmark of recording: as many as were asked for, and one line for bad arguments."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from edge.core.cli import EXIT_BAD_INPUT, EXIT_DONE
from tools.bench.sim import collection

RECIPE = """
schema = 1
name = "short"
seed = 1
[model]
preset = "nano"
[collect]
kinds = { corridor = 1.0 }
legs = false
[sft.tours]
people_most = 0
"""


@pytest.mark.slow
def test_tours_and_drives_are_recorded_and_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recipe, rows = tmp_path / "short.toml", tmp_path / "rows.json"
    recipe.write_text(RECIPE)
    arguments = ["--recipe", str(recipe), "--count", "1", "--profile", "--json", str(rows)]
    assert collection.main(arguments) == EXIT_DONE
    drives, tours = json.loads(rows.read_text())["rows"]
    assert (drives["kind"], tours["kind"]) == ("drives", "tours")
    for row in (drives, tours):
        assert row["recorded"] == 1 and row["recorded_s"] > 1 and row["cpu_s"] > 0 and row["tagged"] == "measured"
        assert row["per_core_hour"] == pytest.approx(3600 / row["cpu_s"], rel=0.01)
    assert "a core-hour" in (text := capsys.readouterr().out) and "cumulative" in text


@pytest.mark.parametrize("arguments", [["--count", "0"], ["--seed", "-1"], ["--recipe", "nope"]])
def test_bad_arguments_are_one_line(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert collection.main(arguments) == EXIT_BAD_INPUT
    assert capsys.readouterr().err.count("\n") == 1
