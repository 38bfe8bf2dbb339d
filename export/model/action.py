"""Action expert: learned queries that cross-attend to now (frame, state) and to a delayed semantic state (Fig. 3a).

Split in two so that the part which depends on the semantic state alone runs once a generation: `SemanticContext`
projects the VLM's tokens to every layer's keys and values, `ActionExpert` adds what changes each tick. Keys and
values are per-token linear maps, so the split is exact. Waypoints are re-expressed in the robot's current frame first
(paper appendix C), so their context, of three tokens, is computed every tick.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 - torch's own idiom

from export.model.config import TicVlaConfig


def projection(inputs: int, hidden: int) -> nn.Sequential:
    """Two-layer MLP into the shared latent space (paper appendix A: "projected … via MLP layers")."""
    return nn.Sequential(nn.Linear(inputs, hidden), nn.GELU(), nn.Linear(hidden, hidden))


class KeyValue(nn.Module):
    """Keys and values of one cross-attention layer."""

    def __init__(self, hidden: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.k = nn.Linear(hidden, hidden)
        self.v = nn.Linear(hidden, hidden)

    def forward(self, tokens: Tensor) -> tuple[Tensor, Tensor]:
        """Tokens [1, T, hidden] → keys and values [1, heads, T, hidden/heads]."""
        n, t, d = tokens.shape
        split = (n, t, self.heads, d // self.heads)
        return self.k(tokens).reshape(split).transpose(1, 2), self.v(tokens).reshape(split).transpose(1, 2)


class CrossAttentionLayer(nn.Module):
    """Pre-norm cross-attention of the queries, then an FFN."""

    def __init__(self, hidden: int, heads: int, ffn: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm1 = nn.LayerNorm(hidden)
        self.q = nn.Linear(hidden, hidden)
        self.o = nn.Linear(hidden, hidden)
        self.norm2 = nn.LayerNorm(hidden)
        self.fc1 = nn.Linear(hidden, ffn)
        self.fc2 = nn.Linear(ffn, hidden)

    def forward(self, x: Tensor, keys: Tensor, values: Tensor) -> Tensor:
        n, t, d = x.shape
        q = self.q(self.norm1(x)).reshape(n, t, self.heads, d // self.heads).transpose(1, 2)
        attended = F.scaled_dot_product_attention(q, keys, values)
        x = x + self.o(attended.transpose(1, 2).reshape(n, t, d))
        return x + self.fc2(F.gelu(self.fc1(self.norm2(x))))


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
        self.key_values = nn.ModuleList(KeyValue(c.hidden, c.heads) for _ in range(c.layers))
        self.layers = nn.ModuleList(CrossAttentionLayer(c.hidden, c.heads, c.ffn) for _ in range(c.layers))
        self.norm = nn.LayerNorm(c.hidden)
        self.head = projection(c.hidden, c.hidden)
        self.out = nn.Linear(c.hidden, 3)

    def semantic_tokens(self, guidance: Tensor) -> Tensor:
        """Last-layer K‖V [1, T, kv_dim], or waypoints [1, 3, 2] in m in the current robot frame → [1, T, hidden]."""
        interface = self.config.action.semantic_interface
        if interface == "values-only":
            guidance = guidance[..., self.config.kv_dim // 2 :]
        tokens = self.semantic_projection(guidance) + self.semantic_position[:, : guidance.shape[1]]
        if self.training and interface != "waypoints":
            # Whole K‖V tokens are dropped (paper: token dropout 0.1), so that missing semantics are survivable.
            keep = torch.rand(tokens.shape[:2], device=tokens.device) >= self.config.action.kv_dropout
            tokens = tokens * keep[..., None]
        return tokens

    def context(self, guidance: Tensor) -> tuple[Tensor, Tensor]:
        """Semantic context: keys and values [layers, 1, heads, T, hidden/heads] of the semantic tokens."""
        tokens = self.semantic_tokens(guidance)
        pairs = [kv(tokens) for kv in self.key_values]
        return torch.stack([k for k, _ in pairs]), torch.stack([v for _, v in pairs])

    def now_tokens(self, visual_tokens: Tensor, state: Tensor, latency: Tensor) -> Tensor:
        """Tokens of the present [1, N + 2, hidden]: frame, robot state (vx, vy, ωz), latency (Δt, Δx, Δy, Δθ)."""
        c = self.config.action
        visual = self.visual_projection(visual_tokens) + self.visual_position
        if not c.latency_aware:
            latency = torch.zeros_like(latency)
        elif not c.motion_offset:
            latency = latency * latency.new_tensor([1.0, 0.0, 0.0, 0.0])
        metadata = torch.stack([self.state_projection(state), self.latency_projection(latency)], dim=1)
        metadata = metadata + self.metadata_position
        if self.training:
            keep = torch.rand(metadata.shape[0], 1, 1, device=metadata.device) >= c.state_dropout
            metadata = torch.cat([metadata[:, :1] * keep, metadata[:, 1:]], dim=1)
        return torch.cat([visual, metadata], dim=1)

    def forward(
        self, visual_tokens: Tensor, state: Tensor, latency: Tensor, context_keys: Tensor, context_values: Tensor
    ) -> Tensor:
        """Planned trajectory [1, steps, 3] (x m, y m, θ rad) in the current robot frame."""
        c = self.config.action
        now = self.now_tokens(visual_tokens, state, latency)
        x = self.queries.expand(visual_tokens.shape[0], -1, -1)
        for i, (key_value, layer) in enumerate(zip(self.key_values, self.layers, strict=True)):
            keys, values = key_value(now)
            x = layer(x, torch.cat([keys, context_keys[i]], dim=2), torch.cat([values, context_values[i]], dim=2))
        out = self.out(self.head(self.norm(x)))
        if c.parameterisation == "increments":
            return torch.cumsum(out, dim=1)
        return torch.cat([out[..., :2], torch.cumsum(out[..., 2:], dim=1)], dim=-1)
