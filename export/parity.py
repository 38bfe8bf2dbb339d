"""Gate: every graph, on the exact bytes that ship, must give what PyTorch gives (and must react to its input)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from export.graphs import GraphSpec, past_names
from export.model.config import TicVlaConfig
from export.model.network import TicVla
from export.target import ParityGate

Arrays = dict[str, npt.NDArray[Any]]
RunGraph = Callable[[Mapping[str, npt.NDArray[Any]]], Sequence[npt.NDArray[Any]]]


@dataclass(frozen=True)
class ParityResult:
    """Worst case over all inputs and outputs of one graph."""

    inputs: int
    cosine: float
    max_abs: float
    min_difference: float
    """Smallest max-abs difference between the outputs of two different inputs (negative control)."""
    verdict: str

    def to_dict(self) -> dict[str, Any]:
        """Plain JSON form."""
        return asdict(self)


def sample_inputs(config: TicVlaConfig, name: str, index: int) -> Arrays:
    """The `index`-th test input of a graph: seeded, all different, with the lengths a run meets."""
    rng = np.random.default_rng([index, 7])
    vision, language, action = config.vision, config.language, config.action

    def normal(*shape: int) -> npt.NDArray[np.float32]:
        return rng.standard_normal(shape).astype(np.float32)

    if name == "vision_encoder":
        # A smooth picture and noise in turn: a frame is neither flat nor white.
        coarse = rng.integers(0, 256, (1, 4, 4, 3)) if index % 2 else rng.integers(0, 256, (1, 64, 64, 3))
        repeat = -(-vision.image_px // coarse.shape[1])
        frame = coarse.repeat(repeat, axis=1).repeat(repeat, axis=2)[:, : vision.image_px, : vision.image_px]
        return {"frame": frame.astype(np.uint8)}
    if name == "language_model":
        frames = index % 3
        past = 0 if index % 2 == 0 else int(rng.integers(1, 60))
        ids = rng.integers(language.img_context_id + 1, language.vocab, (1, 3 + index))
        image = np.full((1, frames * config.frame_tokens), language.img_context_id)
        caches = {
            n: normal(1, language.kv_heads, past, language.head_dim) for n in past_names(config, "past_key_values")
        }
        return {
            # Also a single token on a filled cache: what every decoding step looks like.
            "input_ids": np.concatenate([ids[:, :2], image, ids[:, 2:]], axis=1) if index != 3 else ids[:, :1],
            "visual_tokens": normal(max(frames, 1), vision.tokens, vision.token_dim),
            **caches,
        }
    if name == "semantic_context":
        return {"last_layer_kv": normal(1, 20 + 17 * index, config.kv_dim)}
    if name == "action_expert":
        context = (action.layers, 1, action.heads, 20 + 17 * index, action.hidden // action.heads)
        return {
            "visual_tokens": normal(1, vision.tokens, vision.token_dim),
            "state": normal(1, 3),
            "latency": np.abs(normal(1, 4)) * np.float32(3),
            "context_keys": normal(*context),
            "context_values": normal(*context),
        }
    raise ValueError(f"no test inputs for graph {name!r}")


def _torch_outputs(spec: GraphSpec, feeds: Arrays) -> list[npt.NDArray[Any]]:
    tensors = {name: torch.from_numpy(array) for name, array in feeds.items()}
    caches = [tensor for name, tensor in tensors.items() if name.startswith("past_key_values")]
    plain = [tensor for name, tensor in tensors.items() if not name.startswith("past_key_values")]
    with torch.no_grad():
        outputs = spec.module(*plain, caches) if caches else spec.module(*plain)
    outputs = outputs if isinstance(outputs, tuple) else (outputs,)
    return [tensor.numpy() for tensor in outputs]


def _cosine(a: npt.NDArray[Any], b: npt.NDArray[Any]) -> float:
    x, y = a.ravel().astype(np.float64), b.ravel().astype(np.float64)
    norm = np.linalg.norm(x) * np.linalg.norm(y)
    return float(x @ y / norm) if norm > 0 else float(np.array_equal(x, y))


def _difference(a: Sequence[npt.NDArray[Any]], b: Sequence[npt.NDArray[Any]]) -> float:
    """Largest difference where two runs overlap (their free axes may differ in length)."""
    largest = 0.0
    for x, y in zip(a, b, strict=True):
        cut = tuple(slice(0, min(m, n)) for m, n in zip(x.shape, y.shape, strict=True))
        if all(s.stop > 0 for s in cut):
            largest = max(largest, float(np.max(np.abs(x[cut].astype(np.float64) - y[cut].astype(np.float64)))))
    return largest


def check_graph(model: TicVla, spec: GraphSpec, run: RunGraph, gate: ParityGate) -> ParityResult:
    """Compare `run` with PyTorch over `gate.inputs` inputs; PASS only when every threshold holds."""
    cosine, max_abs, min_difference = 1.0, 0.0, np.inf
    previous: list[Sequence[npt.NDArray[Any]]] = []
    for index in range(gate.inputs):
        feeds = sample_inputs(model.config, spec.name, index)
        expected, found = _torch_outputs(spec, feeds), run(feeds)
        for name, x, y in zip(spec.outputs, expected, found, strict=True):
            if x.shape != y.shape or not np.isfinite(y).all():
                cosine, max_abs = -1.0, float("inf")
                continue
            if x.size and name == "next_token":
                # An index has no cosine; any other token than PyTorch's is a failure.
                max_abs = max(max_abs, float(np.any(x != y)))
            elif x.size:
                cosine = min(cosine, _cosine(x, y))
                max_abs = max(max_abs, float(np.max(np.abs(x.astype(np.float64) - y))))
        # The first floating output speaks for the graph: caches echo their input and would always differ.
        chosen = [y for name, y in zip(spec.outputs, found, strict=True) if name in PRIMARY_OUTPUTS]
        min_difference = min([min_difference, *(_difference(chosen, other) for other in previous)])
        previous.append(chosen)
    ok = cosine >= gate.min_cosine and max_abs <= gate.max_abs and min_difference >= gate.min_difference
    return ParityResult(gate.inputs, round(cosine, 9), max_abs, float(min_difference), "PASS" if ok else "FAIL")


PRIMARY_OUTPUTS = ("visual_tokens", "logits", "context_values", "trajectory")
