"""The models that findings are about: exported once each from a run and its ablations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save_file

from edge.core.cli import EXIT_BAD_INPUT, EXIT_DONE
from tools.findings.models import main, models_of
from tools.train.config.recipe import VARIANTS, load_recipe


def run_of(folder: Path, *stages: str, variant: str = "full", policy: float | None = None) -> Path:
    """A run that has left weights of some stages; `policy`: the same action expert in all of them."""
    for stage in stages:
        (folder / stage).mkdir(parents=True)
        of = float(sum(map(ord, stage)))
        tensors = {"action.out": np.array([of if policy is None else policy]), "value.head": np.array([of])}
        save_file(tensors, folder / stage / "model.safetensors")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "recipe.toml").write_text(load_recipe("tiny", VARIANTS[variant]).to_toml())
    return folder


@pytest.fixture
def command(tmp_path: Path) -> list[str]:
    """An `edge-export` that leaves a manifest."""
    script = tmp_path / "export.sh"
    script.write_text('mkdir -p "${@: -1}"\ntouch "${@: -1}/manifest.json"\n')
    return ["bash", str(script)]


@pytest.mark.slow
def test_a_run_gives_the_model_before_and_after_ppo_and_its_ablations(tmp_path: Path) -> None:
    run = run_of(tmp_path / "run", "encoder", "sft", "imitate", "rl")
    run_of(tmp_path / "ablations" / "no-latency", "imitate", variant="no-latency")
    run_of(tmp_path / "ablations" / "waypoints", variant="waypoints")
    found = {model.name: model for model in models_of(run, tmp_path / "ablations")}
    assert set(found) == {"no-rl", "rl", "no-latency"}
    assert found["rl"].weights == run / "rl" / "model.safetensors"
    assert not found["no-latency"].recipe.model.action.latency_aware


@pytest.mark.parametrize("stages", [("imitate",), ("imitate", "rl")])
def test_without_a_policy_of_its_own_ppo_has_left_imitations(stages: tuple[str, ...], tmp_path: Path) -> None:
    run = run_of(tmp_path / "run", *stages, policy=1.0)
    found = {model.name: model.weights for model in models_of(run, None)}
    assert found == dict.fromkeys(("no-rl", "rl"), run / "imitate" / "model.safetensors")


def test_a_run_without_a_policy_of_ppo_is_reported(tmp_path: Path, command: list[str], capsys: Any) -> None:
    assert main(["--run", str(run_of(tmp_path / "run", "imitate")), "--out", str(tmp_path / "m")], command) == EXIT_DONE
    assert "rl: reinforcement learning kept no policy" in capsys.readouterr().err


def test_every_model_has_a_folder_of_its_own(tmp_path: Path, command: list[str]) -> None:
    run = run_of(tmp_path / "run", "imitate", "rl")
    assert main(["--run", str(run), "--out", str(tmp_path / "models")], command) == EXIT_DONE
    assert {path.parent.name for path in (tmp_path / "models").glob("*/manifest.json")} == {"rl", "no-rl"}


@pytest.mark.parametrize(("is_run", "message"), [(True, "has no weights yet"), (False, "holds no run of edge-train")])
def test_a_folder_without_weights_is_refused(
    is_run: bool, message: str, tmp_path: Path, command: list[str], capsys: Any
) -> None:
    run = run_of(tmp_path / "run", "collect") if is_run else tmp_path
    assert main(["--run", str(run), "--out", str(tmp_path / "models")], command) == EXIT_BAD_INPUT
    assert message in capsys.readouterr().err
