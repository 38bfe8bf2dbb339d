"""`edge-export`: the graphs are the model, or there are no graphs."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import onnx
import pytest

from edge.manifest import Artifacts, load_artifacts
from export.artifacts import Export, GateError, build_artifacts
from export.cli import main
from export.graphs import GRAPH_NAMES, graph_specs
from export.model.config import PRESETS
from export.model.network import TicVla, build
from export.model.weights import WeightsInfo
from export.parity import check_graph, sample_inputs
from export.target import TargetError, list_targets, load_target, parse_target

NANO = PRESETS["nano"]
GATE = load_target("cpu").parity


@pytest.fixture(scope="module")
def model() -> TicVla:
    return build(NANO, 0)


def manifest(directory: Path) -> dict:
    return json.loads((directory / "manifest.json").read_text())


def test_the_directory_holds_what_the_design_lists(artifacts_dir: Path) -> None:
    graphs = {f"{name}.onnx" for name in GRAPH_NAMES}
    assert {p.name for p in artifacts_dir.iterdir()} == graphs | {
        "manifest.json",
        "tokenizer.json",
        "report.json",
        "report.html",
    }


@pytest.mark.parametrize("name", GRAPH_NAMES)
def test_every_graph_passed_the_gate_on_eight_inputs(artifacts_dir: Path, name: str) -> None:
    parity = manifest(artifacts_dir)["graphs"][name]["parity"]
    assert parity["verdict"] == "PASS"
    assert parity["inputs"] == 8
    assert parity["cosine"] >= GATE.min_cosine
    assert parity["max_abs"] <= GATE.max_abs
    assert parity["min_difference"] >= GATE.min_difference


@pytest.mark.parametrize("name", GRAPH_NAMES)
def test_no_graph_names_the_machine_it_was_made_on(artifacts_dir: Path, name: str) -> None:
    data = (artifacts_dir / f"{name}.onnx").read_bytes()
    assert str(Path(__file__).parents[1]).encode() not in data
    assert b"site-packages" not in data
    proto = onnx.load_from_string(data)
    assert all(not t.external_data for t in proto.graph.initializer)


@pytest.mark.parametrize("name", GRAPH_NAMES)
def test_the_eight_inputs_are_all_different(name: str) -> None:
    samples = [sample_inputs(NANO, name, i) for i in range(8)]
    keys = [b"".join(a.tobytes() for a in sample.values()) for sample in samples]
    assert len(set(keys)) == 8


@pytest.mark.parametrize("index", range(4))
def test_a_graph_that_ignores_its_input_fails(model: TicVla, index: int) -> None:
    spec = graph_specs(model)[index]
    answers = {}

    def constant(feeds: dict) -> list:
        import torch

        if not answers:
            caches = [torch.from_numpy(a) for n, a in feeds.items() if n.startswith("past")]
            plain = [torch.from_numpy(a) for n, a in feeds.items() if not n.startswith("past")]
            with torch.no_grad():
                out = spec.module(*plain, caches) if caches else spec.module(*plain)
            answers["first"] = [t.numpy() for t in (out if isinstance(out, tuple) else (out,))]
        return answers["first"]

    assert check_graph(model, spec, constant, GATE).verdict == "FAIL"


def test_a_small_error_in_one_output_fails(model: TicVla, artifacts: Artifacts) -> None:
    from edge.graph import Graph

    spec = graph_specs(model)[3]
    graph = Graph(artifacts, "action_expert", threads=1)
    assert check_graph(model, spec, graph.run, GATE).verdict == "PASS"
    shifted = check_graph(model, spec, lambda feeds: [y + np.float32(2e-3) for y in graph.run(feeds)], GATE)
    assert shifted.verdict == "FAIL"


@pytest.mark.parametrize("dead", ["visual_tokens", "state", "latency", "context_keys", "context_values"])
def test_an_action_expert_that_ignores_one_of_its_inputs_fails(model: TicVla, artifacts: Artifacts, dead: str) -> None:
    from edge.graph import Graph

    graph = Graph(artifacts, "action_expert", threads=1)
    result = check_graph(model, graph_specs(model)[3], lambda f: graph.run({**f, dead: np.zeros_like(f[dead])}), GATE)
    assert result.verdict == "FAIL"


def test_not_finite_outputs_fail(model: TicVla, artifacts: Artifacts) -> None:
    from edge.graph import Graph

    spec = graph_specs(model)[0]
    graph = Graph(artifacts, "vision_encoder", threads=1)
    assert check_graph(model, spec, lambda feeds: [y * np.nan for y in graph.run(feeds)], GATE).verdict == "FAIL"


def test_a_failed_gate_leaves_no_directory(model: TicVla, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import export.artifacts

    other = build(NANO, 1)
    # The files on disk come from other weights than those they are checked against.
    monkeypatch.setattr(export.artifacts, "graph_specs", lambda _model: graph_specs(other))
    checked = export.artifacts.check_directory

    def check(export_: Export, directory: Path, specs: list, progress: object) -> dict:
        return checked(export_, directory, graph_specs(model), print)

    monkeypatch.setattr(export.artifacts, "check_directory", check)
    with pytest.raises(GateError, match="not the same model"):
        build_artifacts(Export(load_target("cpu"), model, WeightsInfo(False, "")), tmp_path / "out", lambda _line: None)
    assert list(tmp_path.iterdir()) == []


def test_verify_repeats_the_gate(artifacts_dir: Path) -> None:
    assert main(["verify", str(artifacts_dir)]) == 0


def test_verify_names_a_damaged_file(artifacts_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copy = Path(shutil.copytree(artifacts_dir, tmp_path / "nano"))
    data = bytearray((copy / "vision_encoder.onnx").read_bytes())
    data[-1] ^= 0x80
    (copy / "vision_encoder.onnx").write_bytes(data)
    assert main(["verify", str(copy)]) == 1
    assert "vision_encoder.onnx" in capsys.readouterr().err


def test_verify_refuses_artifacts_of_other_weights(artifacts_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", str(artifacts_dir), "--random-weights", "5"]) == 1
    assert "other weights" in capsys.readouterr().err


def test_two_exports_of_the_same_weights_are_byte_identical(artifacts_dir: Path, tmp_path: Path) -> None:
    again = tmp_path / "again"
    saved = tmp_path / "nano.safetensors"
    assert main(["--out", str(again), "--random-weights", "0", "--save-weights", str(saved)]) == 0
    assert saved.exists()
    for path in artifacts_dir.iterdir():
        assert path.read_bytes() == (again / path.name).read_bytes(), path.name


def test_an_artifact_directory_with_something_of_the_users_in_it_is_not_replaced(
    artifacts_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = Path(shutil.copytree(artifacts_dir, tmp_path / "nano"))
    (out / "flight.mcap").write_bytes(b"evidence")
    assert main(["--out", str(out)]) == 2
    assert "flight.mcap" in capsys.readouterr().err
    assert (out / "flight.mcap").read_bytes() == b"evidence"


def test_a_failed_swap_puts_the_old_directory_back(
    model: TicVla, artifacts_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = Path(shutil.copytree(artifacts_dir, tmp_path / "nano"))
    rename = Path.rename

    def failing(self: Path, target: Path) -> Path:
        if self.name == "nano.partial":
            raise OSError("disk full")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", failing)
    with pytest.raises(OSError, match="disk full"):
        build_artifacts(Export(load_target("cpu"), model, WeightsInfo(False, "")), out, lambda _line: None)
    assert [p.name for p in tmp_path.iterdir()] == ["nano"]
    load_artifacts(out)


def test_an_existing_directory_that_is_not_ours_is_not_touched(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter1.tex").write_text("years of work")
    assert main(["--out", str(tmp_path / "thesis")]) == 2
    assert "manifest.json" in capsys.readouterr().err
    assert (tmp_path / "thesis" / "chapter1.tex").read_text() == "years of work"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--out", "x", "--target", "toaster"], "expected one of: cpu"),
        (["--out", "x", "--model", "giga"], "expected one of: 1b, nano"),
        (["--out", "x", "--checkpoint", "no-such-file"], "not a readable safetensors"),
        (["--out", "x", "--random-weights", "-1"], "expected a seed"),
        ([], "--out is missing"),
        (["verify"], "which directory"),
        (["--out", "/"], "expected a directory"),
    ],
)
def test_bad_input_gets_one_line_and_exit_code_2(
    arguments: list[str], said: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert said in captured.err
    assert len(captured.err.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_targets_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--list-targets"]) == 0
    assert [line.split("\t")[0] for line in capsys.readouterr().out.splitlines()] == list_targets()


def test_an_unknown_key_in_a_target_is_an_error() -> None:
    content = {
        "schema": 1,
        "name": "x",
        "description": "",
        "providers": [],
        "precision": dict.fromkeys(GRAPH_NAMES, "fp32"),
        "parity": {"inputs": 1, "min_cosine": 1, "max_abs": 0, "min_difference": 0},
        "runtime": {"tick_period_ms": 100, "max_new_tokens": 1, "frame_offsets_s": [0], "turbo": True},
    }
    with pytest.raises(TargetError, match="turbo"):
        parse_target(content, "x.toml")


def test_the_exported_model_generates_the_same_text_as_pytorch(model: TicVla, artifacts: Artifacts) -> None:
    """Greedy decoding over the runner's own prompt, segments and cache, against one uncached PyTorch pass a token."""
    import torch

    from edge.geometry import SE2
    from edge.language import LanguageModel
    from edge.policy import Policy
    from edge.ring import EncodedFrame

    policy, language = Policy(artifacts), LanguageModel(artifacts)
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (2, 1, 128, 128, 3)).astype(np.uint8)
    frames = [EncodedFrame(i, SE2(float(i), 0, 0), policy.encode(image)) for i, image in enumerate(images)]
    segments = language.prompt.build(frames, "go to the bench")
    found = language.generate(segments, max_new_tokens=12, cancelled=lambda: False)

    ids = [i for segment in segments for i in segment.ids]
    tokens = torch.cat([torch.from_numpy(f.tokens) for f in frames])
    c = NANO.language
    new: list[int] = []
    with torch.no_grad():
        while len(new) < 12:
            past = [torch.zeros(1, c.kv_heads, 0, c.head_dim) for _ in range(2 * c.layers)]
            token, _, kv, *_ = model.language(torch.tensor([ids + new]), tokens, past)
            if int(token) == c.im_end_id:
                break
            new.append(int(token))
    assert found.new_tokens == len(new)
    assert found.text == language._tokenizer.decode(new, skip_special_tokens=True)
    full = found.last_layer_kv
    assert full.shape == (1, len(ids) + len(new), NANO.kv_dim)
    assert np.allclose(full[:, : kv.shape[1]], kv.numpy()[:, : full.shape[1]], atol=1e-3)


def test_a_generation_stops_between_two_calls(artifacts: Artifacts) -> None:
    from edge.geometry import SE2
    from edge.language import CancelledError, LanguageModel
    from edge.ring import EncodedFrame

    language = LanguageModel(artifacts)
    calls: list[int] = []

    def cancelled() -> bool:
        calls.append(1)
        return len(calls) > 3

    frames = [EncodedFrame(0, SE2(0, 0, 0), np.zeros((1, 64, 256), dtype=np.float32))]
    with pytest.raises(CancelledError):
        language.generate(language.prompt.build(frames, "go"), max_new_tokens=48, cancelled=cancelled)
    assert len(calls) == 4


def test_the_manifest_says_that_the_weights_are_untrained(artifacts_dir: Path) -> None:
    assert manifest(artifacts_dir)["model"]["trained"] is False
    assert "untrained" in (artifacts_dir / "report.html").read_text()
    assert not load_artifacts(artifacts_dir).trained
