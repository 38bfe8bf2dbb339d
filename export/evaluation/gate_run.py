"""Runs the graphs of a directory for the gate: from the verified bytes, on the provider that ships if it is here.

What the network is compared with comes from PyTorch in fp32 (`parity.references`, `run_stages`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx
import onnxruntime as ort

from edge.artifacts.manifest import Artifacts
from edge.inference.graph import CPU_PROVIDER, DTYPES, Graph
from edge.inference.language import LanguageModel
from export.evaluation.metrics import Arrays
from export.evaluation.task_error import Context, StageOutputs, TaskError, moment_contexts, plan, prompt_parts
from export.evaluation.task_error import compare as compare_task
from export.evaluation.task_samples import SampleSet, is_large
from export.evaluation.torch_stages import TorchStages
from export.graphs.action import guidance_input
from export.graphs.writer import IR_VERSION, OPSET
from export.model.config import TicVlaConfig

Floats = npt.NDArray[np.float32]


NEW_TOKENS = 16
"""Greedy tokens of every calibration prompt that are compared."""


def threads_for(config: TicVlaConfig) -> int:
    """Threads for everything that is measured on a model: always the same number, because another one may sum in
    another order and report another last digit. A small model's kernels are too short for two."""
    return 2 if is_large(config) else 1


@lru_cache
def provider_loads(provider: str) -> bool:
    """Whether ONNX Runtime can open a graph on that provider here: one may be listed whose libraries are missing."""
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
    except Exception:  # noqa: BLE001 - a provider fails in any way it likes; all that matters is that it does
        return False
    return bool(session.get_providers()[0] == provider)


def gate_provider(shipping: str) -> str:
    """The provider that the gate runs a graph on: the shipping one if it loads here, else the CPU's."""
    return shipping if provider_loads(shipping) else CPU_PROVIDER


class OpenGraph:
    """A graph of the directory as the gate runs it: arrays by name, in and out in fp32 whatever it computes in."""

    def __init__(self, artifacts: Artifacts, name: str, threads: int) -> None:
        shipping = artifacts.graphs[name].session.provider
        self.provider = gate_provider(shipping)
        # With its own options on its own provider; the CPU's has none of the shipping one's.
        self._graph = Graph(
            artifacts, name, threads=threads, provider=None if self.provider == shipping else self.provider
        )
        self._dtypes = {tensor.name: DTYPES[tensor.dtype] for tensor in artifacts.graphs[name].inputs}

    def __call__(self, feeds: Arrays) -> Arrays:
        """Run once; raises edge.inference.graph.GraphError."""
        typed = {name: np.asarray(feeds[name]).astype(dtype, copy=False) for name, dtype in self._dtypes.items()}
        found = self._graph.run(typed)
        return {
            name: array.astype(np.float32) if array.dtype == np.float16 else array
            for name, array in zip(self._graph.output_names, found, strict=True)
        }


class TaskCheck:
    """What the robot does differently when one graph is the shipped one and the others are PyTorch's in fp32."""

    def __init__(self, torch_stages: TorchStages, reference: StageOutputs, samples: SampleSet) -> None:
        self._torch = torch_stages
        self._reference = reference
        self._samples = samples

    def vision(self, graph: OpenGraph) -> TaskError:
        """Of the shipped encoder."""
        visual = [graph({"frame": frame})["visual_tokens"] for frame in self._samples.frames]
        kv = [self._torch.language(prompt_parts(s, visual), 0)[0] for s in self._samples.samples]
        return self._compare(visual, kv, self._torch.context)

    def language(self, artifacts: Artifacts, threads: int, provider: str | None) -> TaskError:
        """Of the shipped language model: one graph, or the pair as it runs together."""
        model = LanguageModel(artifacts, threads=threads, provider=provider)
        kv, texts = [], []
        for sample in self._samples.samples:
            segments = prompt_parts(sample, self._reference.visual)
            found = model.generate(segments, max_new_tokens=NEW_TOKENS, cancelled=lambda: False)
            kv.append(found.last_layer_kv[:, : found.prompt_tokens])
            texts.append(found.token_ids)
        return self._compare(self._reference.visual, kv, self._torch.context, texts=texts)

    def context(self, graph: OpenGraph) -> TaskError:
        """Of the shipped semantic context."""
        name = guidance_input(self._torch.model.config)[0]
        return self._compare(
            self._reference.visual, self._reference.kv, lambda guidance: _unpacked(graph({name: guidance}))
        )

    def action(self, graph: OpenGraph) -> TaskError:
        """Of the shipped action expert."""
        return self._compare(self._reference.visual, self._reference.kv, self._torch.context, act=_ShippedAction(graph))

    def _compare(
        self,
        visual: Sequence[Floats],
        kv: Sequence[Floats],
        context: Callable[[Floats], Context],
        *,
        texts: Sequence[tuple[int, ...]] | None = None,
        act: _ShippedAction | None = None,
    ) -> TaskError:
        stages: Any = self._torch if act is None else act
        trajectories = tuple(
            plan(stages, s, visual, moment_contexts(context, s, x))
            for s, x in zip(self._samples.samples, kv, strict=True)
        )
        # Graphs that write no text are not held to any.
        reference = self._reference if texts is not None else replace(self._reference, token_ids=tuple(() for _ in kv))
        found = StageOutputs(tuple(visual), tuple(kv), tuple(texts or reference.token_ids), trajectories, ())
        return compare_task(reference, found, self._samples)


def _unpacked(context: Arrays) -> tuple[Floats, Floats]:
    """Keys and values [layers, 1, heads, T, d] of the graphs' layout (a tensor a layer, keys transposed)."""
    layers = range(len(context) // 2)
    keys = np.stack([context[f"context.{i}.key"].swapaxes(2, 3) for i in layers])
    return np.ascontiguousarray(keys), np.stack([context[f"context.{i}.value"] for i in layers])


class _ShippedAction:
    """`act` of `Stages` through the shipped graph, whose context has the layout that it reads fastest."""

    def __init__(self, graph: OpenGraph) -> None:
        self._graph = graph

    def act(self, visual_tokens: Floats, state: Floats, latency: Floats, keys: Floats, values: Floats) -> Floats:
        feeds: Mapping[str, npt.NDArray[Any]] = {
            "visual_tokens": visual_tokens,
            "state": state,
            "latency": latency,
            **{f"context.{i}.key": layer.swapaxes(2, 3) for i, layer in enumerate(keys)},
            **{f"context.{i}.value": layer for i, layer in enumerate(values)},
        }
        result: Floats = self._graph(feeds)["trajectory"]
        return result
