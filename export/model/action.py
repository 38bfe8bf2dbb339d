"""Action expert: learned queries cross-attend to the present (frame, state) and a delayed semantic state (Fig. 3a).

The part that depends on the semantic state alone runs once a generation: it projects the VLM's tokens to every layer's
keys and values. The rest runs in every tick. Keys and values are linear maps of each token, so the split is exact.
Waypoints are first transformed to the robot's current frame (paper appendix C), so their context of three tokens is
computed in every tick.

The head turns the queries into actions: `query` reads the actions directly; `diffusion` and `flow` are in
`export.model.heads`. A diffusion's layers also attend to the chunk's tokens, with the projections of the present:
otherwise each step would be denoised without its neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 - torch's own idiom

from export.model.attention import CrossAttentionLayer, KeyValue, TypedModuleList, projection
from export.model.config import TicVlaConfig
from export.model.heads import ActionScale, Diffusion, Flow, differentiated, drawn, integrated, wrapped


class TrunkLayers(Protocol):
    """Interface of the cross-attention layers over B instants."""

    @property
    def batch(self) -> int: ...

    def __call__(self, x: Tensor, *, among: bool = False) -> Tensor: ...


@dataclass(frozen=True)
class Trunk:
    """Cross-attention layers with the keys and values of B instants, computed once for all passes."""

    layers: tuple[CrossAttentionLayer, ...]
    key_values: tuple[KeyValue, ...]
    keys: tuple[Tensor, ...]
    """Keys and values of each layer, present before semantics: [B, heads, N + 2 + T, d]."""
    values: tuple[Tensor, ...]
    mask: Tensor | None
    """[B, 1, 1, N + 2 + T] bool, False at padding; None without padding."""

    @property
    def batch(self) -> int:
        """B."""
        return len(self.keys[0])

    def __call__(self, x: Tensor, *, among: bool = False) -> Tensor:
        """Pass tokens [B, S, hidden] through all layers; with `among` they also attend to one another."""
        mask = self.mask
        if among and mask is not None:
            mask = torch.cat([mask, mask.new_ones(*mask.shape[:-1], x.shape[1])], dim=-1)
        for layer, key_value, keys, values in zip(self.layers, self.key_values, self.keys, self.values, strict=True):
            if among:
                own_keys, own_values = key_value(layer.norm1(x))
                keys, values = torch.cat([keys, own_keys], dim=2), torch.cat([values, own_values], dim=2)
            x = layer(x, keys, values, mask)
        return x


class ActionExpert(nn.Module):
    """π(S_{t−Δt}, x_t, s_t, Δt, Δp) of equation 1."""

    def __init__(self, config: TicVlaConfig) -> None:
        super().__init__()
        self.config = config
        c = config.action
        self.semantic_projection = projection(config.guidance_width, c.hidden)
        self.semantic_position = nn.Parameter(torch.zeros(1, config.guidance_tokens, c.hidden))
        self.visual_projection = projection(config.vision.token_dim, c.hidden)
        self.visual_position = nn.Parameter(torch.zeros(1, config.vision.tokens, c.hidden))
        self.state_projection = projection(3, c.hidden)
        self.latency_projection = projection(4, c.hidden)
        self.metadata_position = nn.Parameter(torch.zeros(1, 2, c.hidden))
        self.queries = nn.Parameter(torch.zeros(1, c.steps, c.hidden))
        self.key_values = TypedModuleList(KeyValue(c.hidden, c.heads) for _ in range(c.layers))
        self.layers = TypedModuleList(CrossAttentionLayer(c.hidden, c.heads, c.ffn) for _ in range(c.layers))
        self.norm = nn.LayerNorm(c.hidden)
        self.head = projection(c.hidden, c.hidden)
        self.scale = None if c.head == "query" else ActionScale(c)
        self.diffusion = Diffusion(c) if c.head == "diffusion" else None
        self.flow = Flow(c) if c.head == "flow" else None
        if self.flow is None:
            self.out = nn.Linear(c.hidden, 3)

    def start(self, generator: torch.Generator) -> None:
        """Initialise the output near a slow walk straight ahead, and fill the head's buffers."""
        with torch.no_grad():
            if self.scale is None:
                self.out.bias.copy_(torch.tensor(self.config.action.initial_step))
            else:
                self.scale.start()
            if self.diffusion is not None:
                self.diffusion.start(generator)
            if self.flow is not None:
                self.flow.start()

    def fit_actions(self, trajectories: Tensor, known: Tensor | None = None) -> None:
        """Fit the action scale to a data set's trajectories [N, steps, 3], valid where `known` [N, steps].

        No effect for the query head, which has no scale. Raises ValueError if a step is never valid.
        """
        if self.scale is not None:
            self.scale.fit(differentiated(trajectories, self.config.action.parameterisation), known)

    def semantic_tokens(self, guidance: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Project last-layer K‖V [B, T, kv_dim] or waypoints [B, 3, 2] (m, current robot frame) to [B, T, hidden].

        States of different lengths are padded on the left: positions count from the end, so the answer's last line, the
        waypoints, always has the same positions. In training, `generator` (else torch's own) draws the dropout.
        """
        interface = self.config.action.semantic_interface
        if interface == "values-only":
            guidance = guidance[..., self.config.kv_dim // 2 :]
        places = self.semantic_position[:, self.semantic_position.shape[1] - guidance.shape[1] :]
        tokens: Tensor = self.semantic_projection(guidance) + places
        if self.training and interface != "waypoints":
            # Drop whole K‖V tokens (paper: token dropout 0.1), so that the expert tolerates missing semantics.
            chance = drawn(torch.rand, tuple(tokens.shape[:2]), tokens.device, generator)
            tokens = tokens * (chance >= self.config.action.kv_dropout)[..., None]
        return tokens

    def context(self, guidance: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        """Compute the semantic context: keys and values [layers, B, heads, T, hidden/heads] of the semantic tokens."""
        return self.context_of(self.semantic_tokens(guidance, generator))

    def context_of(self, tokens: Tensor) -> tuple[Tensor, Tensor]:
        """Compute keys and values [layers, B, heads, T, hidden/heads] of semantic tokens [B, T, hidden]."""
        pairs = [kv(tokens) for kv in self.key_values]
        return torch.stack([k for k, _ in pairs]), torch.stack([v for _, v in pairs])

    def now_tokens(
        self, visual_tokens: Tensor, state: Tensor, latency: Tensor, generator: torch.Generator | None = None
    ) -> Tensor:
        """Compute tokens of the present [B, N + 2, hidden]: frame, state (vx, vy, ωz), latency (Δt, Δx, Δy, Δθ)."""
        c = self.config.action
        visual = self.visual_projection(visual_tokens) + self.visual_position
        if not c.latency_aware:
            latency = torch.zeros_like(latency)
        elif not c.motion_offset:
            latency = latency * latency.new_tensor([1.0, 0.0, 0.0, 0.0])
        metadata = torch.stack([self.state_projection(state), self.latency_projection(latency)], dim=1)
        metadata = metadata + self.metadata_position
        if self.training:
            keep = drawn(torch.rand, (metadata.shape[0], 1, 1), metadata.device, generator) >= c.state_dropout
            metadata = torch.cat([metadata[:, :1] * keep, metadata[:, 1:]], dim=1)
        return torch.cat([visual, metadata], dim=1)

    def trunk(
        self, now: Tensor, context_keys: Tensor, context_values: Tensor, context_mask: Tensor | None = None
    ) -> Trunk:
        """Build the layers over the present [B, N + 2, hidden] and the semantic context of S states, S a divisor of B.

        B/S consecutive instants use the same semantic state. `context_mask` [S, T] is False at padding.
        """
        keys, values = [], []
        share = len(now) // context_keys.shape[1]
        for i, key_value in enumerate(self.key_values):
            now_keys, now_values = key_value(now)
            keys.append(torch.cat([now_keys, _shared(context_keys[i], share)], dim=2))
            values.append(torch.cat([now_values, _shared(context_values[i], share)], dim=2))
        mask = None
        if context_mask is not None:
            known = _shared(context_mask.bool(), share)
            mask = torch.cat([known.new_ones(now.shape[:2]), known], dim=1)[:, None, None]
        return Trunk(tuple(self.layers), tuple(self.key_values), tuple(keys), tuple(values), mask)

    def forward(
        self,
        visual_tokens: Tensor,
        state: Tensor,
        latency: Tensor,
        context_keys: Tensor,
        context_values: Tensor,
        context_mask: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> Tensor:
        """Plan a trajectory [B, steps, 3] (x m, y m, θ rad) in the current robot frame."""
        now = self.now_tokens(visual_tokens, state, latency, generator)
        return self.plan(self.trunk(now, context_keys, context_values, context_mask))

    def plan(self, trunk: TrunkLayers) -> Tensor:
        """Plan a trajectory [B, steps, 3]; a generative head returns the point that `heads` explains."""
        if self.scale is None:
            actions = self.out(self._features(trunk))
        elif self.flow is not None:
            actions = self.scale(self.flow.sample(self._features(trunk)))
        else:
            assert self.diffusion is not None
            clean = self.diffusion.sample(lambda noisy, times: self._denoised(noisy, times, trunk), trunk.batch)
            actions = self.scale(clean)
        return integrated(actions, self.config.action.parameterisation)

    def errors(self, trunk: TrunkLayers, target: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Return the loss per number [B, steps, 3] for driven trajectories `target` [B, steps, 3].

        query: smooth L1 of the integrated poses (equation 4); diffusion: squared error of the clean normalised actions
        at a noise level drawn by `generator`; flow: −log p of the normalised actions. Raises ValueError.
        """
        c = self.config.action
        if target.shape != (trunk.batch, c.steps, 3):
            raise ValueError(f"target is {list(target.shape)}, expected {[trunk.batch, c.steps, 3]}")
        target = target.float()
        if self.scale is None:
            error = self.plan(trunk).float() - target
            error = torch.cat([error[..., :2], wrapped(error[..., 2:])], dim=-1)
            return F.smooth_l1_loss(error, torch.zeros_like(error), reduction="none")
        actions = self.scale.normalised(differentiated(target, c.parameterisation))
        if self.flow is not None:
            return self.flow.surprise(actions, self._features(trunk))
        assert self.diffusion is not None
        noisy, times = self.diffusion.corrupted(actions, generator)
        return (self._denoised(noisy, times, trunk).float() - actions).square()

    def _features(self, trunk: TrunkLayers) -> Tensor:
        """Return the features of each step's query [B, steps, hidden]."""
        features: Tensor = self.head(self.norm(trunk(self.queries.expand(trunk.batch, -1, -1))))
        return features

    def _denoised(self, noisy: Tensor, times: Tensor, trunk: TrunkLayers) -> Tensor:
        """Predict clean normalised actions [B, steps, 3] from noisy ones at levels [B]."""
        assert self.diffusion is not None
        tokens = self.diffusion.tokens(noisy, times, self.queries)
        clean: Tensor = self.out(self.head(self.norm(trunk(tokens, among=True))))
        return clean


def _shared(tensor: Tensor, share: int) -> Tensor:
    """Repeat every row for `share` consecutive instants."""
    return tensor if share == 1 else tensor.repeat_interleave(share, dim=0)
