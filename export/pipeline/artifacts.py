"""Builds an artifact directory from cached files, gates and manifest in a hidden directory, then renames it."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any

from edge.artifacts.files import MANIFEST_NAME, SCHEMA_VERSION, ArtifactError, read_manifest, seal
from edge.artifacts.manifest import load_artifacts
from edge.artifacts.runtime import SPECIAL_TOKENS
from edge.inference.start_guard import Memory, StartGuard
from export.core.cache import StageCache, file_sha256, fsync_path, package_versions
from export.core.replaceable import check_replaceable
from export.evaluation.gates import WARN, GateResult, require
from export.evaluation.task_samples import is_large
from export.graphs.build import graph_contract, graph_parameters
from export.model.config import TicVlaConfig
from export.pipeline.build import EXPECTED_S, Pipeline
from export.pipeline.job import Job
from export.pipeline.report import report_html
from export.pipeline.self_test import (
    SELF_TEST_STAGE,
    end_process,
    known_answers,
    recorded_and_expected_limits,
    repeat_self_test,
)
from export.plan.plan import Plan, plan
from export.targets.file import Target
from reporting.progress import BuildProgress

REPORT_JSON, REPORT_HTML, TOKENIZER_NAME = "report.json", "report.html", "tokenizer.json"
NEW, OLD = "new", "old"
RUNNER_KEYS = ("control_cores", "reasoning_cores", "control_priority", "decoding", "recovery", "speculation")
TARGET_SECTIONS = ("name", "arch", "device", "power", "runtime", "gates")
"""Keys of `provenance.target` that the runner, `edge-doctor` or `verify` reads."""
SHOWN_CHARACTERS = 60
GATE_SLOWER, LEAST_GATE_S = 20.0, 60.0
"""Time limit of a gate on files of unknown origin: a multiple of its expected duration, and time added to it, s."""
UNLIMITED = Memory(own=lambda: 0, available=lambda: 0)
"""PyTorch's model and its outputs share the gates' process: only their time is limited."""


def manifest_runtime(target: Target, config: TicVlaConfig, made: Plan) -> dict[str, object]:
    """Return the manifest's `runtime` section; a plan that fits limits the tokens of a generation."""
    language, policy = config.language, target.runtime
    planned = made.tokens if made.fits and made.tokens > 0 else policy.max_new_tokens
    return {
        "image_px": config.vision.image_px,
        "frame_tokens": config.frame_tokens,
        "kv_dim": config.kv_dim,
        "max_context": language.max_context,
        "max_new_tokens": planned,
        "prefill_chunk_tokens": policy.prefill_chunk_tokens,
        "frame_offsets_s": list(policy.frame_offsets_s),
        "tick_period_ms": policy.tick_period_ms,
        "step_s": config.action.step_s,
        **{key: getattr(language, key) for key in SPECIAL_TOKENS},
        **{key: getattr(policy, key) for key in RUNNER_KEYS},
    }


def build_artifacts(job: Job, out: Path, cache: StageCache, progress: BuildProgress) -> dict[str, Any]:
    """Write `out` and return its report.

    Raises GateError, ArtifactError, CheckpointError or OSError; then only finished stages stay, in the cache.
    """
    check_replaceable(out)
    with workplace(out) as work:
        made = work / NEW
        made.mkdir()
        report = _write_directory(Pipeline(job, cache, progress), made, progress)
        for path in [*made.iterdir(), made]:
            fsync_path(path)
        check_replaceable(out)  # again, because the directory may have changed during the build
        _swap(made, out, work / OLD)
        return report


@contextmanager
def workplace(out: Path) -> Iterator[Path]:
    """Create a hidden directory beside `out`, on the same disk. Raises ArtifactError if another export uses it.

    Leftovers of a killed export are deleted; a directory that it was replacing is restored.
    """
    work = out.with_name(f".{out.name}.edge-export")
    work.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(work, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            mine = work.exists() and work.stat().st_ino == os.fstat(descriptor).st_ino
        except BlockingIOError:
            mine = False
        if not mine:
            raise ArtifactError(f"another export is writing {out}; wait for it or name another directory")
        others = sorted(path.name for path in work.iterdir() if path.name not in (NEW, OLD))
        if others:
            raise ArtifactError(
                f"{work / others[0]}: not written by edge-export, so nothing is built there; move it away"
            )
        if (work / OLD).exists() and not out.exists():
            (work / OLD).rename(out)
        try:
            for left in (NEW, OLD):
                shutil.rmtree(work / left, ignore_errors=True)
            yield work
        finally:
            if (work / OLD).exists() and not out.exists():  # interrupted between the two renames
                (work / OLD).rename(out)
            shutil.rmtree(work, ignore_errors=True)
    finally:
        os.close(descriptor)


def _swap(made: Path, out: Path, retired: Path) -> None:
    try:
        if out.exists():
            out.rename(retired)
        made.rename(out)
    except BaseException:  # Ctrl-C may come after either rename
        if retired.exists() and not out.exists():
            retired.rename(out)
        raise
    fsync_path(out.parent)


def _write_directory(pipeline: Pipeline, directory: Path, progress: BuildProgress) -> dict[str, Any]:
    job = pipeline.job
    weights = pipeline.weights()
    (directory / TOKENIZER_NAME).write_bytes(pipeline.tokenizer())
    pipeline.task_reference()
    for name in job.target.graph_names:
        pipeline.reference(name)
    made = _plan(pipeline)
    if job.target.runtime.enforce_plan:
        made.require()
    graphs: dict[str, Any] = {}
    for name in job.target.graph_names:
        files = pipeline.graph(name)
        for path in files:
            # Copied, never linked: a change of the output must not change the cache.
            shutil.copyfile(path, directory / path.name)
        graphs[name] = _graph_entry(pipeline, name, [directory / path.name for path in files])
    manifest: dict[str, Any] = {
        "schema_version": SCHEMA_VERSION,
        "target": job.target.name,
        "model": _model_section(pipeline),
        "runtime": manifest_runtime(job.target, job.config, made),
        "graphs": graphs,
        "plan": made.to_dict(),
        "self_test": {},
        "provenance": {
            "weights_sha256": weights.sha256,
            "weights_origin": weights.origin,
            "calibration": job.calibration.to_dict(),
            "packages": package_versions(),
            "asked": asdict(job.request),
            "target": job.target.to_dict(),
        },
    }
    _write_manifest(directory, manifest)
    for name, result in check_directory(pipeline, directory, progress).items():
        graphs[name]["parity"] = result.to_dict()
    with progress.stage(SELF_TEST_STAGE):
        manifest["self_test"] = known_answers(load_artifacts(directory), manifest, half=job.target.half).to_dict()
    with progress.stage("plan and report"):
        decisions = {name: pipeline.decision(name) for name in job.target.graph_names}
        found = {"coverage": weights.coverage, "sensitivity": {k: v for k, v in decisions.items() if v is not None}}
        report = {**{k: v for k, v in manifest.items() if k != "files"}, **found}
        _write_json(directory / REPORT_JSON, report)
        (directory / REPORT_HTML).write_text(report_html(report), encoding="utf-8")
        _write_manifest(directory, manifest)
    return report


def _graph_entry(pipeline: Pipeline, name: str, files: list[Path]) -> dict[str, Any]:
    target, (precision, reason) = pipeline.job.target, pipeline.precision(name)
    graph_file = next(path for path in files if path.suffix == ".onnx")
    contract = graph_contract(graph_file)
    return {
        "file": graph_file.name,
        "data_files": [path.name for path in files if path != graph_file],
        **contract,
        "params": graph_parameters(graph_file),
        "bytes": sum(path.stat().st_size for path in files),
        "precision": precision.to_dict(),
        "precision_reason": reason,
        "form": target.graphs[name].form,
        "session": target.session(name, contract["inputs"]),
    }


def _write_json(path: Path, content: Mapping[str, object]) -> None:
    # Not sorted: the first matching exception of a precision applies, so their order matters.
    path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _write_manifest(directory: Path, manifest: dict[str, Any]) -> None:
    names = sorted(path.name for path in directory.iterdir() if path.name != MANIFEST_NAME)
    manifest["files"] = {
        name: {"sha256": file_sha256(directory / name), "bytes": (directory / name).stat().st_size} for name in names
    }
    _write_json(directory / MANIFEST_NAME, seal(manifest))


def check_directory(
    pipeline: Pipeline, directory: Path, progress: BuildProgress,
    watch: Callable[[str], AbstractContextManager[None]] = lambda graph: nullcontext(),
) -> dict[str, GateResult]:  # fmt: skip
    """Run the gates on the files on disk, through the runner's loader. Raises GateError at the first failure.

    `watch`: context in which a graph's gate runs.
    """
    artifacts = load_artifacts(directory)
    results: dict[str, GateResult] = {}
    for name in pipeline.job.target.graph_names:
        with watch(name):
            result = results[name] = pipeline.gate(artifacts, name)
        require(name, result.verdict)
        if result.verdict.level == WARN:
            progress.log(f"{name}: near a limit: {'; '.join(result.verdict.reasons)}")
    return results


def verify_directory(job: Job, directory: Path, cache: StageCache, progress: BuildProgress) -> dict[str, Any]:
    """Check hashes, contract, self-test and gates of an existing directory again. Raises ArtifactError or GateError."""
    manifest = read_manifest(directory)
    pipeline = Pipeline(job, cache, progress, run_gates=True)
    weights = pipeline.weights()
    if weights.sha256 != manifest["provenance"].get("weights_sha256"):
        raise ArtifactError(f"{directory}: built from other weights than {weights.origin}; pass --checkpoint")
    _check_manifest(pipeline, directory, manifest)
    artifacts = load_artifacts(directory)
    # Before the gates: only the self-test ends a graph that allocates without end.
    with progress.stage(SELF_TEST_STAGE):
        progress.log(f"self-test: {repeat_self_test(artifacts)}")
    pipeline.task_reference()
    for name in job.target.graph_names:
        pipeline.reference(name)
    guard = StartGuard(artifacts, end=end_process, memory=UNLIMITED)
    # A graph that passes the self-test may loop on other inputs.
    limit_s = LEAST_GATE_S + GATE_SLOWER * EXPECTED_S["gate"][int(is_large(job.config))]
    results = check_directory(pipeline, directory, progress, lambda graph: guard.stage(f"gate {graph}", limit_s))
    return {**manifest, "graphs": {n: {**g, "parity": results[n].to_dict()} for n, g in manifest["graphs"].items()}}


def _plan(pipeline: Pipeline) -> Plan:
    target = pipeline.job.target
    return plan(target, pipeline.job.config, {name: pipeline.precision(name)[0] for name in target.graph_names})


def _model_section(pipeline: Pipeline) -> dict[str, Any]:
    config = pipeline.job.config
    return {"name": config.name, "trained": pipeline.weights().trained, "config": config.to_dict()}


def _check_manifest(pipeline: Pipeline, directory: Path, manifest: Mapping[str, Any]) -> None:
    """Check that all values that a runner reads equal this export's. Raises ArtifactError that names the first key.

    The answers of the self-test are left to the self-test itself, the inputs and outputs of graphs to the loader.
    """
    job, graphs, made = pipeline.job, manifest["graphs"], _plan(pipeline)
    target = job.target.to_dict()
    expected: dict[str, Any] = {
        "target": job.target.name,
        "model": _model_section(pipeline),
        "runtime": manifest_runtime(job.target, job.config, made),
        "provenance.target": {key: target[key] for key in TARGET_SECTIONS},
        "plan": made.to_dict(),
    }
    found = {key: manifest[key] for key in ("target", "model", "runtime", "plan")}
    found["provenance.target"] = {key: manifest["provenance"]["target"].get(key) for key in TARGET_SECTIONS}
    for name in job.target.graph_names:
        expected[f"graphs.{name}"] = {
            "precision": pipeline.precision(name)[0].to_dict(),
            "form": job.target.graphs[name].form,
            "session": job.target.session(name, graphs[name]["inputs"]),
        }
        found[f"graphs.{name}"] = {key: graphs[name].get(key) for key in ("precision", "form", "session")}
        # What the result shows of a graph; its reason is the text of the release that exported.
        _check_shown(directory, name, graphs[name])
    if manifest["self_test"]:  # the self-test itself refuses a manifest without answers
        made_of = {"plan": expected["plan"], "graphs": {name: expected[f"graphs.{name}"] for name in graphs}}
        found["self_test"], expected["self_test"] = recorded_and_expected_limits(
            manifest["self_test"], made_of, half=job.target.half
        )
    for key, value in expected.items():
        difference = _difference(found[key], json.loads(json.dumps(value)), key)
        if difference is not None:
            raise ArtifactError(f"{directory / MANIFEST_NAME}: {difference}; export again")
    if (directory / TOKENIZER_NAME).read_bytes() != pipeline.tokenizer():
        raise ArtifactError(f"{directory / TOKENIZER_NAME}: not the tokenizer of these weights; export again")


def _check_shown(directory: Path, name: str, graph: Mapping[str, Any]) -> None:
    """Check the values of a graph that only people read. Raises ArtifactError."""
    for key, kind in (("params", int), ("bytes", int), ("precision_reason", str)):
        if type(graph.get(key)) is not kind:
            raise ArtifactError(
                f"{directory / MANIFEST_NAME}: graphs.{name}.{key} is {_shown(graph.get(key))}, "
                f"this export writes {'a text' if kind is str else 'a whole number'}; export again"
            )


def _difference(found: object, expected: object, key: str) -> str | None:
    """Describe the first key at which two JSON values differ, with both values; None if they are equal."""
    if isinstance(found, dict) and isinstance(expected, dict):
        for name in [*expected, *(name for name in found if name not in expected)]:
            below = f"{key}.{name}"
            if name not in found:
                return f"{below} is missing"
            if name not in expected:
                return f"{below} is not part of an export"
            difference = _difference(found[name], expected[name], below)
            if difference is not None:
                return difference
        # The first matching exception of a precision applies, so their order matters.
        return None if list(found) == list(expected) or not key.endswith("overrides") else f"{key} is in another order"
    same = type(found) is type(expected) and found == expected
    return None if same else f"{key} is {_shown(found)}, this export writes {_shown(expected)}"


def _shown(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= SHOWN_CHARACTERS else f"{text[:SHOWN_CHARACTERS]}…"
