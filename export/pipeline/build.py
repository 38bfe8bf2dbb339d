"""Stages of a build, each cached under the hash of its inputs; the first stage that needs PyTorch loads it."""

from __future__ import annotations

import hashlib
import inspect
import json
import math
import platform
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch

from edge.artifacts.manifest import LANGUAGE_PAIR, LANGUAGE_WHOLE, Artifacts
from edge.inference.graph import GraphError
from export.checkpoint.tokenizer import tokenizer_for
from export.core.cache import ENTRY_NAME, RESULT_NAME, StageCache, file_sha256, stage_key
from export.evaluation.gates import (
    NEW_TOKENS,
    GateError,
    GateResult,
    OpenGraph,
    TaskCheck,
    gate_provider,
    judge,
    threads_for,
)
from export.evaluation.parity import (
    ParityError,
    ParityResult,
    compare,
    load_outputs,
    load_samples,
    references,
    save_outputs,
    save_samples,
)
from export.evaluation.precision_search import Limits, Search, search_samples
from export.evaluation.task_error import StageOutputs, TaskErrorError, TaskResult, TorchStages, run_stages
from export.evaluation.task_samples import SampleSet, is_large, samples_from
from export.graphs.build import write_graph
from export.model.weights import weights_sha256
from export.pipeline.job import Job
from export.quantize.precision import PRECISIONS, Precision
from export.quantize.rounding import activation_ranges
from firmware_bridge.system.input_file import read_json
from reporting.progress import BuildProgress, Stage

WEIGHTS_FILE = "weights.json"
TOKENIZER_FILE = "tokenizer.json"
SAMPLES_FILE = "samples.safetensors"
OUTPUTS_FILE = "outputs.safetensors"
GATE_MARGIN = 0.7
"""Share of the gate's limit that the search may use: the search tests prompts, the gate the worst of its inputs."""
RANGE_FRAMES = 8
"""Number of calibration frames, evenly spread, that determine the ranges of activations."""

WEIGHTS_CODE = ("export.pipeline.job", "export.checkpoint.load", "export.checkpoint.tokenizer", "export.model.weights")
REFERENCE_CODE = ("export.evaluation.parity",)
TASK_CODE = ("export.evaluation.task_samples", "export.evaluation.task_error", "export.evaluation.parity")
PRECISION_CODE = ("export.evaluation.precision_search",)
RANGES_CODE = ("export.quantize.rounding",)
GRAPH_CODE = ("export.graphs.build",)
GATE_CODE = ("export.evaluation.gates", "export.evaluation.parity")
"""Modules of each kind of stage; their hash includes their imports (`cache.source_sha256`)."""

EXPECTED_S = {
    "weights": (0.3, 30.0),
    "task reference": (3.0, 120.0),
    "precision": (1.0, 150.0),
    "activation": (0.5, 40.0),
    "reference": (0.5, 20.0),
    "graph": (0.5, 15.0),
    "gate": (2.0, 45.0),
    "self-test": (0.5, 20.0),
    "plan and report": (0.2, 1.0),
}
"""Expected duration of each kind of stage before the first measurement, s: for a small and for a large model."""
COMPUTING = ("vision_encoder", "language_model.prefill")
"""Graphs whose time is limited by computing, not by reading weights."""


def with_exceptions(chosen: Precision, asked: Precision) -> Precision:
    """Combine the search's choice with the target's exceptions that are more exact than the chosen default.

    For a layer with two exceptions the more exact one applies.
    """
    order = PRECISIONS.index
    exact = [(layer, kind) for layer, kind in asked.overrides if order(kind) < order(chosen.default)]
    found: dict[str, str] = {}
    for layer, kind in sorted([*exact, *chosen.overrides], key=lambda pair: order(pair[1])):
        found.setdefault(layer, kind)
    return Precision(chosen.default, tuple(found.items()))


def machine_name() -> str:
    """Return the processor's name, on which the choice of kernels and so a measured result depends."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    features = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    return f"{platform.machine()} {features}"


def build_stages(job: Job, known_s: Mapping[str, float], *, graphs: bool = True) -> list[Stage]:
    """List the stages in order with their last or usual duration, s; those of `verify` unless `graphs`."""
    column, order = int(is_large(job.config)), job.target.graph_names
    searched = [graph for graph in order if len(job.target.graphs[graph].candidates) > 1]
    names = ["weights", *([] if graphs else ["self-test"]), "task reference", *(f"reference {g}" for g in order)]
    names += [f"precision {graph}" for graph in searched]
    if graphs:
        vision = job.target.graphs["vision_encoder"]
        if vision.form == "plain" and "int8" in (vision.precision, *vision.candidates, *vision.overrides.values()):
            names += ["activation ranges"]
        names += [f"graph {graph}" for graph in order]
    names += [*(f"gate {graph}" for graph in order), *(["self-test", "plan and report"] if graphs else [])]
    usual = {name: next(EXPECTED_S[kind][column] for kind in EXPECTED_S if name.startswith(kind)) for name in names}
    return [Stage(name, known_s.get(name, usual[name])) for name in names]


@dataclass(frozen=True)
class WeightsRecord:
    """Result of the weights stage."""

    sha256: str
    trained: bool
    origin: str
    coverage: dict[str, Any]


class Pipeline:
    """Stages of one build; every method returns the cached result or computes it.

    With `run_gates`, gates run even if the same bytes have passed before, as `verify` needs.
    """

    def __init__(self, job: Job, cache: StageCache, progress: BuildProgress, *, run_gates: bool = False) -> None:
        self.job = job
        self._run_gates = run_gates
        self._cache = cache
        self._progress = progress
        self._entries: dict[str, Path] = {}
        self._fresh: dict[str, dict[str, Any]] = {}
        self._threads = threads_for(job.config)
        torch.set_num_threads(self._threads)

    def _stage(self, title: str, key: str, build: Callable[[Path], None]) -> Path:
        """Run or fetch one stage with progress; within a build its entry is checked once."""
        if key not in self._entries:
            with self._progress.stage(title) as watch:
                self._entries[key], cached = self._cache.fetch_or_build(key, build)
                if cached:
                    watch.from_cache()
        return self._entries[key]

    def _json_stage(self, title: str, key: str, compute: Callable[[], Mapping[str, object]]) -> dict[str, Any]:
        """Run or fetch one stage whose result is plain JSON; keeps the order of keys."""

        def build(directory: Path) -> None:
            (directory / RESULT_NAME).write_text(json.dumps(compute(), allow_nan=False), encoding="utf-8")

        return dict(read_json(self._stage(title, key, build) / RESULT_NAME))

    def _key(
        self, stage: str, parts: Mapping[str, object], modules: tuple[str, ...], recipe: Callable[..., Any]
    ) -> str:
        """Return the key of a stage.

        It also hashes the method of this class that computes the stage (not this module, whose every edit would
        invalidate all stages) and the number of threads.
        """
        parts = {**parts, "recipe": inspect.getsource(recipe), "threads": self._threads}
        return stage_key(stage, parts, modules)

    def weights(self) -> WeightsRecord:
        """Hash and origin of the weights; raises CheckpointError."""
        return WeightsRecord(**read_json(self._weights_entry / WEIGHTS_FILE))

    def tokenizer(self) -> bytes:
        """Return tokenizer.json for the weights."""
        return (self._weights_entry / TOKENIZER_FILE).read_bytes()

    @cached_property
    def _weights_entry(self) -> Path:
        def build(directory: Path) -> None:
            loaded = self.job.weights.loaded
            record = {
                "sha256": weights_sha256(loaded.model),
                "trained": loaded.info.trained,
                "origin": loaded.info.origin,
                "coverage": asdict(loaded.coverage),
            }
            (directory / WEIGHTS_FILE).write_text(json.dumps(record, sort_keys=True), encoding="utf-8")
            (directory / TOKENIZER_FILE).write_bytes(tokenizer_for(self.job.config, loaded.tokenizer))

        key = self._key("weights", self.job.weights.fingerprint(), WEIGHTS_CODE, build)
        return self._stage("weights", key, build)

    def _parts(self, **more: Any) -> dict[str, Any]:
        """Return the parts of a key that depends on the network: the hash of its weights, and further parts."""
        return {"weights": self.weights().sha256, "config": self.job.config.to_dict(), **more}

    # ---- PyTorch's outputs

    def _reference_key(self, graph: str) -> str:
        parts = self._parts(graph=graph, inputs=self.job.target.gate(graph).inputs)
        return self._key("reference", parts, REFERENCE_CODE, Pipeline.reference)

    def reference(self, graph: str) -> Path:
        """Return the file of a graph's test inputs and PyTorch's outputs."""

        def build(directory: Path) -> None:
            model = self.job.weights.loaded.model
            save_samples(references(model, graph, self.job.target.gate(graph).inputs), directory / SAMPLES_FILE)

        return self._stage(f"reference {graph}", self._reference_key(graph), build) / SAMPLES_FILE

    @cached_property
    def samples(self) -> SampleSet:
        """Samples of the task error from the calibration set."""
        offsets_s = self.job.target.runtime.frame_offsets_s
        return samples_from(self.job.calibration, self.job.config, offsets_s, self.tokenizer())

    def _task_key(self) -> str:
        offsets = list(self.job.target.runtime.frame_offsets_s)
        used, tokenizer = self.job.calibration.sha256, hashlib.sha256(self.tokenizer()).hexdigest()
        parts = self._parts(calibration=used, tokenizer=tokenizer, frame_offsets_s=offsets, new_tokens=NEW_TOKENS)
        return self._key("task", parts, TASK_CODE, Pipeline.task_reference)

    def task_reference(self) -> Path:
        """Return the file of PyTorch's plans for those samples."""

        def build(directory: Path) -> None:
            stages = TorchStages(self.job.weights.loaded.model)
            outputs = run_stages(stages, self.samples, new_tokens=NEW_TOKENS, progress=self._progress.detail)
            save_outputs(outputs, directory / OUTPUTS_FILE)

        return self._stage("task reference", self._task_key(), build) / OUTPUTS_FILE

    @cached_property
    def _task_outputs(self) -> StageOutputs:
        return load_outputs(self.task_reference())

    # ---- graphs and their precision

    def decision(self, graph: str) -> dict[str, Any] | None:
        """Return the search's precision for a graph with the reason; None if the target fixes the precision."""
        policy = self.job.target.graphs[graph]
        if len(policy.candidates) < 2:
            return None
        task, top1 = self.job.target.task_gate, self.job.target.gate(graph).top1
        limits = Limits(
            # The search tests few samples and the gate all, so the search keeps a margin to the gate's limits.
            waypoint_cm=task.warn_waypoint_cm or task.waypoint_cm,
            heading_deg=task.warn_heading_deg or task.heading_deg,
            speed_mps=task.speed_mps,
            turn_radps=task.turn_radps,
            relative=task.warn_relative,
            top1=top1,
            # A relative error of e leaves a cosine of about 1 − e²/2.
            output_error=GATE_MARGIN * math.sqrt(2 * max(1 - self.job.target.gate(graph).min_cosine, 1e-9)),
        )
        points = [point for point in self.job.target.measured if point.model == self.job.config.name]
        key = self._key(
            "precision",
            {
                "trained": self.weights().trained,
                "speed_first": graph in COMPUTING,
                "task": self._task_key(),
                "graph": graph,
                "candidates": list(policy.candidates),
                "form": policy.form,
                "limits": asdict(limits),
                "measured": [asdict(point) for point in points],
            },
            PRECISION_CODE,
            Pipeline.decision,
        )

        def choose() -> dict[str, Any]:
            search, first = self._search, graph in COMPUTING
            return search.choose(graph, policy.candidates, limits, measured=points, speed_first=first).to_dict()

        return self._json_stage(f"precision {graph}", key, choose)

    @cached_property
    def _search(self) -> Search:
        loaded = self.job.weights.loaded
        offsets_s = self.job.target.runtime.frame_offsets_s
        samples = search_samples(self.job.calibration, self.job.config, offsets_s, self.tokenizer())
        return Search(loaded.model, samples, trained=loaded.info.trained, progress=self._progress.detail)

    def precision(self, graph: str) -> tuple[Precision, str]:
        """Return the precision of a graph's layers and the reason for it."""
        decision, asked = self.decision(graph), self.job.target.precision(graph)
        if decision is None:
            return asked, f"target {self.job.target.name} fixes the precision"
        chosen = Precision.from_dict(decision["precision"])
        precision = with_exceptions(chosen, asked)
        added = [f"{layer} in {kind}" for layer, kind in precision.overrides if (layer, kind) not in chosen.overrides]
        also = f"; {', '.join(added)} as target {self.job.target.name} asks" if added else ""
        return precision, f"{decision['reason']}{also}"

    def graph(self, graph: str) -> list[Path]:
        """Return the graph's files."""
        policy, half = self.job.target.graphs[graph], self.job.target.half
        precision, _ = self.precision(graph)
        ranges = self._ranges(graph, precision)
        parts = self._parts(graph=graph, precision=precision.to_dict(), form=policy.form, half=half, ranges=ranges)
        key = self._key("graph", parts, GRAPH_CODE, Pipeline.graph)

        def build(directory: Path) -> None:
            model = self.job.weights.loaded.model
            write_graph(model, graph, precision, policy.form, directory, half=half, ranges=ranges)

        entry = self._stage(f"graph {graph}", key, build)
        return sorted(path for path in entry.iterdir() if path.name != ENTRY_NAME)

    def _ranges(self, graph: str, precision: Precision) -> dict[str, float] | None:
        """Return the ranges of activations for an encoder with static rounding; None for other graphs."""
        rounds = graph == "vision_encoder" and self.job.target.graphs[graph].form == "plain"
        if not rounds or "int8" not in (precision.default, *(kind for _, kind in precision.overrides)):
            return None

        def ranges() -> dict[str, float]:
            frames = self.samples.frames[:: max(1, len(self.samples.frames) // RANGE_FRAMES)]
            return activation_ranges(self.job.weights.loaded.model.vision, frames)

        parts = {"task": self._task_key(), "frames": RANGE_FRAMES}
        return self._json_stage("activation ranges", self._key("ranges", parts, RANGES_CODE, Pipeline._ranges), ranges)

    # ---- comparison with PyTorch

    def gate(self, artifacts: Artifacts, graph: str) -> GateResult:
        """Compare a graph of the directory with PyTorch by the target's thresholds. Raises GateError."""
        contract, gate = artifacts.graphs[graph], self.job.target.gate(graph)
        provider = gate_provider(contract.session.provider)

        def measure_parity() -> ParityResult:
            return compare(graph, load_samples(self.reference(graph)), OpenGraph(artifacts, graph, self._threads))

        try:
            with self._progress.stage(f"gate {graph}") as watch:
                measured, parity_cached = self._measured(
                    "parity", artifacts, (graph,), self._reference_key(graph), measure_parity
                )
                together = LANGUAGE_PAIR if graph in LANGUAGE_PAIR else (graph,)
                moved, task_cached = self._measured(
                    "task", artifacts, together, self._task_key(), lambda: self._task(artifacts, graph)
                )
                if parity_cached and task_cached:
                    watch.from_cache()
        except (ParityError, GraphError, TaskErrorError) as error:
            raise GateError(str(error)) from error
        parity, task = ParityResult(**measured), TaskResult.from_dict(moved)
        verdict = judge(parity, task, gate, self.job.target.task_gate, trained=self.weights().trained)
        return GateResult(parity, task, verdict, provider, contract.session.provider)

    def _measured(
        self,
        what: str,
        artifacts: Artifacts,
        graphs: tuple[str, ...],
        reference: str,
        measure: Callable[[], ParityResult | TaskResult],
    ) -> tuple[dict[str, Any], bool]:
        files = [n for graph in graphs for n in (artifacts.graphs[graph].file, *artifacts.graphs[graph].data_files)]
        parts = {
            "files": {name: file_sha256(artifacts.directory / name) for name in files},
            "sessions": [vars(artifacts.graphs[graph].session) for graph in graphs],
            "providers": [gate_provider(artifacts.graphs[graph].session.provider) for graph in graphs],
            "reference": reference,
            "threads": self._threads,
            "machine": machine_name(),
            # The language model's check generates as the runner does, in chunks of the manifest's size.
            "runtime": repr(artifacts.runtime) if {*graphs} & {*LANGUAGE_WHOLE, *LANGUAGE_PAIR} else None,
        }
        key = stage_key(what, parts, GATE_CODE)
        if not self._run_gates:
            return self._cache.result(key, lambda: asdict(measure()))
        if key not in self._fresh:  # shared by both graphs of a pair
            self._fresh[key] = asdict(measure())
        return self._fresh[key], False

    def _task(self, artifacts: Artifacts, graph: str) -> TaskResult:
        check = TaskCheck(TorchStages(self.job.weights.loaded.model), self._task_outputs, self.samples)
        if graph in (*LANGUAGE_WHOLE, *LANGUAGE_PAIR):
            shipping = artifacts.graphs[graph].session.provider
            provider = gate_provider(shipping)
            return check.language(artifacts, self._threads, None if provider == shipping else provider)
        opened = OpenGraph(artifacts, graph, self._threads)
        run = {"vision_encoder": check.vision, "semantic_context": check.context, "action_expert": check.action}
        return run[graph](opened)
