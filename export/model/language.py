"""Language model: Qwen2.5-style decoder whose last-layer keys and values are the semantic state."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 - torch's own idiom

from edge.artifacts.manifest import MOST_ROWS
from export.model.attention import TypedModuleList
from export.model.config import LanguageConfig
from export.model.vision import fold_tokens


class RmsNorm(nn.Module):
    """Root-mean-square norm."""

    def __init__(self, width: int, eps: float) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(width))
        self.eps = eps

    def forward(self, x: Tensor) -> Tensor:
        return self.weight * (x * torch.rsqrt(x.pow(2).mean(-1, keepdim=True) + self.eps))


def rotate(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Apply the rotary position embedding with angles [t, d] to [n, heads, t, d]."""
    first, second = x.chunk(2, dim=-1)
    return x * cos + torch.cat([-second, first], dim=-1) * sin


class DecoderLayer(nn.Module):
    """Grouped-query attention and SwiGLU."""

    def __init__(self, config: LanguageConfig) -> None:
        super().__init__()
        self.config = config
        d, hd = config.hidden, config.head_dim
        self.input_norm = RmsNorm(d, config.rms_eps)
        self.q = nn.Linear(d, config.heads * hd)
        self.k = nn.Linear(d, config.kv_heads * hd)
        self.v = nn.Linear(d, config.kv_heads * hd)
        self.o = nn.Linear(config.heads * hd, d, bias=False)
        self.mlp_norm = RmsNorm(d, config.rms_eps)
        self.gate = nn.Linear(d, config.mlp, bias=False)
        self.up = nn.Linear(d, config.mlp, bias=False)
        self.down = nn.Linear(config.mlp, d, bias=False)

    def forward(
        self, x: Tensor, cos: Tensor, sin: Tensor, mask: Tensor, past_k: Tensor, past_v: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        c = self.config
        n, t, _ = x.shape
        h = self.input_norm(x)
        q = rotate(self.q(h).reshape(n, t, c.heads, c.head_dim).transpose(1, 2), cos, sin)
        k = rotate(self.k(h).reshape(n, t, c.kv_heads, c.head_dim).transpose(1, 2), cos, sin)
        v = self.v(h).reshape(n, t, c.kv_heads, c.head_dim).transpose(1, 2)
        k = torch.cat([past_k, k], dim=2)
        v = torch.cat([past_v, v], dim=2)
        groups = c.heads // c.kv_heads
        attended = F.scaled_dot_product_attention(
            q, k.repeat_interleave(groups, dim=1), v.repeat_interleave(groups, dim=1), attn_mask=mask
        )
        x = x + self.o(attended.transpose(1, 2).reshape(n, t, c.heads * c.head_dim))
        h = self.mlp_norm(x)
        return x + self.down(F.silu(self.gate(h)) * self.up(h)), k, v


class LanguageModel(nn.Module):
    """Decoder for prefill and decode: reads new tokens, returns the next token and the extended KV cache.

    `input_ids` [1, S], `visual_tokens` [F, N, D] (the frames whose `<IMG_CONTEXT>` tokens are in this call, in order;
    any one frame when there are none), `past` = 2·layers tensors [1, kv_heads, P, head_dim] (k0, v0, k1, v1, …).
    """

    inv_freq: Tensor

    def __init__(self, config: LanguageConfig, token_dim: int) -> None:
        super().__init__()
        self.config = config
        self.embed = nn.Embedding(config.vocab, config.hidden)
        if config.token_merge > 1:
            width = token_dim * config.token_merge**2
            self.merge: nn.Module = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, config.hidden))
        else:
            self.merge = nn.Identity()
        self.layers = TypedModuleList(DecoderLayer(config) for _ in range(config.layers))
        self.norm = RmsNorm(config.hidden, config.rms_eps)
        self.lm_head = nn.Linear(config.hidden, config.vocab, bias=False)
        inv_freq = config.rope_theta ** (-torch.arange(0, config.head_dim, 2).float() / config.head_dim)
        self.register_buffer("inv_freq", inv_freq, persistent=False)

    def embed_inputs(self, input_ids: Tensor, visual_tokens: Tensor, image_offset: int = 0) -> Tensor:
        """Embed tokens [1, S, hidden]; visual tokens replace `<IMG_CONTEXT>`, from `image_offset` on."""
        images = self.merge(fold_tokens(visual_tokens, self.config.token_merge))
        images = images.reshape(-1, self.config.hidden)
        is_image = input_ids[0] == self.config.img_context_id
        place = (torch.cumsum(is_image.long(), dim=0) - 1 + image_offset).clamp(min=0)
        # The prompt builder never makes more image positions than image tokens; clamping keeps the gather in range.
        place = torch.minimum(place, torch.full_like(place, 1) * (images.shape[0] - 1))
        return torch.where(is_image[:, None], images[place], self.embed(input_ids[0]))[None]

    def hidden_states(
        self, input_ids: Tensor, visual_tokens: Tensor, past: list[Tensor], image_offset: int = 0
    ) -> tuple[Tensor, list[Tensor], Tensor]:
        """Compute final hidden states [1, S, hidden], extended caches, new tokens' last-layer K‖V [1, S, kv_dim]."""
        x = self.embed_inputs(input_ids, visual_tokens, image_offset)
        new, old = input_ids.shape[1], past[0].shape[2]
        position = torch.arange(new, device=x.device) + old
        angle = position.float()[:, None] * self.inv_freq[None]
        angle = torch.cat([angle, angle], dim=-1)
        cos, sin = angle.cos(), angle.sin()
        mask = torch.arange(new + old, device=x.device)[None, :] <= position[:, None]
        present: list[Tensor] = []
        for i, layer in enumerate(self.layers):
            x, k, v = layer(x, cos, sin, mask, past[2 * i], past[2 * i + 1])
            present += [k, v]
        k_new, v_new = present[-2][:, :, old:], present[-1][:, :, old:]
        parts = [p.transpose(1, 2).reshape(1, new, self.config.kv_heads * self.config.head_dim) for p in (k_new, v_new)]
        return self.norm(x), present, torch.cat(parts, dim=-1)

    def forward(
        self, input_ids: Tensor, visual_tokens: Tensor, past: list[Tensor], image_offset: int = 0
    ) -> tuple[Tensor, ...]:
        """Compute `next_token` [1, L], `logits` [L, vocab], `last_layer_kv` [1, S, kv_dim] and caches.

        L: the call's last `MOST_ROWS` positions, or all of a shorter one.
        """
        x, present, last_layer_kv = self.hidden_states(input_ids, visual_tokens, past, image_offset)
        logits = self.lm_head(x[0, -MOST_ROWS:])
        return logits.argmax(-1)[None], logits, last_layer_kv, *present
