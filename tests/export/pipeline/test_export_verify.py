"""`edge-export verify`: a directory is what the export would write, and still the same model."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from edge.artifacts.files import seal
from edge.artifacts.known_answers import LATER
from edge.artifacts.manifest import Artifacts, load_artifacts
from edge.core.cli import EXIT_CHECK_FAILED
from edge.inference.self_test import SelfTestError
from edge.inference.start_guard import Memory, StartGuard
from export.cli import main
from export.core.cache import file_sha256
from export.model.network import build
from export.model.weights import WeightsInfo, save_weights
from export.pipeline import job
from export.pipeline.self_test import recorded_and_expected_limits, self_test_limits
from export.targets.file import TARGETS_DIR
from tests.edge.inference.test_self_test import loop_for_ever
from tests.support.export.export_job import NANO, manifest


@pytest.mark.slow
def test_verify_repeats_the_gate(artifacts_dir: Path) -> None:
    assert main(["verify", str(artifacts_dir)]) == 0


@pytest.mark.slow
def test_verify_runs_the_limited_self_test_before_any_gate(
    artifacts_dir: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_artifacts: Artifacts) -> None:
        raise SelfTestError("the self-test came first")

    monkeypatch.setattr("export.pipeline.artifacts.repeat_self_test", refuse)
    monkeypatch.setattr("export.pipeline.artifacts.check_directory", lambda *_: pytest.fail("a gate came first"))
    assert main(["verify", str(artifacts_dir)]) == 1
    assert "the self-test came first" in capsys.readouterr().err


class Impatient(StartGuard):
    """Ends a self-test after 1.5 s, and never the process."""

    def __init__(self, artifacts: Artifacts, **_: object) -> None:
        super().__init__(artifacts, end=lambda _line: None)

    @contextmanager
    def stage(self, what: str, limit_s: float) -> Iterator[None]:
        with super().stage(what, 1.5 if what == "self-test" else limit_s):
            yield


@pytest.mark.slow
def test_a_graph_that_loops_does_not_hang_verify(
    artifacts_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = Path(shutil.copytree(artifacts_dir, tmp_path / "nano"))
    loop_for_ever(copy)
    monkeypatch.setattr("export.pipeline.self_test.StartGuard", Impatient)
    assert main(["verify", str(copy)]) == 1
    assert "self-test: not done after its limit of 1.5 s" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.slow
def test_a_graph_that_loops_in_its_gate_does_not_hang_verify(
    artifacts_dir: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    ended = threading.Event()

    class Short(StartGuard):
        def __init__(self, artifacts: Artifacts, *, memory: Memory, **_: object) -> None:
            super().__init__(artifacts, end=lambda _line: ended.set(), memory=memory)

        @contextmanager
        def stage(self, what: str, limit_s: float) -> Iterator[None]:
            with super().stage(what, min(limit_s, 0.2)):
                yield

    monkeypatch.setattr("export.pipeline.artifacts.StartGuard", Short)
    monkeypatch.setattr("export.pipeline.artifacts.Pipeline.gate", lambda *_: ended.wait(60))
    assert main(["verify", str(artifacts_dir)]) == 1
    assert "gate vision_encoder: not done after its limit of 0.2 s" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.slow
def test_a_call_that_hangs_ends_verify_with_one_line_and_the_exit_code_of_a_failed_check() -> None:
    code = "from export.pipeline.self_test import end_process; end_process('x')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=120)
    assert (done.returncode, done.stdout, done.stderr) == (EXIT_CHECK_FAILED, "", "edge-export: x\n")


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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("keys", "value", "message"),
    [
        ("runtime/tick_period_ms", 120, "runtime: tick_period_ms is 120, the plan's is 100"),
        ("runtime/img_context_id", 7, "tokenizer.json: <IMG_CONTEXT> is id 5, the network was built for 7"),
        ("runtime/frame_offsets_s", [0.0, 1.0, 3.0, 6.0], "runtime.frame_offsets_s is"),
        ("runtime/max_new_tokens", 47, "runtime.max_new_tokens is 47"),
        ("graphs/action_expert/session/threads", 2, "graphs.action_expert.session.threads is 2"),
        ("graphs/vision_encoder/precision/default", "int8", 'graphs.vision_encoder.precision.default is "int8"'),
        ("model/name", "1b", 'model.name is "1b"'),
        ("model/trained", True, "model.trained is true, this export writes false"),
        ("model/config/action/step_s", 0.2, "step_s is 0.1, the network was built for 0.2"),
        ("provenance/target/gates/action_expert/max_abs", 9.0, "gates.action_expert.max_abs is 9.0"),
        ("provenance/target/power/meter", "nvml", 'provenance.target.power.meter is "nvml"'),
        ("provenance/target/runtime/enforce_plan", True, "provenance.target.runtime.enforce_plan is true"),
        ("provenance/target/device/memory_gib", 512.0, "provenance.target.device.memory_gib is 512.0"),
        ("plan/tick_ms", 1.0, "plan.tick_ms is 1.0"),
        ("plan/per_graph/decode/energy_j", 5.0, "plan.per_graph.decode.energy_j is 5.0"),
        ("graphs/action_expert/params", None, "graphs.action_expert.params is null, this export writes a whole number"),
        ("graphs/vision_encoder/precision_reason", [], "graphs.vision_encoder.precision_reason is []"),
        ("self_test/limit_s", 600.0, "self_test.limit_s is 600.0"),
        ("self_test/same_tokens", 0.1, "self_test.same_tokens is 0.1"),
        ("self_test/answers/chain/tolerance", 0.2, "self_test.tolerances.chain is 0.2"),
    ],
)
def test_a_manifest_that_was_changed_and_sealed_again_does_not_verify(
    artifacts_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], keys: str, value: object, message: str
) -> None:
    copy = resealed(Path(shutil.copytree(artifacts_dir, tmp_path / "nano")), keys, value)
    assert main(["verify", str(copy)]) == 1
    error = capsys.readouterr().err.splitlines()[-1]
    assert message in error


@pytest.mark.slow
def test_a_manifest_with_another_network_than_its_models_does_not_verify(
    nano_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = resealed(Path(shutil.copytree(nano_dir, tmp_path / "nano")), "model/config/action/layers", 5)
    assert main(["verify", str(copy)]) == 1
    assert "model.config.action.layers is 5" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(("provider", "accepted"), [("CUDAExecutionProvider", True), ("CPUExecutionProvider", False)])
def test_tolerances_of_an_exporter_without_the_provider_are_accepted_for_an_accelerator_only(
    provider: str, accepted: bool
) -> None:
    graph = {"precision": {"default": "fp32", "overrides": {}}, "session": {"provider": provider}}
    content = {"graphs": {"vision_encoder": graph}, "plan": {}}
    wide = self_test_limits(content, half=False, replaced=True)
    answers = {name: {"tolerance": tolerance} for name, tolerance in wide.tolerances.items()}
    recorded = {"limit_s": wide.limit_s, "same_tokens": wide.same_tokens, "answers": answers}
    found, expected = recorded_and_expected_limits(recorded, content, half=False)
    assert (found == expected) is accepted


@pytest.mark.parametrize(
    "without", [*({name} for name in sorted(LATER)), LATER], ids=lambda names: "+".join(sorted(names))
)
def test_limits_of_an_earlier_export_without_a_later_answer_are_accepted(without: set[str]) -> None:
    graph = {"precision": {"default": "fp32", "overrides": {}}, "session": {"provider": "CPUExecutionProvider"}}
    content = {"graphs": {"language_model": graph}, "plan": {}}
    limits = self_test_limits(content, half=False, replaced=False)
    answers = {name: {"tolerance": tolerance} for name, tolerance in limits.tolerances.items()}
    answers = {name: answer for name, answer in answers.items() if name not in without}
    recorded = {"limit_s": limits.limit_s, "same_tokens": limits.same_tokens, "answers": answers}
    found, expected = recorded_and_expected_limits(recorded, content, half=False)
    assert found == expected


@pytest.mark.slow
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


@pytest.fixture
def narrow(narrow_model: Path) -> list[str]:
    """Arguments for the narrow network of `artifacts_dir`."""
    return ["--model", str(narrow_model), "--random-weights", "0"]


@pytest.mark.slow
def test_changed_thresholds_are_kept_and_printed(
    narrow: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    setting = "gates.action_expert.max_abs=0.5"
    assert main([*narrow, "--out", str(tmp_path / "nano"), "--set", setting]) == 0
    assert main(["verify", str(tmp_path / "nano")]) == 0
    assert f"note: thresholds were changed with --set for this build: {setting}" in capsys.readouterr().err


@pytest.mark.slow
def test_a_directory_for_a_users_target_names_the_origin_of_its_thresholds(
    narrow: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = tmp_path / "own.toml"
    own.write_text((TARGETS_DIR / "cpu.toml").read_text())
    assert main([*narrow, "--target", str(own), "--out", str(tmp_path / "nano")]) == 0
    assert main(["verify", str(tmp_path / "nano")]) == 0
    assert "checked against the thresholds in the manifest" in capsys.readouterr().err


@pytest.mark.slow
def test_verify_refuses_artifacts_of_other_weights(artifacts_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", str(artifacts_dir), "--random-weights", "5"]) == 1
    assert "other weights" in capsys.readouterr().err


def test_verify_of_a_folder_of_pictures_asks_for_the_folder(
    artifacts_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = Path(shutil.copytree(artifacts_dir, tmp_path / "nano"))
    resealed(copy, "provenance/calibration/name", "folder:corridor")
    assert main(["verify", str(copy)]) == 2
    expected = f"edge-export: {copy}: built with calibration folder:corridor; pass the same with --calibration\n"
    assert capsys.readouterr().err == expected


def test_verify_writes_no_result_into_the_directory_that_it_verifies(
    artifacts_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    copy = Path(shutil.copytree(artifacts_dir, tmp_path / "nano"))
    assert main(["verify", str(copy), "--json", str(copy / "result.json")]) == 2
    assert "lies inside the directory to verify" in capsys.readouterr().err
    load_artifacts(copy)


@pytest.fixture(scope="module")
def of_checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with weights, `nano.safetensors`, and artifacts of them, `nano`."""
    folder = tmp_path_factory.mktemp("checkpoint")
    saved = str(folder / "nano.safetensors")
    assert main(["--out", str(folder / "first"), "--random-weights", "0", "--save-weights", saved]) == 0
    assert main(["--out", str(folder / "nano"), "--checkpoint", saved]) == 0
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shipped", "code", "message"), [(False, 2, "pass these weights with"), (True, 1, "other weights than")]
)
def test_verify_of_a_checkpoint_asks_for_the_checkpoint(
    of_checkpoint: Path, tmp_path: Path, capsys: Any, monkeypatch: Any, shipped: bool, code: int, message: str
) -> None:
    others = tmp_path / "others.safetensors"
    save_weights(build(NANO, 1), others, WeightsInfo(trained=False, origin="random seed 1"))
    monkeypatch.setattr(job, "shipped_weights", lambda config: others if shipped else None)
    assert main(["verify", str(of_checkpoint / "nano")]) == code
    error = capsys.readouterr().err
    assert message in error and "checkpoint" in error


@pytest.mark.slow
def test_verify_of_a_checkpoint_takes_the_checkpoint(of_checkpoint: Path) -> None:
    saved = str(of_checkpoint / "nano.safetensors")
    assert main(["verify", str(of_checkpoint / "nano"), "--checkpoint", saved]) == 0
