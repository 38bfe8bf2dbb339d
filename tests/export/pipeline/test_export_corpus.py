"""Damaged directories and wrong arguments: one line, a documented exit code, nothing left behind, nothing changed."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import onnx
import pytest

from export.cli import main
from tests.support.artifact_directory import edit_manifest, flip_bit, replace_file

Damage = Callable[[Path], None]


def cut(directory: Path, name: str) -> None:
    data = (directory / name).read_bytes()
    (directory / name).write_bytes(data[: len(data) // 2])


def reshape(directory: Path) -> None:
    """An action expert that takes one more number of state, which no manifest names."""
    proto = onnx.load(str(directory / "action_expert.onnx"))
    state = next(tensor for tensor in proto.graph.input if tensor.name == "state")
    state.type.tensor_type.shape.dim[1].dim_value = 4
    replace_file(directory, "action_expert.onnx", proto.SerializeToString())


def link_out(directory: Path) -> None:
    outside = directory.parent / "outside.json"
    shutil.move(directory / "tokenizer.json", outside)
    (directory / "tokenizer.json").symlink_to(outside)


def lengthen(directory: Path) -> None:
    def change(manifest: dict[str, Any]) -> None:
        shape = next(t for t in manifest["graphs"]["action_expert"]["outputs"] if t["name"] == "trajectory")["shape"]
        shape[2] = 4

    edit_manifest(directory, change)


DAMAGED: dict[str, tuple[Damage, str]] = {
    "a flipped bit in a graph": (lambda d: flip_bit(d, "language_model.onnx"), "language_model.onnx: sha256"),
    "a flipped bit in the report": (lambda d: flip_bit(d, "report.html"), "report.html: sha256"),
    "a truncated graph": (lambda d: cut(d, "vision_encoder.onnx"), "vision_encoder.onnx: "),
    "a truncated manifest": (lambda d: cut(d, "manifest.json"), "manifest.json: not JSON"),
    "no manifest": (lambda d: (d / "manifest.json").unlink(), "manifest.json: cannot be read"),
    "a missing graph": (lambda d: (d / "action_expert.onnx").unlink(), "action_expert.onnx: missing"),
    "a planted pickle": (lambda d: (d / "weights.pkl").write_bytes(b"\x80\x04."), "weights.pkl: not listed"),
    "a link that leads out": (link_out, "tokenizer.json: missing or not a regular file"),
    "a listed path that leads out": (
        lambda d: edit_manifest(d, lambda m: m["files"].update({"../evil": {"bytes": 1, "sha256": "0" * 64}})),
        "'../evil' is not a plain name",
    ),
    "a data file that leads out": (
        lambda d: edit_manifest(d, lambda m: m["graphs"]["vision_encoder"].update(data_files=["../../etc/passwd"])),
        "'../../etc/passwd' is not among the files",
    ),
    "another schema": (lambda d: edit_manifest(d, lambda m: m.update(schema_version=1)), "schema version 1"),
    "a graph of another shape": (reshape, "action_expert.onnx: ONNX Runtime cannot open it"),
    "a contract of another shape": (lengthen, "trajectory is"),
    "a pickle in a graph's place": (lambda d: replace_file(d, "vision_encoder.onnx", b"\x80\x04."), "is a pickle"),
    "a file that is no graph": (lambda d: replace_file(d, "vision_encoder.onnx", b"not a graph"), "not an ONNX model"),
    "a graph that is another": (
        lambda d: replace_file(d, "action_expert.onnx", (d / "semantic_context.onnx").read_bytes()),
        "not those of the manifest",
    ),
    "a renamed output": (
        lambda d: edit_manifest(d, lambda m: m["graphs"]["language_model"]["outputs"][2].update(name="confidence")),
        "not those of the manifest",
    ),
    "no provenance": (lambda d: edit_manifest(d, lambda m: m.update(provenance={})), "provenance cannot be read"),
    "a target that is none": (
        lambda d: edit_manifest(d, lambda m: m["provenance"]["target"].update(turbo=True)),
        "provenance cannot be read (provenance.target: unknown key 'turbo'",
    ),
    "a network that is none": (
        lambda d: edit_manifest(d, lambda m: m["model"]["config"]["action"].update(layers=-1)),
        "provenance cannot be read",
    ),
    "a calibration set that is another": (
        lambda d: edit_manifest(d, lambda m: m["provenance"]["calibration"].update(sha256="0" * 64)),
        "calibration set corridor-go2 has sha256 000000000000…",
    ),
    "weights that are others": (
        lambda d: edit_manifest(d, lambda m: m["provenance"].update(weights_sha256="0" * 64)),
        "built from other weights",
    ),
    "a session of nowhere": (
        lambda d: edit_manifest(d, lambda m: m["graphs"]["vision_encoder"].update(session={"provider": "x"})),
        "session must give",
    ),
}


def contents(directory: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in directory.iterdir()}


@pytest.mark.slow
@pytest.mark.parametrize("case", DAMAGED, ids=lambda case: case.replace(" ", "-"))
def test_a_damaged_directory_does_not_verify_and_is_not_touched(
    artifacts_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], case: str
) -> None:
    damage, message = DAMAGED[case]
    copy = Path(shutil.copytree(artifacts_dir, tmp_path / "nano"))
    damage(copy)
    before, beside = contents(copy), sorted(tmp_path.iterdir())
    assert main(["verify", str(copy)]) == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("edge-export: [")]
    assert len(lines) == 1
    assert message in lines[0]
    assert contents(copy) == before
    assert sorted(tmp_path.iterdir()) == beside


@pytest.mark.slow
@pytest.mark.parametrize("case", ["a truncated manifest", "no manifest"])
def test_a_damaged_directory_is_not_exported_over(
    artifacts_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], case: str
) -> None:
    copy = Path(shutil.copytree(artifacts_dir, tmp_path / "nano"))
    DAMAGED[case][0](copy)
    before = contents(copy)
    assert main(["--out", str(copy)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
    assert contents(copy) == before


WRONG_ARGUMENTS: list[tuple[list[str], str]] = [
    ([], "--out is missing"),
    (["verify"], "the directory is missing"),
    (["verify", "no-such-directory"], "not a directory"),
    (["verify", ".", "--target", "orin"], "--target has no effect"),
    (["verify", ".", "--model", "1b"], "--model has no effect"),
    (["verify", ".", "--set", "power.mode=25W"], "--set has no effect"),
    (["verify", ".", "--out", "x"], "--out has no effect"),
    (["verify", ".", "--dry-run"], "--dry-run has no effect"),
    (["--out", "x", "--save-weights", "x/w.safetensors"], "--save-weights x/w.safetensors: lies inside --out"),
    (["--out", "x", "--json", "x/r.json"], "--json x/r.json: lies inside --out"),
    (["--out", "x", "--save-weights", "."], "--save-weights .: expected a file"),
    (["--out", "x", "--save-weights", "/dev/null/w"], "--save-weights /dev/null/w"),
    (["--out", "/"], "expected a directory"),
    (["--out", "x", "--target", "toaster"], "expected one of: cpu"),
    (["--out", "x", "--target", "no-such.toml"], "no-such.toml: cannot be read"),
    (["--out", "x", "--model", "giga"], "expected one of: 1b, nano"),
    (["--out", "x", "--model", "no-such.json"], "no-such.json: cannot be read"),
    (["--out", "x", "--checkpoint", "no-such-file"], "no-such-file: no such file"),
    (["--out", "x", "--random-weights", "-1"], "expected a seed"),
    (
        ["--out", "x", "--calibration", "holiday"],
        "calibration set 'holiday' is not known; expected one of: corridor-go2",
    ),
    (["--out", "x", "--calibration", "folder:no-such"], "no-such"),
    (["--out", "x", "--calibration", "folder:/dev/null"], "/dev/null cannot be read (Not a directory)"),
    (["--out", "x", "--calibration", "folder:"], "calibration set 'folder:' is not known"),
    (["--out", "x", "--calibration", "video:"], "calibration set 'video:' is not known"),
    (["--out", "x", "--calibration", "video:no-such"], "no-such cannot be read (No such file"),
    (["--out", "x", "--calibration", "video:/dev/zero"], "/dev/zero cannot be read (is not a regular file)"),
    (["--out", "x", "--calibration", "video:."], "cannot be read (is a directory, expected a file)"),
    (["--out", "x", "--set", "turbo=1"], "unknown key 'turbo'"),
    (["--out", "x", "--set", "power.mode"], "expected KEY=VALUE"),
    (["--out", "x", "--set", "runtime.tick_period_ms=soon"], "tick_period_ms"),
    (["--out", "x", "--set", "model.action.layers=none"], "action: layers"),
    (["--out", "x", "--set", "model.action.wheels=4"], "action.wheels is not a number of the model"),
    (["--out", "x", "--set", "model.language.max_context=128"], "exceeds the context"),
    (["--out", "x", "--set", "model.action.steps=120"], "is 12 s long, the runner accepts 1 to 10 s"),
    (["--dry-run", "--set", "model.action.steps=120"], "is 12 s long, the runner accepts 1 to 10 s"),
    (["--dry-run", "--set", "model.action.step_s=1.0"], "is 30 s long, the runner accepts 1 to 10 s"),
    (
        ["--dry-run", "--set", "model.action.step_s=0.6", "--set", "model.action.steps=10"],
        "the runner would refuse this export: runtime: step_s 0.6, expected 0.02 to 0.5",
    ),
    (
        ["--dry-run", "--set", "graphs.vision_encoder.overrides.block.0.fc1=fp32"],
        "graphs.vision_encoder.overrides.block.0.fc1: no layer has this name",
    ),
    (["--out", "x", "--cache-gb", "0"], "--cache-gb 0: expected a size above 0"),
    (["--out", "x", "--cache", "/dev/null/cache"], "cache /dev/null/cache: cannot be written"),
    (["--out", "x", "--json", "/dev/null/r.json"], "--json /dev/null/r.json"),
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "message"), WRONG_ARGUMENTS, ids=lambda v: " ".join(v) if isinstance(v, list) else ""
)
def test_wrong_arguments_get_one_line_and_their_exit_code(
    arguments: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert message in captured.err
    assert len(captured.err.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "arguments",
    [["--cache", "a", "--no-cache"], ["--cache-gb", "much"], ["export"], ["--quality", "best"]],
    ids=" ".join,
)
def test_arguments_that_are_none_are_refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 2
    assert "edge-export: error:" in capsys.readouterr().err
