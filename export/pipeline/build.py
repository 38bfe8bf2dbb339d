"""The stages of a build, each under the hash of what it follows from; PyTorch is loaded by the first that needs it."""

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
from reporting.progress import BuildProgress, Stage

WEIGHTS_FILE = "weights.json"
TOKENIZER_FILE = "tokenizer.json"
SAMPLES_FILE = "samples.safetensors"
OUTPUTS_FILE = "outputs.safetensors"
GATE_MARGIN = 0.7
"""Share of the gate's error that the search may use: it sees prompts, the gate the worst of its inputs."""
RANGE_FRAMES = 8
"""Frames of the calibration set over which ranges of activations are taken, evenly spread."""

WEIGHTS_CODE = ("export.pipeline.job", "export.checkpoint.load", "export.checkpoint.tokenizer", "export.model.weights")
REFERENCE_CODE = ("export.evaluation.parity",)
TASK_CODE = ("export.evaluation.task_samples", "export.evaluation.task_error", "export.evaluation.parity")
PRECISION_CODE = ("export.evaluation.precision_search",)
RANGES_CODE = ("export.quantize.rounding",)
GRAPH_CODE = ("export.graphs.build",)
GATE_CODE = ("export.evaluation.gates", "export.evaluation.parity")
"""The modules that make each kind of stage; what they import counts too (`cache.source_sha256`)."""

EXPECTED_S = {
    "weights": (0.3, 30.0),
    "task reference": (3.0, 120.0),
    "precision": (1.0, 150.0),
    "activation": (0.5, 40.0),
    "reference": (0.5, 20.0),
    "graph": (0.5, 15.0),
    "gate": (2.0, 45.0),
    "plan and report": (0.2, 1.0),
}
"""Seconds to expect of each kind of stage before it was ever measured here: for a small and for a large model."""


COMPUTING = ("vision_encoder", "language_model.prefill")
"""Graphs whose time goes into products rather than into reading weights."""


def with_exceptions(chosen: Precision, asked: Precision) -> Precision:
    """What the search chose, and the exceptions that the target asks for where they are more exact than its default.

    Of two for one layer the more exact wins, whatever its source.
    """
    order = PRECISIONS.index
    exact = [(layer, kind) for layer, kind in asked.overrides if order(kind) < order(chosen.default)]
    found: dict[str, str] = {}
    for layer, kind in sorted([*exact, *chosen.overrides], key=lambda pair: order(pair[1])):
        found.setdefault(layer, kind)
    return Precision(chosen.default, tuple(found.items()))


def machine_name() -> str:
    """What decides which kernels compute: a result that was measured here is not one of another processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    features = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    return f"{platform.machine()} {features}"


def build_stages(job: Job, known_s: Mapping[str, float], *, graphs: bool = True) -> list[Stage]:
    """All stages in their order (without those that write graphs), with the seconds they took last time or usually."""
    column, order = int(is_large(job.config)), job.target.graph_names
    searched = [graph for graph in order if len(job.target.graphs[graph].candidates) > 1]
    names = ["weights", "task reference", *(f"reference {graph}" for graph in order)]
    names += [f"precision {graph}" for graph in searched]
    if graphs:
        vision = job.target.graphs["vision_encoder"]
        if vision.form == "plain" and "int8" in (vision.precision, *vision.candidates):
            names += ["activation ranges"]
        names += [f"graph {graph}" for graph in order]
    names += [f"gate {graph}" for graph in order]
    names += ["plan and report"] if graphs else []
    usual = {name: next(EXPECTED_S[kind][column] for kind in EXPECTED_S if name.startswith(kind)) for name in names}
    return [Stage(name, known_s.get(name, usual[name])) for name in names]


@dataclass(frozen=True)
class WeightsRecord:
    """What the weights stage found."""

    sha256: str
    trained: bool
    origin: str
    coverage: dict[str, Any]


class Pipeline:
    """One build's stages; every method returns what is in the cache or makes it.

    With `run_gates`, gates run even where the same bytes have passed before: that is what `verify` is for.
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
        """One stage in the cache, shown as it runs; within a build it is verified once."""
        if key not in self._entries:
            with self._progress.stage(title) as watch:
                self._entries[key], cached = self._cache.fetch_or_build(key, build)
                if cached:
                    watch.from_cache()
        return self._entries[key]

    def _json_stage(self, title: str, key: str, compute: Callable[[], Mapping[str, object]]) -> dict[str, Any]:
        """One stage whose result is plain JSON, in the order in which it was computed."""

        def build(directory: Path) -> None:
            (directory / RESULT_NAME).write_text(json.dumps(compute(), allow_nan=False), encoding="utf-8")

        content: dict[str, Any] = json.loads((self._stage(title, key, build) / RESULT_NAME).read_text(encoding="utf-8"))
        return content

    def _key(
        self, stage: str, parts: Mapping[str, object], modules: tuple[str, ...], recipe: Callable[..., Any]
    ) -> str:
        """Key of a stage, also of the method here that makes it (the whole module would undo all on every edit) and of
        the threads that sum for it."""
        parts = {**parts, "recipe": inspect.getsource(recipe), "threads": self._threads}
        return stage_key(stage, parts, modules)

    def weights(self) -> WeightsRecord:
        """Hash and origin of the weights; raises CheckpointError."""
        return WeightsRecord(**json.loads((self._weights_entry / WEIGHTS_FILE).read_text(encoding="utf-8")))

    def tokenizer(self) -> bytes:
        """tokenizer.json that goes with the weights."""
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
        """Parts of every key that depends on the network: its weights, wherever they came from, and the rest."""
        return {"weights": self.weights().sha256, "config": self.job.config.to_dict(), **more}

    # ---- what PyTorch gives

    def _reference_key(self, graph: str) -> str:
        parts = self._parts(graph=graph, inputs=self.job.target.gate(graph).inputs)
        return self._key("reference", parts, REFERENCE_CODE, Pipeline.reference)

    def reference(self, graph: str) -> Path:
        """Test inputs of a graph and PyTorch's outputs."""

        def build(directory: Path) -> None:
            model = self.job.weights.loaded.model
            save_samples(references(model, graph, self.job.target.gate(graph).inputs), directory / SAMPLES_FILE)

        return self._stage(f"reference {graph}", self._reference_key(graph), build) / SAMPLES_FILE

    @cached_property
    def samples(self) -> SampleSet:
        """Situations from the calibration set in which the robot is driven by an old semantic state."""
        offsets_s = self.job.target.runtime.frame_offsets_s
        return samples_from(self.job.calibration, self.job.config, offsets_s, self.tokenizer())

    def _task_key(self) -> str:
        offsets = list(self.job.target.runtime.frame_offsets_s)
        calibration, tokenizer = self.job.calibration.sha256, hashlib.sha256(self.tokenizer()).hexdigest()
        parts = self._parts(
            calibration=calibration, tokenizer=tokenizer, frame_offsets_s=offsets, new_tokens=NEW_TOKENS
        )
        return self._key("task", parts, TASK_CODE, Pipeline.task_reference)

    def task_reference(self) -> Path:
        """PyTorch's plans in those situations."""

        def build(directory: Path) -> None:
            stages = TorchStages(self.job.weights.loaded.model)
            outputs = run_stages(stages, self.samples, new_tokens=NEW_TOKENS, progress=self._progress.detail)
            save_outputs(outputs, directory / OUTPUTS_FILE)

        return self._stage("task reference", self._task_key(), build) / OUTPUTS_FILE

    @cached_property
    def _task_outputs(self) -> StageOutputs:
        return load_outputs(self.task_reference())

    # ---- what ships

    def decision(self, graph: str) -> dict[str, Any] | None:
        """What the sensitivity search chose for a graph and why; None where the target leaves no choice."""
        policy = self.job.target.graphs[graph]
        if len(policy.candidates) < 2:
            return None
        task, top1 = self.job.target.task_gate, self.job.target.gate(graph).top1
        limits = Limits(
            # The search sees few situations: it has to stay clear of the gate, which sees all of them.
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
            speed_first = graph in COMPUTING
            return self._search.choose(
                graph, policy.candidates, limits, measured=points, speed_first=speed_first
            ).to_dict()

        return self._json_stage(f"precision {graph}", key, choose)

    @cached_property
    def _search(self) -> Search:
        loaded = self.job.weights.loaded
        offsets_s = self.job.target.runtime.frame_offsets_s
        samples = search_samples(self.job.calibration, self.job.config, offsets_s, self.tokenizer())
        return Search(loaded.model, samples, trained=loaded.info.trained, progress=self._progress.detail)

    def precision(self, graph: str) -> tuple[Precision, str]:
        """Precision of a graph's layers and the reason for it."""
        decision, asked = self.decision(graph), self.job.target.precision(graph)
        if decision is None:
            return asked, f"target {self.job.target.name} leaves no other choice"
        chosen = Precision.from_dict(decision["precision"])
        precision = with_exceptions(chosen, asked)
        added = [f"{layer} in {kind}" for layer, kind in precision.overrides if (layer, kind) not in chosen.overrides]
        also = f"; {', '.join(added)} as target {self.job.target.name} asks" if added else ""
        return precision, f"{decision['reason']}{also}"

    def graph(self, graph: str) -> list[Path]:
        """The graph's files."""
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
        """Ranges of activations for an encoder whose form rounds them statically; None for all other graphs."""
        rounds = graph == "vision_encoder" and self.job.target.graphs[graph].form == "plain"
        if not rounds or "int8" not in (precision.default, *(kind for _, kind in precision.overrides)):
            return None

        def ranges() -> dict[str, float]:
            frames = self.samples.frames[:: max(1, len(self.samples.frames) // RANGE_FRAMES)]
            return activation_ranges(self.job.weights.loaded.model.vision, frames)

        parts = {"task": self._task_key(), "frames": RANGE_FRAMES}
        return self._json_stage("activation ranges", self._key("ranges", parts, RANGES_CODE, Pipeline._ranges), ranges)

    # ---- whether it is the same model

    def gate(self, artifacts: Artifacts, graph: str) -> GateResult:
        """Run a graph of the directory against PyTorch and hold it to the target's thresholds; raises GateError."""
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
        }
        key = stage_key(what, parts, GATE_CODE)
        if not self._run_gates:
            return self._cache.result(key, lambda: asdict(measure()))
        if key not in self._fresh:  # once for both halves of a pair
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
