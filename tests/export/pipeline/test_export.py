"""`edge-export`: the graphs are the model, or there are no graphs."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from edge.artifacts.manifest import load_artifacts
from edge.inference.language import Generation, LanguageModel
from edge.reasoning.prompt import Segment
from export.cli import main
from export.core.cache import StageCache
from export.evaluation.gates import GateError, OpenGraph, judge
from export.evaluation.parity import ParityResult, Sample, compare, references
from export.graphs.build import write_graph
from export.model.network import TicVla, build
from export.pipeline.artifacts import build_artifacts
from export.pipeline.build import Pipeline, WeightsRecord
from export.targets.file import graph_names, with_settings
from tests.support.export.export_job import NANO, TARGET, job, manifest, progress

GRAPHS = graph_names(pair=False)
RANDOM = ("--random-weights", "0")
"""What `nano_dir` was exported with."""


@pytest.fixture(scope="module")
def model() -> TicVla:
    return build(NANO, 0)


@pytest.fixture(scope="module")
def samples(model: TicVla) -> dict[str, list[Sample]]:
    return {name: references(model, name, TARGET.gate(name).inputs) for name in GRAPHS}


def verdict(name: str, found: ParityResult) -> str:
    return judge(found, None, TARGET.gate(name), TARGET.task_gate).level


# ---- the directory


def test_the_directory_holds_what_the_design_lists(nano_dir: Path) -> None:
    graphs = {f"{name}.onnx" for name in GRAPHS}
    assert {p.name for p in nano_dir.iterdir()} == graphs | {
        "manifest.json",
        "tokenizer.json",
        "report.json",
        "report.html",
    }


@pytest.mark.parametrize("name", GRAPHS)
def test_every_graph_passed_the_gate_on_eight_inputs_and_on_the_task(nano_dir: Path, name: str) -> None:
    parity, gate = manifest(nano_dir)["graphs"][name]["parity"], TARGET.gate(name)
    assert parity["verdict"] == "PASS"
    assert parity["inputs"] == 8
    assert parity["cosine"] >= gate.min_cosine
    assert parity["max_abs"] <= gate.max_abs
    assert parity["min_difference"] >= gate.min_difference
    assert (parity["provider"], parity["shipping_provider_checked"]) == ("CPUExecutionProvider", True)
    assert [delay_s for delay_s, _ in parity["task"]["by_delay_cm"]] == [0, 1, 2, 3, 5, 7, 10]


@pytest.mark.parametrize("name", GRAPHS)
def test_the_manifest_lists_a_graphs_files_and_session_options(nano_dir: Path, name: str) -> None:
    graph = manifest(nano_dir)["graphs"][name]
    assert graph["bytes"] == (nano_dir / graph["file"]).stat().st_size
    assert graph["precision"] == {"default": "fp32", "overrides": {}}
    assert graph["precision_reason"]
    assert graph["session"] == {"provider": "CPUExecutionProvider", "options": {}, "threads": 1, "engine": False}


def test_no_file_names_the_machine_it_was_made_on(nano_dir: Path) -> None:
    for path in nano_dir.iterdir():
        for place in (str(nano_dir), str(Path(__file__).parents[3]), str(Path.home()), "site-packages"):
            assert place.encode() not in path.read_bytes()


# ---- the gate


@pytest.mark.parametrize("name", ["vision_encoder", "action_expert"])
def test_a_graph_that_ignores_its_input_fails(samples: dict[str, list[Sample]], name: str) -> None:
    first = samples[name][0].expected
    assert verdict(name, compare(name, samples[name], lambda _: first)) == "FAIL"


@pytest.mark.parametrize("dead", ["visual_tokens", "state", "latency", "context.0.key", "context.5.value"])
def test_an_action_expert_that_ignores_one_of_its_inputs_fails(
    samples: dict[str, list[Sample]], nano_dir: Path, dead: str
) -> None:
    graph = OpenGraph(load_artifacts(nano_dir), "action_expert", threads=1)
    found = compare("action_expert", samples["action_expert"], lambda f: graph({**f, dead: np.zeros_like(f[dead])}))
    assert verdict("action_expert", found) == "FAIL"


class Blind(LanguageModel):
    """A runner that never feeds its language model a frame."""

    def generate(self, segments: Sequence[Segment], **options: Any) -> Generation:
        unseen = [Segment(s.ids, None if s.tokens is None else np.zeros_like(s.tokens)) for s in segments]
        return super().generate(unseen, **options)


@pytest.mark.slow
def test_a_language_model_that_never_sees_a_frame_fails_by_the_task_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("export.evaluation.gates.LanguageModel", Blind)
    assert main([*RANDOM, "--out", str(tmp_path / "blind"), "--cache", str(tmp_path / "cache")]) == 1
    message = capsys.readouterr().err.splitlines()[-1]
    assert "language_model: not the same model: deviation as a share of the plans' spread" in message
    assert "cosine of the semantic state" in message
    assert not (tmp_path / "blind").exists()


@pytest.mark.slow
def test_a_failed_gate_leaves_no_directory(cache: StageCache, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    other = build(NANO, 1)
    rounded = Pipeline.graph

    def graph(self: Pipeline, name: str) -> list[Path]:
        if name != "semantic_context":
            return rounded(self, name)
        # The file on disk comes from other weights than those it is checked against.
        (tmp_path / "made").mkdir(exist_ok=True)
        write_graph(other, name, TARGET.precision(name), "fused", tmp_path / "made")
        return [tmp_path / "made" / f"{name}.onnx"]

    monkeypatch.setattr(Pipeline, "graph", graph)
    with pytest.raises(GateError, match=r"semantic_context: not the same model: "):
        build_artifacts(job(), tmp_path / "out", cache, progress())
    assert [path.name for path in tmp_path.iterdir()] == ["made"]


@pytest.mark.slow
def test_a_threshold_that_is_not_met_is_exit_code_1_and_no_directory(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [*RANDOM, "--out", str(tmp_path / "out"), "--set", "gates.task.waypoint_cm=1e-9"]
    assert main([*arguments, "--set", "gates.task.warn_waypoint_cm=1e-10"]) == 1
    message = capsys.readouterr().err.splitlines()[-1]
    assert "vision_encoder: not the same model: waypoint error in cm" in message
    assert message.endswith("; nothing was written")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_value_near_its_limit_is_a_warning_that_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert main([*RANDOM, "--out", str(out), "--set", "gates.task.warn_waypoint_cm=1e-9"]) == 0
    assert "vision_encoder: near a limit: waypoint error in cm" in capsys.readouterr().err
    parity = manifest(out)["graphs"]["vision_encoder"]["parity"]
    assert parity["verdict"] == "WARN"
    assert "waypoint error" in parity["reasons"][0]
    assert "with a warning" in (out / "report.html").read_text()


# ---- the same again


@pytest.mark.slow
def test_two_exports_of_the_same_weights_are_byte_identical_with_nothing_cached(nano_dir: Path, tmp_path: Path) -> None:
    assert main([*RANDOM, "--out", str(tmp_path / "cold"), "--no-cache"]) == 0
    subprocess.run(["diff", "-r", str(nano_dir), str(tmp_path / "cold")], check=True, timeout=300)
    assert [path.name for path in tmp_path.iterdir()] == ["cold"]


@pytest.mark.slow
def test_a_cached_export_is_byte_identical_even_if_the_first_was_changed(nano_dir: Path, tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    assert main([*RANDOM, "--out", str(first)]) == 0
    data = bytearray((first / "action_expert.onnx").read_bytes())
    data[1000] ^= 1
    (first / "action_expert.onnx").write_bytes(data)
    assert main([*RANDOM, "--out", str(second)]) == 0
    subprocess.run(["diff", "-r", str(nano_dir), str(second)], check=True, timeout=300)


def export_interrupted_by(number: signal.Signals, command: Sequence[str], stage: str) -> None:
    """Start an export and send it a signal when it has begun a stage; it must end as an interrupted command does."""
    # A background job of a shell ignores SIGINT, one of nohup SIGHUP, and so would its children; what is handled here
    # is default there.
    before = {each: signal.signal(each, signal.default_int_handler) for each in (signal.SIGINT, signal.SIGHUP)}
    try:
        process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=Path(__file__).parents[3])
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)
    try:
        assert process.stderr is not None
        for line in process.stderr:
            if f"{stage} · " in line:
                break
        process.send_signal(number)
        assert process.wait(timeout=300) == 130
    finally:
        process.kill()
        process.wait(timeout=300)
        process.stderr.close()


@pytest.mark.slow
def test_an_interrupted_export_leaves_nothing_half_written_and_goes_on_where_it_was(
    nano_dir: Path, tmp_path: Path
) -> None:
    cache, out = tmp_path / "cache", tmp_path / "out" / "nano"
    command = [sys.executable, "-m", "export.cli", *RANDOM, "--out", str(out), "--cache", str(cache)]
    for number, stage in (
        (signal.SIGINT, "gate vision_encoder"),
        (signal.SIGHUP, "gate semantic_context"),
        (signal.SIGTERM, "gate action_expert"),
    ):
        export_interrupted_by(number, command, stage)
        assert not any(out.parent.iterdir())
        assert [path for path in cache.iterdir() if path.name.endswith(".partial")] == []
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=120, cwd=Path(__file__).parents[3], check=True
    )
    assert "weights: from the cache" in done.stderr
    assert "graph action_expert: from the cache" in done.stderr
    assert "gate vision_encoder: from the cache" in done.stderr
    assert done.stdout == ""
    subprocess.run(["diff", "-r", str(nano_dir), str(out)], check=True, timeout=300)


def test_a_result_of_the_language_models_check_counts_for_its_chunks_alone(
    artifacts_dir: Path, cache: StageCache, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The check generates as the runner does; the other graphs' checks do not depend on the runner's settings."""
    artifacts = load_artifacts(artifacts_dir)
    longer = replace(artifacts, runtime=replace(artifacts.runtime, prefill_chunk_tokens=999))
    keys: list[str] = []
    monkeypatch.setattr(StageCache, "result", lambda _, key, __: (keys.append(key), True))
    pipeline = Pipeline(job(), cache, progress())
    for graph, different in (("language_model", 2), ("action_expert", 1)):
        keys.clear()
        for each in (artifacts, longer):
            pipeline._measured("task", each, (graph,), "reference", pytest.fail)
        assert len(set(keys)) == different


@pytest.mark.slow
def test_weights_that_are_trained_or_other_threads_choose_a_precision_anew(
    cache: StageCache, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = with_settings(TARGET, ["graphs.vision_encoder.candidates=fp32,int8"])
    keys: list[str] = []

    def key_of(pipeline: Pipeline) -> str:
        keys.clear()
        monkeypatch.setattr(Pipeline, "_stage", lambda _, title, key, build: keys.append(key) or Path("none"))
        with pytest.raises(FileNotFoundError):
            pipeline.decision("vision_encoder")
        return keys[-1]

    def pipeline(trained: bool, threads: int) -> Pipeline:
        record = WeightsRecord("0" * 64, trained, "a test", {})
        monkeypatch.setattr(Pipeline, "weights", lambda _: record)
        monkeypatch.setattr(Pipeline, "tokenizer", lambda _: b"")
        monkeypatch.setattr("export.pipeline.build.threads_for", lambda _: threads)
        return Pipeline(replace(job(), target=target), cache, progress())

    found = {key_of(pipeline(trained, threads)) for trained in (False, True) for threads in (1, 2)}
    torch.set_num_threads(1)
    assert len(found) == 4
