"""What `edge-train` shows of a run: progress, curves, and beforehand what it will take."""

from __future__ import annotations

from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from tools.train.config.recipe import load_recipe
from tools.train.pipeline.chain import Line, budget_of, lines_of, steps_of
from tools.train.run.curves import draw_curves
from tools.train.run.job import PlainProgress, StageBar
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


def test_the_budget_adds_up_what_was_measured_and_names_what_was_not() -> None:
    steps = steps_of("all", TINY)
    told = lines_of(TINY, steps, [Line("sft", "anchors", 5400, 54.0), Line("rl", "steps", 9, None)], "cpu")
    assert "1 min 40 s" in told[-1] and "1 parts without a measured rate" in told[-1]
    assert {line.step for line in budget_of(TINY, steps, "cpu")} >= {"dagger-1", "evaluate"}


def test_progress_elsewhere_than_on_a_terminal_is_a_line_now_and_then(capsys: Any) -> None:
    progress = PlainProgress("sft", period_s=1e9)
    for done in (1, 2, 3, 4, 4, 4):
        progress.update(done, 4, loss=0.5)
    progress.update(1, 9)
    assert capsys.readouterr().err.count("\n") == 1
    progress.update(9, 9)
    assert "9 of 9" in capsys.readouterr().err


def test_on_a_terminal_one_bar_shows_one_thing_after_another() -> None:
    shown = StringIO()
    with StageBar("sft", Console(file=shown, force_terminal=True, width=120)) as bar:
        bar.update(1, 4, loss=0.5)
        bar.say("looking")
        bar.update(9, 9)
    assert "looking" in shown.getvalue() and "9/9" in shown.getvalue()
