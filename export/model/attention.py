"""Building blocks of the network: typed module lists, projections into the latent space, cross-attention layers."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Generic, TypeVar, overload

from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 - torch's own idiom

M = TypeVar("M", bound=nn.Module)


class TypedModuleList(nn.ModuleList, Generic[M]):
    """`nn.ModuleList` with a type for its entries; parameter names stay the same."""

    if TYPE_CHECKING:

        def __init__(self, modules: Iterable[M]) -> None: ...

        def __iter__(self) -> Iterator[M]: ...

        @overload
        def __getitem__(self, index: slice) -> TypedModuleList[M]: ...

        @overload
        def __getitem__(self, index: int) -> M: ...

        def __getitem__(self, index: int | slice) -> M | TypedModuleList[M]: ...


def projection(inputs: int, hidden: int) -> nn.Sequential:
    """Create a two-layer MLP into the shared latent space (paper appendix A: "projected … via MLP layers")."""
    return nn.Sequential(nn.Linear(inputs, hidden), nn.GELU(), nn.Linear(hidden, hidden))


class KeyValue(nn.Module):
    """Keys and values of one cross-attention layer."""

    def __init__(self, hidden: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.k = nn.Linear(hidden, hidden)
        self.v = nn.Linear(hidden, hidden)

    def forward(self, tokens: Tensor) -> tuple[Tensor, Tensor]:
        """Project tokens [B, T, hidden] to keys and values [B, heads, T, hidden/heads]."""
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

    def forward(self, x: Tensor, keys: Tensor, values: Tensor, mask: Tensor | None = None) -> Tensor:
        """Attend from queries [B, S, hidden] to keys and values [B, heads, T, d].

        `mask` [B, 1, 1, T] is False at padding.
        """
        n, t, d = x.shape
        q = self.q(self.norm1(x)).reshape(n, t, self.heads, d // self.heads).transpose(1, 2)
        attended = F.scaled_dot_product_attention(q, keys, values, attn_mask=mask)
        x = x + self.o(attended.transpose(1, 2).reshape(n, t, d))
        out: Tensor = x + self.fc2(F.gelu(self.fc1(self.norm2(x))))
        return out
