"""Test inputs of every graph and what PyTorch makes of them: the reference that the gate compares with."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from export.graphs import GraphSpec, past_names
from export.metrics import Sample
from export.model.config import TicVlaConfig
from export.model.network import TicVla

Arrays = dict[str, npt.NDArray[Any]]


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


def references(model: TicVla, spec: GraphSpec, count: int) -> list[Sample]:
    """`count` different inputs of a graph with the outputs of PyTorch in fp32."""
    return [_reference(spec, sample_inputs(model.config, spec.name, index)) for index in range(count)]


def _reference(spec: GraphSpec, feeds: Arrays) -> Sample:
    tensors = {name: torch.from_numpy(array) for name, array in feeds.items()}
    caches = [tensor for name, tensor in tensors.items() if name.startswith("past_key_values")]
    plain = [tensor for name, tensor in tensors.items() if not name.startswith("past_key_values")]
    with torch.no_grad():
        outputs = spec.module(*plain, caches) if caches else spec.module(*plain)
    outputs = outputs if isinstance(outputs, tuple) else (outputs,)
    return Sample(feeds, {name: tensor.numpy() for name, tensor in zip(spec.outputs, outputs, strict=True)})
