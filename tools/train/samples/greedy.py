"""Greedy decoding of many prompts at once, with the keys and values of each row; the same loop as the runner's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 - torch's own idiom

from edge.reasoning.decoding_rules import LineConstraint, TextConstraint
from export.model.language import LanguageModel
from tools.train.samples.language_batch import LanguageBatch, angles, finish_layer, keys_values, run

Constraint: TypeAlias = LineConstraint | TextConstraint


@dataclass(frozen=True)
class DecodeResult:
    """Decoded tokens of one row, and its keys and values."""

    ids: tuple[int, ...]
    """New tokens, without the one that ends the text."""
    last_layer_kv: Tensor
    """[T, kv_dim] float32 of prompt and new tokens, as `edge.inference.language.Generation` has it; on the model's
    device."""


@torch.no_grad()
def decode(
    language: LanguageModel, batch: LanguageBatch, max_new_tokens: int, constraints: Sequence[Constraint | None] = ()
) -> list[DecodeResult]:
    """Decode each row of a batch of prompts greedily, within the row's constraint.

    Each step feeds one token per row at that row's position. A row that has ended is fed until all have ended; its
    further tokens are ignored.
    """
    c, lengths = language.config, batch.lengths
    rows, prompt = batch.input_ids.shape
    fed: list[int] = lengths.tolist()
    room = min(max_new_tokens, c.max_context - min(fed))
    first = run(language, batch.input_ids, batch.visual_tokens, (lengths - 1)[:, None])
    assert first.hidden is not None
    # Behind a row's prompt is padding; it is overwritten before any position attends to it.
    caches = [(F.pad(k, (0, 0, 0, room)), F.pad(v, (0, 0, 0, room))) for k, v in first.caches]
    token = language.lm_head(first.hidden[:, 0]).argmax(-1)
    places = torch.arange(prompt + room, device=token.device)
    each = torch.arange(rows, device=token.device)
    ids: list[list[int]] = [[] for _ in range(rows)]
    open_rows = [max_new_tokens > 0] * rows
    for step in range(room):
        ids_now = [
            chosen if constraint is None else constraint.choose(chosen)
            for chosen, constraint in zip(token.tolist(), constraints or [None] * rows, strict=True)
        ]
        token = torch.tensor(ids_now, device=token.device)
        for i, chosen in enumerate(ids_now):
            if chosen == c.im_end_id or fed[i] + step >= c.max_context:
                open_rows[i] = False
            elif open_rows[i]:
                ids[i].append(chosen)
        if not any(open_rows):
            break
        position = lengths + step
        cos, sin = angles(language, position[:, None])
        cos, sin = cos[:, None], sin[:, None]
        mask = (places <= position[:, None])[:, None, None]
        x = language.embed(token[:, None])
        for layer, (k, v) in zip(language.layers, caches, strict=True):
            h = layer.input_norm(x)
            k_new, v_new = keys_values(layer, h, cos, sin)
            k[each, :, position] = k_new[:, :, 0]
            v[each, :, position] = v_new[:, :, 0]
            x = finish_layer(layer, x, h, cos, sin, k, v, mask)
        token = language.lm_head(language.norm(x)[:, 0]).argmax(-1)
    k, v = caches[-1]
    kv = torch.cat([k.transpose(1, 2).flatten(2), v.transpose(1, 2).flatten(2)], dim=-1).float()
    return [DecodeResult(tuple(ids[i]), kv[i, : fed[i] + len(ids[i])].clone()) for i in range(rows)]
