"""The action expert on batches of frames that share semantic states, with the results of `ActionExpert.forward`.

A semantic state costs more than the rest of a sample, so frames with the same state share its keys and values. States
of different length are padded on the left and the padding is masked, which does not change a row's result. Dropout
masks are part of the batch, so that a sample is the same in every batch, process and resumed run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 - torch's own idiom

from export.model.action import ActionExpert
from export.model.attention import CrossAttentionLayer, KeyValue
from export.model.heads import integrated

Array = NDArray[np.float32]


@dataclass(frozen=True)
class Around:
    """Walls around the robot in g frames (`tools.train.drives.walls`), ground truth that no policy receives.

    `patches` f16 [g, rows, columns], clearance in m; `body` f32 [g, 2], reach and radius in m.
    """

    patches: NDArray[np.float16]
    body: Array


@dataclass(frozen=True)
class Group:
    """g frames of one drive that share one semantic state.

    - `visual_tokens` f16 [g, N, D]; `state` [g, 3] vx m/s, vy m/s, wz rad/s; `latency` [g, 4] Δt s, Δx m, Δy m, Δθ rad.
    - `guidance`: shared K‖V [1, T, kv_dim], or waypoints [g, 3, 2] m, each in its robot frame.
    - `goal` [g, 2] m in the robot frame, for point-goal policies alone.
    - `keep_guidance` [1 or g, T] and `keep_state` [g]: False where dropout removes a token.
    - Label: `target` [g, steps, 3] x m, y m, theta rad (not wrapped) in the robot frame; `known` [g, steps].
    """

    visual_tokens: NDArray[np.float16]
    state: Array
    latency: Array
    guidance: NDArray[np.floating]
    goal: Array
    keep_guidance: NDArray[np.bool_]
    keep_state: NDArray[np.bool_]
    target: Array
    known: NDArray[np.bool_]
    around: Around | None = None
    """Walls, if the loss uses them."""


@dataclass(frozen=True)
class ActionBatch:
    """Groups of equal size on a device, B frames in total; fields as in `Group`, [B] for [g], with padded guidance."""

    visual_tokens: Tensor
    state: Tensor
    latency: Tensor
    guidance: Tensor
    """[S, T, width] float, zeros at padded tokens on the left; B is a multiple of S."""
    real: Tensor
    """[S, T] bool: tokens of `guidance` that are not padding."""
    goal: Tensor
    keep_guidance: Tensor
    keep_state: Tensor
    target: Tensor
    known: Tensor
    around: tuple[Tensor, Tensor] | None = None
    """Patches and bodies, if the groups have walls."""

    def __len__(self) -> int:
        return len(self.state)


def collate(groups: Sequence[Group], device: torch.device) -> ActionBatch:
    """Combine groups of equal size g; frame i of group j is row j g + i. Raises ValueError for mixed walls."""
    longest = max(group.guidance.shape[1] for group in groups)

    def joined(name: str) -> Tensor:
        return torch.from_numpy(np.concatenate([getattr(group, name) for group in groups])).to(device)

    def padded(name: str) -> Tensor:
        arrays = [getattr(group, name) for group in groups]
        rows = sum(len(array) for array in arrays)
        whole = np.zeros((rows, longest, *arrays[0].shape[2:]), arrays[0].dtype)
        at = 0
        for array in arrays:
            whole[at : at + len(array), longest - array.shape[1] :] = array
            at += len(array)
        return torch.from_numpy(whole).to(device)

    near = [group.around for group in groups if group.around is not None]
    if len(near) not in (0, len(groups)):
        raise ValueError("expected walls around all groups of a batch or around none")
    lengths = torch.tensor([group.guidance.shape[1] for group in groups for _ in group.guidance], device=device)
    return ActionBatch(
        visual_tokens=joined("visual_tokens").float(),
        state=joined("state"),
        latency=joined("latency"),
        guidance=padded("guidance").float(),
        real=torch.arange(longest, device=device) >= longest - lengths[:, None],
        goal=joined("goal"),
        keep_guidance=padded("keep_guidance"),
        keep_state=joined("keep_state"),
        target=joined("target"),
        known=joined("known"),
        around=_around(near, device) if near else None,
    )


def _around(near: Sequence[Around], device: torch.device) -> tuple[Tensor, Tensor]:
    patches, body = (np.concatenate([getattr(each, name) for each in near]) for name in ("patches", "body"))
    return torch.from_numpy(patches).to(device).float(), torch.from_numpy(body).to(device)


@dataclass(frozen=True)
class SharedTrunk:
    """`export.model.action.Trunk` with S semantic states, each shared by B/S consecutive frames."""

    layers: tuple[CrossAttentionLayer, ...]
    key_values: tuple[KeyValue, ...]
    now: tuple[tuple[Tensor, Tensor], ...]
    """Keys and values of each layer for frame, state and latency, [B, heads, N + 2, d]."""
    semantic: tuple[tuple[Tensor, Tensor], ...]
    """Keys and values of each layer for the semantic states, [S, heads, T, d]."""
    real: Tensor
    """[S, T] bool, False at padding."""

    @property
    def batch(self) -> int:
        """Number of frames B."""
        return len(self.now[0][0])

    def __call__(self, x: Tensor, *, among: bool = False) -> Tensor:
        """Run tokens [B, steps, hidden] through all layers; with `among` they also attend to one another."""
        for layer, key_value, now, semantic in zip(self.layers, self.key_values, self.now, self.semantic, strict=True):
            if among:
                own = key_value(layer.norm1(x))
                now = (torch.cat([now[0], own[0]], dim=2), torch.cat([now[1], own[1]], dim=2))
            x = _layer(layer, x, now, semantic, self.real)
        return x


def trunk(action: ActionExpert, batch: ActionBatch) -> SharedTrunk:
    """Prepare the network's layers for a batch. Raises ValueError unless the network is in evaluation mode."""
    if action.training:
        raise ValueError("expected the action expert in evaluation mode: dropout masks come with the batch")
    semantic = action.semantic_tokens(batch.guidance) * batch.keep_guidance[..., None]
    now = action.now_tokens(batch.visual_tokens, batch.state, batch.latency)
    # The last two are the robot's state and the latency.
    now = torch.cat([now[:, :-2], now[:, -2:-1] * batch.keep_state[:, None, None], now[:, -1:]], dim=1)
    key_values = tuple(action.key_values)
    return SharedTrunk(
        layers=tuple(action.layers),
        key_values=key_values,
        now=tuple(key_value(now) for key_value in key_values),
        semantic=tuple(key_value(semantic) for key_value in key_values),
        real=batch.real,
    )


def plan(action: ActionExpert, batch: ActionBatch) -> Tensor:
    """Compute trajectories [B, steps, 3] (x m, y m, theta rad), each in its robot frame."""
    layers = trunk(action, batch)
    if action.config.action.head != "query":
        return action.plan(layers)
    found = action.head(action.norm(layers(action.queries.expand(len(batch), -1, -1))))
    # Sum in float32: thirty steps in bfloat16 would accumulate centimetres of error.
    return integrated(action.out(found).float(), action.config.action.parameterisation)


def errors(action: ActionExpert, batch: ActionBatch, generator: torch.Generator) -> Tensor:
    """Compute the objective of a head other than `query` for every frame [B]."""
    terms = action.errors(trunk(action, batch), batch.target, generator)
    return (terms.sum(-1) * batch.known).mean(1)


def _layer(
    layer: CrossAttentionLayer, x: Tensor, now: tuple[Tensor, Tensor], semantic: tuple[Tensor, Tensor], real: Tensor
) -> Tensor:
    """Compute `CrossAttentionLayer.forward` with keys and values of S states, each shared by B/S frames."""
    batch, steps, _ = x.shape
    states, heads, tokens, width = semantic[0].shape
    share = batch // states
    q = layer.q(layer.norm1(x)).unflatten(-1, (heads, width)).transpose(1, 2) * width**-0.5
    q_shared = _shared(q, share)
    scores_now = _shared(q @ now[0].transpose(2, 3), share)
    # The backward pass of an addition copies nothing; that of masked_fill makes another pass.
    padding = torch.zeros_like(real, dtype=q.dtype).masked_fill_(~real, float("-inf"))[:, None, None]
    scores = (q_shared @ semantic[0].transpose(2, 3)).add_(padding)
    # Inside, softmax computes in float32 also for bfloat16 scores.
    weights = torch.softmax(torch.cat([scores_now, scores], dim=-1), dim=-1).to(q.dtype)
    at_now, at_semantic = weights.split([now[0].shape[2], tokens], dim=-1)
    seen = _own(at_now, share) @ now[1]
    meant = _own(at_semantic @ semantic[1], share)
    attended = (seen + meant).transpose(1, 2).reshape(batch, steps, heads * width)
    x = x + layer.o(attended)
    out: Tensor = x + layer.fc2(F.gelu(layer.fc1(layer.norm2(x))))
    return out


def _shared(x: Tensor, share: int) -> Tensor:
    """Reshape [S·share, heads, steps, d] to [S, heads, share·steps, d]: frames of a state as rows of one product."""
    rows: Tensor = x.unflatten(0, (-1, share))
    return rows.transpose(1, 2).flatten(2, 3)


def _own(x: Tensor, share: int) -> Tensor:
    """Invert `_shared`."""
    rows: Tensor = x.unflatten(2, (share, -1))
    return rows.transpose(1, 2).flatten(0, 1)


def smooth_l1(planned: Tensor, batch: ActionBatch, *, beta: float, heading_weight: float) -> Tensor:
    """Compute equation 4 for every frame [B]; unknown steps have no error, heading errors are weighted."""
    terms = F.smooth_l1_loss(planned.float(), batch.target, reduction="none", beta=beta)
    terms = terms * terms.new_tensor([1.0, 1.0, heading_weight])
    return (terms.sum(-1) * batch.known).mean(1)
