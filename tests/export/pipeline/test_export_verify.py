"""`edge-export verify`: a directory is what the export would write, and still the same model."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from edge.artifacts.files import seal
from export.cli import main
from export.core.cache import file_sha256
from export.pipeline import job
from export.targets.file import TARGETS_DIR
from tests.support.export.export_job import manifest


def test_verify_repeats_the_gate(artifacts_dir: Path) -> None:
    assert main(["verify", str(artifacts_dir)]) == 0


def resealed(directory: Path, keys: str, value: object) -> Path:
    """One value of the manifest changed by somebody who also renewed its hash."""
    content = manifest(directory)
    *above, last = keys.split("/")
    table = content
    for key in above:
        table = table[key]
    assert table[last] != value
    table[last] = value
    (directory / "manifest.json").write_text(json.dumps(seal(content)))
    return directory


@pytest.mark.parametrize(
    ("keys", "value", "message"),
    [
        ("runtime/tick_period_ms", 900, "runtime: tick_period_ms is 900, the plan's is 100"),
        ("runtime/img_context_id", 7, "tokenizer.json: <IMG_CONTEXT> is id 5, the network was built for 7"),
        ("runtime/frame_offsets_s", [0.0, 1.0, 3.0, 6.0], "runtime.frame_offsets_s is"),
        ("runtime/max_new_tokens", 47, "runtime.max_new_tokens is 47"),
        ("graphs/action_expert/session/threads", 2, "graphs.action_expert.session.threads is 2"),
        ("graphs/vision_encoder/precision/default", "int8", 'graphs.vision_encoder.precision.default is "int8"'),
        ("model/name", "1b", 'model.name is "1b"'),
        ("model/trained", True, "model.trained is true, this export writes false"),
        ("model/config/action/step_s", 0.2, "step_s is 0.1, the network was built for 0.2"),
        ("model/config/action/layers", 5, "model.config.action.layers is 5"),
        ("provenance/target/gates/action_expert/max_abs", 9.0, "gates.action_expert.max_abs is 9.0"),
    ],
)
def test_a_manifest_that_was_changed_and_sealed_again_does_not_verify(
    artifacts_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], keys: str, value: object, message: str
) -> None:
    copy = resealed(Path(shutil.copytree(artifacts_dir, tmp_path / "nano")), keys, value)
    assert main(["verify", str(copy)]) == 1
    error = capsys.readouterr().err.splitlines()[-1]
    assert message in error


def test_another_tokenizer_does_not_verify_although_the_manifest_vouches_for_it(
    artifacts_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = Path(shutil.copytree(artifacts_dir, tmp_path / "nano"))
    tokenizer = json.loads((copy / "tokenizer.json").read_text())
    (copy / "tokenizer.json").write_text(json.dumps(tokenizer, indent=3))
    listed = {"sha256": file_sha256(copy / "tokenizer.json"), "bytes": (copy / "tokenizer.json").stat().st_size}
    resealed(copy, "files/tokenizer.json", listed)
    assert main(["verify", str(copy)]) == 1
    assert "tokenizer.json: not the tokenizer" in capsys.readouterr().err


@pytest.mark.slow
def test_changed_thresholds_are_kept_and_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    setting = "gates.action_expert.max_abs=0.5"
    assert main(["--out", str(tmp_path / "nano"), "--set", setting]) == 0
    assert main(["verify", str(tmp_path / "nano")]) == 0
    assert f"note: thresholds were changed with --set for this build: {setting}" in capsys.readouterr().err


@pytest.mark.slow
def test_a_directory_for_a_users_target_names_the_origin_of_its_thresholds(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = tmp_path / "own.toml"
    own.write_text((TARGETS_DIR / "cpu.toml").read_text())
    assert main(["--target", str(own), "--out", str(tmp_path / "nano")]) == 0
    assert main(["verify", str(tmp_path / "nano")]) == 0
    assert "checked against the thresholds in the manifest" in capsys.readouterr().err


def test_verify_refuses_artifacts_of_other_weights(artifacts_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", str(artifacts_dir), "--random-weights", "5"]) == 1
    assert "other weights" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shipped", "code", "message"), [(False, 2, "pass these weights with"), (True, 1, "other weights than")]
)
def test_verify_of_a_checkpoint_takes_the_checkpoint(
    artifacts_dir: Path, tmp_path: Path, capsys: Any, monkeypatch: Any, shipped: bool, code: int, message: str
) -> None:
    saved, others, out = tmp_path / "nano.safetensors", tmp_path / "others.safetensors", tmp_path / "nano"
    for seed, weights in ((0, saved), (1, others)):
        where = str(tmp_path / f"first{seed}")
        assert main(["--out", where, "--random-weights", str(seed), "--save-weights", str(weights)]) == 0
    assert main(["--out", str(out), "--checkpoint", str(saved)]) == 0
    capsys.readouterr()
    monkeypatch.setattr(job, "shipped_weights", lambda config: others if shipped else None)
    assert main(["verify", str(out)]) == code
    error = capsys.readouterr().err
    assert message in error and "checkpoint" in error
    assert main(["verify", str(out), "--checkpoint", str(saved)]) == 0
