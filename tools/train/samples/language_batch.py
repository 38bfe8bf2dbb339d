"""The language model on batches of rows of different length, with the results of `LanguageModel.forward`.

Rows are padded on the right, which causal attention ignores. The last layer's queries and the logits are computed only
at the positions whose next token is needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 - torch's own idiom

from edge.reasoning.decoding_rules import TextConstraint
from edge.reasoning.line_constraint import LineConstraint
from export.model.language import DecoderLayer, LanguageModel, RmsNorm, rotate
from export.model.vision import fold_tokens

IGNORED = -100
"""Target at padded positions (torch's default)."""
PLAIN_TOKENS = 512
"""Longest rows, tokens, with plain attention on a CPU; its memory is quadratic in the length."""
EVEN = 8
"""Rows are padded to a multiple of this, tokens: a CPU multiplies 191 of them in twice the time of 192."""
POOL = 32
"""Batches that are sorted by length together: a compromise between little padding and random order."""

Halves = npt.NDArray[np.float16]


class FrameRows(Protocol):
    """Visual tokens by frame."""

    def __getitem__(self, k: int, /) -> Halves:
        """f16 [tokens, D] of frame k."""


class FrameTokens(Protocol):
    """Visual tokens of recorded frames, encoded once."""

    def frames(self, drive_id: str) -> FrameRows:
        """f16 [N, tokens, D] of all frames of a drive, mapped from a file."""


def frames_of(tokens: FrameTokens, drive_id: str, frames: Sequence[int]) -> tuple[Halves, ...]:
    """Return the tokens [tokens, D] of some frames of a drive."""
    every = tokens.frames(drive_id)
    return tuple(every[k] for k in frames)


@dataclass(frozen=True)
class Row:
    """One prompt, its answer with the end token (may be empty), and its frames' tokens [N, D], in order."""

    prompt: tuple[int, ...]
    answer: tuple[int, ...]
    frames: tuple[Halves, ...]

    def __post_init__(self) -> None:
        if not self.prompt or not self.frames:
            raise ValueError("a row needs a prompt and at least one frame")

    @property
    def fed(self) -> tuple[int, ...]:
        """Input tokens: all but the answer's last one, after which there is nothing to predict."""
        return (*self.prompt, *self.answer[:-1])


@dataclass(frozen=True)
class LanguageBatch:
    """Rows on a device. A: length of the longest answer; a row without answer needs the token after its prompt."""

    input_ids: Tensor
    """[B, T] int64, zeros on the right."""
    lengths: Tensor
    """[B] int64: number of real tokens in each row."""
    visual_tokens: Tensor
    """[F, N, D] float: the frames of all rows, in their order."""
    query_at: Tensor
    """[B, A] int64: positions whose next token is needed; the last one is repeated."""
    targets: Tensor
    """[B, A] int64: that token; IGNORED behind a row's answer."""


@dataclass(frozen=True)
class Pass:
    """Results of one forward pass."""

    hidden: Tensor | None
    """[B, A, hidden] after the final norm, at `query_at`; None if not requested."""
    last_layer_kv: Tensor
    """[B, T, kv_dim], in the layout of `LanguageModel`'s own; rows are real up to their length."""
    caches: tuple[tuple[Tensor, Tensor], ...]
    """(keys, values) of every layer, [B, kv_heads, T, head_dim]."""


def collate(rows: Sequence[Row], *, img_context_id: int, device: torch.device) -> LanguageBatch:
    """Pad rows to a batch. Raises ValueError if the image positions of a row do not fit its frames."""
    length = -(-max(len(row.fed) for row in rows) // EVEN) * EVEN
    wanted = max(1, max(len(row.answer) for row in rows))
    ids = np.zeros((len(rows), length), dtype=np.int64)
    query_at = np.zeros((len(rows), wanted), dtype=np.int64)
    targets = np.full((len(rows), wanted), IGNORED, dtype=np.int64)
    check_places(rows, img_context_id)
    for i, row in enumerate(rows):
        fed = row.fed
        ids[i, : len(fed)] = fed
        query_at[i] = np.minimum(len(row.prompt) - 1 + np.arange(wanted), len(fed) - 1)
        targets[i, : len(row.answer)] = row.answer
    frames = np.stack([frame for row in rows for frame in row.frames])
    return LanguageBatch(
        input_ids=torch.from_numpy(ids).to(device),
        lengths=torch.tensor([len(row.fed) for row in rows], device=device),
        visual_tokens=torch.from_numpy(frames).to(device).float(),
        query_at=torch.from_numpy(query_at).to(device),
        targets=torch.from_numpy(targets).to(device),
    )


def check_places(rows: Sequence[Row], img_context_id: int) -> None:
    """Raise ValueError unless all frames have the same number of image positions, at least one."""
    found = {divmod(row.prompt.count(img_context_id), len(row.frames)) for row in rows}
    if len(found) != 1 or any(left or not places for places, left in found):
        raise ValueError(f"expected as many image places for every frame, found (places, left over) {sorted(found)}")


def embed(language: LanguageModel, input_ids: Tensor, visual_tokens: Tensor) -> Tensor:
    """Compute the input embeddings [B, T, hidden], with the frames' merged tokens at the image positions."""
    images = language.merge(fold_tokens(visual_tokens, language.config.token_merge))
    x: Tensor = language.embed(input_ids)
    is_image = input_ids == language.config.img_context_id
    return x.masked_scatter(is_image[..., None], images.reshape(-1, x.shape[-1]).to(x.dtype))


def angles(language: LanguageModel, positions: Tensor) -> tuple[Tensor, Tensor]:
    """Compute rotary cosines and sines [..., head_dim] of positions [...]."""
    angle = positions.float()[..., None] * language.inv_freq
    angle = torch.cat([angle, angle], dim=-1)
    return angle.cos(), angle.sin()


def heads_of(x: Tensor, heads: int) -> Tensor:
    """Reshape [B, T, heads·d] to [B, heads, T, d]."""
    split: Tensor = x.unflatten(-1, (heads, -1))
    return split.transpose(1, 2)


def keys_values(layer: DecoderLayer, h: Tensor, cos: Tensor, sin: Tensor) -> tuple[Tensor, Tensor]:
    """Compute rotated keys and values [B, kv_heads, T, d] of normalised inputs [B, T, hidden]."""
    v = heads_of(layer.v(h), layer.config.kv_heads)
    return rotate(heads_of(layer.k(h), layer.config.kv_heads), cos, sin).to(v.dtype), v


def normed(norm: RmsNorm, x: Tensor) -> Tensor:
    """Apply a norm and convert its output once to the dtype of the following layers."""
    # torch's own returns the same values; with gradients it takes 4.9 instead of 8.6 ms for 16 rows of 192 tokens.
    h = F.rms_norm(x, norm.weight.shape, norm.weight, norm.eps)
    kind = x.device.type
    return h.to(torch.get_autocast_dtype(kind)) if torch.is_autocast_enabled(kind) else h


def attend(q: Tensor, k: Tensor, v: Tensor, mask: Tensor | None) -> Tensor:
    """Compute attention [B, heads, Q, d] with a mask of what may be read, or causal at all positions without one.

    `k`, `v` [B, kv_heads, T, d]: each is read by heads / kv_heads heads. `mask` bool, [Q, T] or [B, 1, Q, T]. For short
    rows on a CPU, plain products take half the time of torch's attention, forward and backward.
    """
    groups = q.shape[1] // k.shape[1]
    if q.device.type != "cpu" or k.shape[-2] > PLAIN_TOKENS:
        k, v = k.repeat_interleave(groups, dim=1), v.repeat_interleave(groups, dim=1)
        return F.scaled_dot_product_attention(q, k, v, attn_mask=mask, is_causal=mask is None)
    if mask is None:
        mask = torch.ones(q.shape[-2], k.shape[-2], dtype=torch.bool).tril()
    hidden = torch.zeros(mask.shape, dtype=q.dtype).masked_fill_(~mask, -torch.inf)
    # Heads that read the same keys are rows of one product.
    rows = (q * q.shape[-1] ** -0.5).unflatten(1, (-1, groups)).flatten(2, 3)
    # The backward pass of an addition copies nothing; that of masked_fill makes another pass.
    scores = (rows @ k.transpose(-1, -2)).add_(torch.cat([hidden] * groups, dim=-2))
    # Inside, softmax computes in float32 also for bfloat16 scores.
    weights: Tensor = scores.softmax(-1)
    attended: Tensor = (weights.to(v.dtype) @ v).unflatten(2, (groups, -1))
    return attended.flatten(1, 2)


def finish_layer(
    layer: DecoderLayer, x: Tensor, h: Tensor, cos: Tensor, sin: Tensor, k: Tensor, v: Tensor, mask: Tensor | None
) -> Tensor:
    """Compute the layer's output at queries x [B, Q, hidden] (h: normalised); without mask causal, at all positions."""
    q = rotate(heads_of(layer.q(h), layer.config.heads), cos, sin).to(v.dtype)
    x = x + layer.o(attend(q, k, v, mask).transpose(1, 2).flatten(2))
    h = normed(layer.mlp_norm, x)
    out: Tensor = x + layer.down(F.silu(layer.gate(h)) * layer.up(h))
    return out


def run(language: LanguageModel, input_ids: Tensor, visual_tokens: Tensor, query_at: Tensor | None) -> Pass:
    """Run all rows through all layers; the last one only at `query_at` [B, A] (None: only its keys and values)."""
    x = embed(language, input_ids, visual_tokens)
    position = torch.arange(input_ids.shape[1], device=input_ids.device)
    cos, sin = angles(language, position)
    caches: list[tuple[Tensor, Tensor]] = []
    *earlier, last = language.layers
    for layer in earlier:
        h = normed(layer.input_norm, x)
        k, v = keys_values(layer, h, cos, sin)
        caches.append((k, v))
        x = finish_layer(layer, x, h, cos, sin, k, v, None)
    h = normed(last.input_norm, x)
    k, v = keys_values(last, h, cos, sin)
    caches.append((k, v))
    kv = torch.cat([k.transpose(1, 2).flatten(2), v.transpose(1, 2).flatten(2)], dim=-1)
    if query_at is None:
        return Pass(None, kv, tuple(caches))
    chosen = query_at[..., None].expand(-1, -1, x.shape[-1])
    x, h = x.gather(1, chosen), h.gather(1, chosen)
    cos, sin = angles(language, query_at)
    mask = (position <= query_at[..., None])[:, None]
    x = finish_layer(last, x, h, cos[:, None], sin[:, None], k, v, mask)
    return Pass(language.norm(x), kv, tuple(caches))


def token_losses(language: LanguageModel, batch: LanguageBatch) -> Tensor:
    """Compute -log p of every answer token [B, A], zero behind a row's answer (terms of the paper's equation 3)."""
    hidden = run(language, batch.input_ids, batch.visual_tokens, batch.query_at).hidden
    assert hidden is not None
    logits = language.lm_head(hidden).float()
    return F.cross_entropy(logits.flatten(0, 1), batch.targets.flatten(), reduction="none").view_as(batch.targets)


def row_losses(language: LanguageModel, batch: LanguageBatch) -> Tensor:
    """Compute equation 3 for each row [B]: the mean over its answer's tokens."""
    count = (batch.targets != IGNORED).sum(1).clamp(min=1)
    return token_losses(language, batch).sum(1) / count


def buckets(lengths: Sequence[int], size: int, rng: np.random.Generator) -> list[list[int]]:
    """Return shuffled batches of at most `size` indices of similar length; every index occurs once."""
    order = rng.permutation(len(lengths))
    batches: list[list[int]] = []
    for start in range(0, len(order), size * POOL):
        pool = sorted((int(i) for i in order[start : start + size * POOL]), key=lambda i: (lengths[i], i))
        batches += [pool[at : at + size] for at in range(0, len(pool), size)]
    return [batches[int(i)] for i in rng.permutation(len(batches))]


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
