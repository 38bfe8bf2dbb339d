"""Reinforcement learning as a command: workers that really drive, the exported language model beside the policy."""

from __future__ import annotations

from pathlib import Path

import pytest

from edge.core.cli import EXIT_CHECK_FAILED, EXIT_DONE
from export.model.network import build
from export.model.weights import WeightsInfo, save_weights
from tools.train import cli
from tools.train.config.recipe import load_recipe
from tools.train.rl.rl import POINT_GOAL_FILE
from tools.train.run.run_dir import RunDir

SHORT = (
    "rl.rotation=corridor", "rl.iterations=1", "rl.max_s=5", "rl.mean_delay_s=0.4", "rl.warmup_iterations=0",
    "rl.final_episodes=1", "rl.evaluate_episodes=1", "rl.ppo.batch=16", "rl.ppo.epochs=1",
)  # fmt: skip


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    """Of a network that calls itself trained."""
    path = tmp_path / "imitated.safetensors"
    save_weights(build(load_recipe("tiny").model, 0), path, WeightsInfo(True, "made for a test"))
    return path


def _rl(out: Path, weights: Path, *more: str) -> int:
    settings = [argument for setting in SHORT for argument in ("--set", setting)]
    start = ["--checkpoint", str(weights), "--after", "imitate"]
    return cli.main(["rl", "--preset", "tiny", "--out", str(out), *start, *settings, *more])


@pytest.mark.slow
def test_an_iteration_drives_learns_and_is_evaluated(tmp_path: Path, weights: Path) -> None:
    run_dir = RunDir(tmp_path / "run")
    assert _rl(run_dir.out, weights) == EXIT_DONE
    result = run_dir.result("rl")
    assert result is not None and result["iterations"] == 1
    # Two episodes of 5 s at 10 Hz, less the time until the first semantic state.
    assert 40 <= result["steps"] <= 100
    assert run_dir.model_path.is_file() and [line["step"] for line in run_dir.lines()] == [1]


@pytest.mark.slow
def test_a_point_goal_policy_that_has_learned_nothing_is_not_handed_over(
    tmp_path: Path, weights: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert _rl(out, weights, "--variant", "point-goal-rl") == EXIT_CHECK_FAILED
    assert "no policy is better than the untrained one" in capsys.readouterr().err
    assert not (out / "rl" / POINT_GOAL_FILE).exists()
