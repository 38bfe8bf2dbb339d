"""Gates: compare each graph with PyTorch in fp32 and refuse the export if a threshold of the target is exceeded.

Graphs run from the verified bytes of a directory, on the target's provider if this machine has it, else on the CPU.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import onnxruntime as ort

from edge.artifacts.manifest import Artifacts
from edge.inference.graph import CPU_PROVIDER, DTYPES, Graph
from edge.inference.language import LanguageModel
from export.evaluation.parity import Arrays, ParityResult
from export.evaluation.task_error import (
    Act,
    Context,
    StageOutputs,
    TaskResult,
    TorchStages,
    compare,
    moment_contexts,
    plan,
    prompt_parts,
)
from export.evaluation.task_samples import SampleSet, is_large
from export.graphs.action import guidance_input
from export.graphs.writer import IR_VERSION, OPSET
from export.model.config import TicVlaConfig
from export.targets.sections import GraphGate, TaskGate

Floats = npt.NDArray[np.float32]

PASS, WARN, FAIL = "PASS", "WARN", "FAIL"


class GateError(Exception):
    """Graph that failed its gate; the text has its name and the numbers."""


@dataclass(frozen=True)
class Verdict:
    """PASS, WARN or FAIL, with one line per crossed threshold."""

    level: str
    reasons: tuple[str, ...] = ()


@dataclass(frozen=True)
class GateResult:
    """Measurements and verdict of one graph, and the provider that ran it."""

    parity: ParityResult
    task: TaskResult | None
    verdict: Verdict
    provider: str
    shipping_provider: str

    def to_dict(self) -> dict[str, Any]:
        """Return the manifest's `parity` section."""
        return {
            **asdict(self.parity),
            "task": None if self.task is None else asdict(self.task),
            "verdict": self.verdict.level,
            "reasons": list(self.verdict.reasons),
            "provider": self.provider,
            "shipping_provider_checked": self.provider == self.shipping_provider,
        }


def judge(
    parity: ParityResult, task: TaskResult | None, gate: GraphGate, task_gate: TaskGate, *, trained: bool = True
) -> Verdict:
    """Compare one graph's numbers with its thresholds; NaN fails.

    Logits of untrained weights are nearly equal, so rounding changes the chosen token: a different token only warns,
    and text is not compared.
    """
    failed: list[str] = []
    warned: list[str] = []

    def at_least(what: str, found: float, limit: float | None, into: list[str]) -> None:
        if limit is not None and not found >= limit:
            into.append(f"{what} {found:.7g} (≥ {limit:g})")

    def at_most(what: str, found: float, limit: float | None, into: list[str]) -> None:
        if limit is not None and not found <= limit:
            into.append(f"{what} {found:.4g} (≤ {limit:g})")

    at_least("cosine", parity.cosine, gate.min_cosine, failed)
    at_least("cosine", parity.cosine, gate.warn_cosine, warned)
    at_most("max-abs", parity.max_abs, gate.max_abs, failed)
    at_least("difference between inputs", parity.min_difference, gate.min_difference, failed)
    if parity.top1 is not None:
        at_least("same token", parity.top1, gate.top1, failed if trained else warned)
    if task is not None:
        for name, unit in (("waypoint", "cm"), ("heading", "deg")):
            found = getattr(task, f"{name}_{unit}")
            at_most(f"{name} error in {unit}", found, getattr(task_gate, f"{name}_{unit}"), failed)
            at_most(f"{name} error in {unit}", found, getattr(task_gate, f"warn_{name}_{unit}"), warned)
        at_most("speed command error in m/s", task.speed_mps, task_gate.speed_mps, failed)
        at_most("turn command error in rad/s", task.turn_radps, task_gate.turn_radps, failed)
        relative = math.inf if task.relative is None else task.relative
        at_most("deviation as a share of the plans' spread", relative, task_gate.relative, failed)
        at_most("deviation as a share of the plans' spread", relative, task_gate.warn_relative, warned)
        at_least("cosine of the semantic state", task.kv_cosine, task_gate.kv_cosine, failed)
        at_least("cosine of the semantic state", task.kv_cosine, task_gate.warn_kv_cosine, warned)
        if trained and task.token_agreement is not None:
            at_least("share of the same text", task.token_agreement, task_gate.token_agreement, failed)
            at_least("share of the same text", task.token_agreement, task_gate.warn_token_agreement, warned)
        if task.semantic is None or not task.semantic >= task_gate.min_semantic:
            moved = 0.0 if task.semantic is None else task.semantic
            warned.append(
                f"the exact model's plans hardly depend on the semantic state: another moves them by {moved:.2g} of "
                f"their spread (≥ {task_gate.min_semantic:g}), so the task error is a weak test of the language model"
            )
    if failed:
        return Verdict(FAIL, tuple(failed))
    return Verdict(WARN, tuple(warned)) if warned else Verdict(PASS)


def require(graph: str, verdict: Verdict) -> None:
    """Raise GateError when a graph failed."""
    if verdict.level == FAIL:
        raise GateError(f"{graph}: not the same model: {'; '.join(verdict.reasons)}")


NEW_TOKENS = 16
"""Number of greedy tokens compared per calibration prompt."""


def threads_for(config: TicVlaConfig) -> int:
    """Return the number of threads for all measurements of a model.

    It is fixed, because the number of threads changes the order of sums and so the last digit. A small model's
    kernels are too short for two threads.
    """
    return 2 if is_large(config) else 1


@lru_cache
def provider_loads(provider: str) -> bool:
    """Return whether ONNX Runtime can open a graph on a provider; it may list one whose libraries are missing."""
    if provider not in ort.get_available_providers():
        return False
    value = onnx.helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, [1])
    result = onnx.helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, [1])
    graph = onnx.helper.make_graph([onnx.helper.make_node("Add", ["x", "x"], ["y"])], "probe", [value], [result])
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", OPSET)])
    model.ir_version = IR_VERSION
    options = ort.SessionOptions()
    options.log_severity_level = 4
    try:
        session = ort.InferenceSession(model.SerializeToString(), sess_options=options, providers=[provider])
    except Exception:  # noqa: BLE001 - a provider may raise anything; any failure means that it is unusable
        return False
    return bool(session.get_providers()[0] == provider)


def gate_provider(shipping: str) -> str:
    """Return the provider on which the gate runs a graph: the target's if it loads on this machine, else the CPU's."""
    return shipping if provider_loads(shipping) else CPU_PROVIDER


class OpenGraph:
    """Graph of a directory, opened for the gate: inputs and outputs are fp32 arrays by name, whatever its precision."""

    def __init__(self, artifacts: Artifacts, name: str, threads: int) -> None:
        shipping = artifacts.graphs[name].session.provider
        self.provider = gate_provider(shipping)
        # The provider's options are valid only on that provider, not on the CPU's.
        self._graph = Graph(
            artifacts, name, threads=threads, provider=None if self.provider == shipping else self.provider
        )
        self._dtypes = {tensor.name: DTYPES[tensor.dtype] for tensor in artifacts.graphs[name].inputs}

    def __call__(self, feeds: Arrays) -> Arrays:
        """Run the graph once. Raises edge.inference.graph.GraphError."""
        typed = {name: np.asarray(feeds[name]).astype(dtype, copy=False) for name, dtype in self._dtypes.items()}
        found = self._graph.run(typed)
        return {
            name: array.astype(np.float32) if array.dtype == np.float16 else array
            for name, array in zip(self._graph.output_names, found, strict=True)
        }


class TaskCheck:
    """Task error of one exported graph, with all others computed by PyTorch in fp32."""

    def __init__(self, torch_stages: TorchStages, reference: StageOutputs, samples: SampleSet) -> None:
        self._torch = torch_stages
        self._reference = reference
        self._samples = samples

    def vision(self, graph: OpenGraph) -> TaskResult:
        """Return the task error of the exported encoder."""
        visual = [graph({"frame": frame})["visual_tokens"] for frame in self._samples.frames]
        kv = [self._torch.language(prompt_parts(s, visual), 0)[0] for s in self._samples.samples]
        return self._compare(visual, kv, self._torch.context)

    def language(self, artifacts: Artifacts, threads: int, provider: str | None) -> TaskResult:
        """Return the task error of the exported language model: one graph, or prefill and decode together."""
        model = LanguageModel(artifacts, threads=threads, provider=provider)
        kv, texts = [], []
        for sample in self._samples.samples:
            segments = prompt_parts(sample, self._reference.visual)
            found = model.generate(segments, max_new_tokens=NEW_TOKENS, cancelled=lambda: False)
            kv.append(found.last_layer_kv[:, : found.prompt_tokens])
            texts.append(found.token_ids)
        return self._compare(self._reference.visual, kv, self._torch.context, texts=texts)

    def context(self, graph: OpenGraph) -> TaskResult:
        """Return the task error of the exported semantic context."""
        name = guidance_input(self._torch.model.config)[0]
        return self._compare(
            self._reference.visual, self._reference.kv, lambda guidance: _unpacked(graph({name: guidance}))
        )

    def action(self, graph: OpenGraph) -> TaskResult:
        """Return the task error of the exported action expert."""
        return self._compare(self._reference.visual, self._reference.kv, self._torch.context, act=_shipped_act(graph))

    def _compare(
        self,
        visual: Sequence[Floats],
        kv: Sequence[Floats],
        context: Callable[[Floats], Context],
        *,
        texts: Sequence[tuple[int, ...]] | None = None,
        act: Act | None = None,
    ) -> TaskResult:
        trajectories = tuple(
            plan(act or self._torch.act, s, visual, moment_contexts(context, s, x))
            for s, x in zip(self._samples.samples, kv, strict=True)
        )
        # Text is compared only for graphs that decode it.
        reference = self._reference if texts is not None else replace(self._reference, token_ids=tuple(() for _ in kv))
        found = StageOutputs(tuple(visual), tuple(kv), tuple(texts or reference.token_ids), trajectories, ())
        return compare(reference, found, self._samples)


def _unpacked(context: Arrays) -> tuple[Floats, Floats]:
    """Convert the graphs' layout (a tensor per layer, keys transposed) to keys and values [layers, 1, heads, T, d]."""
    layers = range(len(context) // 2)
    keys = np.stack([context[f"context.{i}.key"].swapaxes(2, 3) for i in layers])
    return np.ascontiguousarray(keys), np.stack([context[f"context.{i}.value"] for i in layers])


def _shipped_act(graph: OpenGraph) -> Act:
    """Return a `TorchStages.act` that runs the exported graph, with the context in the graph's layout."""

    def act(visual_tokens: Floats, state: Floats, latency: Floats, keys: Floats, values: Floats) -> Floats:
        feeds: Arrays = {
            "visual_tokens": visual_tokens,
            "state": state,
            "latency": latency,
            **{f"context.{i}.key": layer.swapaxes(2, 3) for i, layer in enumerate(keys)},
            **{f"context.{i}.value": layer for i, layer in enumerate(values)},
        }
        result: Floats = graph(feeds)["trajectory"]
        return result

    return act
