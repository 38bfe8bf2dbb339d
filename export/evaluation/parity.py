"""Test inputs of every graph and what PyTorch makes of them: the reference that the gate compares with."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from export.evaluation.metrics import Sample
from export.graphs.action import context_shapes, guidance_input
from export.graphs.language import ROLES, cache_names
from export.model.config import TicVlaConfig
from export.model.network import TicVla

Arrays = dict[str, npt.NDArray[Any]]


def sample_inputs(config: TicVlaConfig, name: str, index: int) -> Arrays:
    """The `index`-th test input of a graph: seeded, all different, with the lengths a run meets."""
    rng = np.random.default_rng([index, 7])
    vision = config.vision

    def normal(*shape: int) -> npt.NDArray[np.float32]:
        return rng.standard_normal(shape).astype(np.float32)

    if name == "vision_encoder":
        # A smooth picture and noise in turn: a frame is neither flat nor white.
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
    """Text and frames on empty and on filled buffers; a call that begins inside a frame; a single token."""
    language, role = config.language, ROLES[name]
    frames = index % 3 if role.images else 0
    past = 0 if index % 2 == 0 else int(rng.integers(1, 60))
    ids = rng.integers(0, language.vocab - 1, (1, 3 + index))
    ids += ids >= language.img_context_id
    image = np.full((1, frames * config.frame_tokens), language.img_context_id)
    # The call before this one ended inside the frame: the places here begin with that frame's later tokens.
    skipped = config.frame_tokens // 4 if frames and past else 0
    ids = np.concatenate([ids[:, :2], image[:, skipped:], ids[:, 2:]], axis=1) if index != 3 else ids[:, :1]
    total = past + ids.shape[1]
    shape = (1, language.kv_heads, total, language.head_dim)
    feeds: Arrays = {
        "input_ids": ids,
        "seqlens_k": np.array([total - 1], dtype=np.int32),
        "total_sequence_length": np.array(total, dtype=np.int32),
        # Rows after the past hold what an earlier generation left there; they must not be read.
        **{n: rng.standard_normal(shape).astype(np.float32) for n in cache_names(language.layers, "past_key_values")},
    }
    if role.images:
        vision = config.vision
        feeds["visual_tokens"] = rng.standard_normal((max(frames, 1), vision.tokens, vision.token_dim), np.float32)
        feeds["image_offset"] = np.array([skipped])
    return feeds


def references(model: TicVla, name: str, count: int) -> list[Sample]:
    """`count` different inputs of a graph with the outputs of PyTorch in fp32."""
    samples = []
    for index in range(count):
        feeds = sample_inputs(model.config, name, index)
        with torch.no_grad():
            samples.append(Sample(feeds, reference_outputs(model, name, feeds)))
    return samples


def reference_outputs(model: TicVla, name: str, feeds: Arrays) -> Arrays:
    """What the network computes for a graph's inputs, by the graph's output names."""
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
