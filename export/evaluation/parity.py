"""Compares a graph with PyTorch: seeded test inputs, PyTorch's outputs, and the distance of the graph's outputs.

Worst cosine, largest difference and agreement of the chosen token; references are kept as safetensors files.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from safetensors.numpy import load_file, save_file

from export.core.tensor_file import replacing
from export.evaluation.task_error import StageOutputs, short
from export.evaluation.task_error import cosine as cosine_of
from export.graphs.action import context_shapes, guidance_input
from export.graphs.language import ROLES, cache_names
from export.model.config import TicVlaConfig
from export.model.network import TicVla

Array = npt.NDArray[Any]
Arrays = dict[str, Array]
RunGraph = Callable[[Arrays], Arrays]

PRIMARY_OUTPUTS = ("visual_tokens", "logits", "last_layer_kv", "context.0.value", "trajectory")
"""Outputs that must differ between two inputs; caches contain their input and would always differ."""


class ParityError(Exception):
    """Outputs that cannot be compared: different shapes, or values that are not finite."""


@dataclass(frozen=True)
class Sample:
    """Test input of a graph and PyTorch's outputs, by tensor name."""

    feeds: dict[str, Array]
    expected: dict[str, Array]
    """Outputs to compare; other outputs of the graph are ignored."""


@dataclass(frozen=True)
class ParityResult:
    """Worst case over all inputs and outputs of one graph."""

    inputs: int
    cosine: float
    max_abs: float
    min_difference: float
    """Minimum over pairs of different inputs of the largest difference of their outputs (negative control)."""
    top1: float | None
    """Share of positions at which the same token is most likely, 0 to 1; None for a graph without tokens."""


def compare(graph: str, samples: Sequence[Sample], run: RunGraph) -> ParityResult:
    """Run a graph on all samples and compare. Raises ParityError, and ValueError for fewer than two samples."""
    if len(samples) < 2:
        raise ValueError(f"{graph}: {len(samples)} samples, expected two or more for the negative control")
    cosine, max_abs, min_difference = 1.0, 0.0, np.inf
    same, tokens = 0, 0
    primary: list[list[Array]] = []
    for sample in samples:
        found = run(sample.feeds)
        for name, expected in sample.expected.items():
            actual = _comparable(graph, name, expected, found)
            if not expected.size:
                continue
            if name == "next_token":
                # An index has no cosine: logits are compared instead, if the graph has them.
                if "logits" not in sample.expected:
                    same, tokens = same + int(np.sum(expected == actual)), tokens + expected.size
                continue
            if name == "logits":
                agree = expected.argmax(axis=-1) == actual.argmax(axis=-1)
                same, tokens = same + int(agree.sum()), tokens + agree.size
            cosine = min(cosine, cosine_of(expected, actual))
            max_abs = max(max_abs, float(np.max(np.abs(expected.astype(np.float64) - actual))))
        chosen = [found[name] for name in PRIMARY_OUTPUTS if name in sample.expected]
        min_difference = min([min_difference, *(_difference(chosen, other) for other in primary)])
        primary.append(chosen)
    return ParityResult(
        inputs=len(samples),
        cosine=round(cosine, 9),
        max_abs=short(max_abs),
        min_difference=short(float(min_difference)),
        top1=round(same / tokens, 6) if tokens else None,
    )


def _comparable(graph: str, name: str, expected: Array, found: Arrays) -> Array:
    if name not in found:
        raise ParityError(f"{graph}: gives no {name!r}")
    actual = found[name]
    if actual.shape != expected.shape:
        raise ParityError(f"{graph}: {name} is {list(actual.shape)}, PyTorch gives {list(expected.shape)}")
    if not np.isfinite(actual).all():
        raise ParityError(f"{graph}: {name} has values that are not finite")
    return actual


def _difference(a: Sequence[Array], b: Sequence[Array]) -> float:
    """Return the largest difference over the part that both runs have (free axes may differ in length)."""
    largest = 0.0
    for x, y in zip(a, b, strict=True):
        cut = tuple(slice(0, min(m, n)) for m, n in zip(x.shape, y.shape, strict=True))
        if all(s.stop > 0 for s in cut):
            largest = max(largest, float(np.max(np.abs(x[cut].astype(np.float64) - y[cut].astype(np.float64)))))
    return largest


def sample_inputs(config: TicVlaConfig, name: str, index: int) -> Arrays:
    """Build the test input number `index` of a graph: seeded, all different, with lengths as in a run."""
    rng = np.random.default_rng([index, 7])
    vision = config.vision

    def normal(*shape: int) -> npt.NDArray[np.float32]:
        return rng.standard_normal(shape).astype(np.float32)

    if name == "vision_encoder":
        # Alternate a smooth picture and noise: a real frame is in between.
        coarse = rng.integers(0, 256, (1, 4, 4, 3)) if index % 2 else rng.integers(0, 256, (1, 64, 64, 3))
        repeat = -(-vision.image_px // coarse.shape[1])
        frame = coarse.repeat(repeat, axis=1).repeat(repeat, axis=2)[:, : vision.image_px, : vision.image_px]
        return {"frame": frame.astype(np.uint8)}
    if name in ROLES:
        return _language_inputs(config, name, index, rng)
    if name == "semantic_context":
        guidance, shape = guidance_input(config)
        return {guidance: normal(*(axis if isinstance(axis, int) else 20 + 17 * index for axis in shape))}
    if name == "action_expert":
        tokens = 20 + 17 * index
        shapes = {
            n: [axis if isinstance(axis, int) else tokens for axis in s] for n, s in context_shapes(config).items()
        }
        return {
            "visual_tokens": normal(1, vision.tokens, vision.token_dim),
            "state": normal(1, 3),
            "latency": np.abs(normal(1, 4)) * np.float32(3),
            **{name: normal(*shape) for name, shape in shapes.items()},
        }
    raise ValueError(f"no test inputs for graph {name!r}")


def _language_inputs(config: TicVlaConfig, name: str, index: int, rng: np.random.Generator) -> Arrays:
    """Build text and frames on empty and filled buffers, a call that begins inside a frame, and a single token."""
    language, role = config.language, ROLES[name]
    frames = index % 3 if role.images else 0
    past = 0 if index % 2 == 0 else int(rng.integers(1, 60))
    ids = rng.integers(0, language.vocab - 1, (1, 3 + index))
    ids += ids >= language.img_context_id
    image = np.full((1, frames * config.frame_tokens), language.img_context_id)
    # The previous call ended inside the frame: this call begins with that frame's remaining tokens.
    skipped = config.frame_tokens // 4 if frames and past else 0
    ids = np.concatenate([ids[:, :2], image[:, skipped:], ids[:, 2:]], axis=1) if index != 3 else ids[:, :1]
    total = past + ids.shape[1]
    shape = (1, language.kv_heads, total, language.head_dim)
    feeds: Arrays = {
        "input_ids": ids,
        "seqlens_k": np.array([total - 1], dtype=np.int32),
        "total_sequence_length": np.array(total, dtype=np.int32),
        # Rows after the past hold an earlier generation's values; the graph must not read them.
        **{n: rng.standard_normal(shape).astype(np.float32) for n in cache_names(language.layers, "past_key_values")},
    }
    if role.images:
        vision = config.vision
        feeds["visual_tokens"] = rng.standard_normal((max(frames, 1), vision.tokens, vision.token_dim), np.float32)
        feeds["image_offset"] = np.array([skipped])
    return feeds


def references(model: TicVla, name: str, count: int) -> list[Sample]:
    """Build `count` different inputs of a graph with PyTorch's outputs in fp32."""
    samples = []
    for index in range(count):
        feeds = sample_inputs(model.config, name, index)
        with torch.no_grad():
            samples.append(Sample(feeds, reference_outputs(model, name, feeds)))
    return samples


def reference_outputs(model: TicVla, name: str, feeds: Arrays) -> Arrays:
    """Compute the network's outputs for a graph's inputs, by the graph's output names."""
    tensors = {key: torch.from_numpy(array) for key, array in feeds.items()}
    if name == "vision_encoder":
        return {"visual_tokens": model.vision(tensors["frame"]).numpy()}
    if name in ROLES:
        return _language_outputs(model, name, feeds)
    layers = range(model.config.action.layers)
    if name == "semantic_context":
        keys, values = model.action.context(tensors[guidance_input(model.config)[0]])
        outputs = {f"context.{i}.key": keys[i].transpose(2, 3).contiguous().numpy() for i in layers}
        return outputs | {f"context.{i}.value": values[i].contiguous().numpy() for i in layers}
    keys = torch.stack([tensors[f"context.{i}.key"].transpose(2, 3) for i in layers])
    values = torch.stack([tensors[f"context.{i}.value"] for i in layers])
    inputs = [tensors[key] for key in ("visual_tokens", "state", "latency")]
    return {"trajectory": model.action(*inputs, keys, values).numpy()}


def _language_outputs(model: TicVla, name: str, feeds: Arrays) -> Arrays:
    config, role = model.config, ROLES[name]
    layers = config.language.layers
    past = int(feeds["total_sequence_length"]) - feeds["input_ids"].shape[1]
    caches = [torch.from_numpy(feeds[n][:, :, :past]) for n in cache_names(layers, "past_key_values")]
    visual = feeds.get("visual_tokens", np.zeros((1, config.vision.tokens, config.vision.token_dim), np.float32))
    offset = int(feeds["image_offset"][0]) if "image_offset" in feeds else 0
    next_token, logits, last_layer_kv, *present = model.language(
        torch.from_numpy(feeds["input_ids"]), torch.from_numpy(visual), caches, image_offset=offset
    )
    outputs = {"last_layer_kv": last_layer_kv.numpy()}
    outputs |= {n: t.numpy() for n, t in zip(cache_names(layers, "present"), present, strict=True)}
    return {"next_token": next_token.numpy(), "logits": logits.numpy(), **outputs} if role.token else outputs


def save_samples(samples: Sequence[Sample], path: Path) -> None:
    """Write test inputs and expected outputs to a safetensors file. Raises OSError."""
    tensors = {
        f"{index}/{kind}/{name}": np.ascontiguousarray(array)
        for index, sample in enumerate(samples)
        for kind, arrays in (("feed", sample.feeds), ("expected", sample.expected))
        for name, array in arrays.items()
    }
    with replacing(path) as partial:
        save_file(tensors, partial)


def load_samples(path: Path) -> list[Sample]:
    """Read what `save_samples` wrote."""
    samples: dict[int, Sample] = {}
    for key, array in load_file(path).items():
        index, kind, name = key.split("/", 2)
        sample = samples.setdefault(int(index), Sample({}, {}))
        (sample.feeds if kind == "feed" else sample.expected)[name] = array
    return [samples[index] for index in sorted(samples)]


def save_outputs(outputs: StageOutputs, path: Path) -> None:
    """Write the reference outputs for the task error to one safetensors file. Raises OSError."""
    tensors = {
        f"{kind}/{index}": np.ascontiguousarray(array)
        for kind in ("visual", "kv", "trajectories", "swapped")
        for index, array in enumerate(getattr(outputs, kind))
    }
    tensors |= {f"token_ids/{index}": np.array(ids, dtype=np.int64) for index, ids in enumerate(outputs.token_ids)}
    with replacing(path) as partial:
        save_file(tensors, partial)


def load_outputs(path: Path) -> StageOutputs:
    """Read what `save_outputs` wrote."""
    tensors = load_file(path)

    def of(kind: str) -> tuple[Any, ...]:
        count = sum(key.startswith(f"{kind}/") for key in tensors)
        return tuple(tensors[f"{kind}/{index}"] for index in range(count))

    token_ids = tuple(tuple(int(token) for token in ids) for ids in of("token_ids"))
    return StageOutputs(of("visual"), of("kv"), token_ids, of("trajectories"), of("swapped"))
