"""What `edge-train` shows of a run: progress, curves, and beforehand what it will take."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.train.config.recipe import load_recipe
from tools.train.pipeline.chain import Line, budget_of, lines_of, steps_of
from tools.train.run.curves import draw_curves
from tools.train.run.job import progress_for
from tools.train.run.run_dir import RunDir

TINY = load_recipe("tiny")


@pytest.fixture
def run_dir(tmp_path: Path) -> RunDir:
    return RunDir.open(tmp_path / "run", TINY)


@pytest.mark.slow
def test_curves_are_drawn_of_every_stage_that_has_more_than_a_point(run_dir: RunDir) -> None:
    for step in range(200):
        run_dir.log("sft", step, loss=100.0 / (1 + step), lr=1e-3, val_loss=5.0)
    run_dir.log("rl", 1, success=0.5)
    assert [path.name for path in draw_curves(run_dir)] == ["sft.png"]
    first = (run_dir.curves / "sft.png").read_bytes()
    draw_curves(run_dir)
    assert (run_dir.curves / "sft.png").read_bytes() == first


def test_the_budget_adds_up_measured_times_and_names_missing_ones() -> None:
    steps = steps_of("all", TINY)
    printed = lines_of(TINY, steps, [Line("sft", "anchors", 5400, 54.0), Line("rl", "steps", 9, None)], "cpu")
    assert "1 min 40 s" in printed[-1] and "1 parts without a measured rate" in printed[-1]
    assert {line.step for line in budget_of(TINY, steps, "cpu")} >= {"dagger-1", "evaluate"}


def test_progress_is_lines_with_the_newest_values(capsys: pytest.CaptureFixture[str]) -> None:
    with progress_for("sft") as progress, progress_for("sft", quiet=True) as quiet:
        progress.update(4, 4, loss=0.51234)
        quiet.update(4, 4, loss=0.51234)
    line = capsys.readouterr().err
    assert line.startswith("edge-train: sft: 4 of 4 (") and line.endswith("), loss 0.5123\n")
