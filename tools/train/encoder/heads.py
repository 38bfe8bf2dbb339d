"""Heads on the visual tokens that are thrown away after the encoder's training, and what they are to learn.

They are linear: what they can tell is in the tokens for whoever reads them next. Every loss is a sum over a picture's
cells or columns with weights that are fixed beforehand, so that a batch's loss is the mean over its pictures, however
they are shared out among processes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 - torch's own idiom

from tools.train.encoder.labels import BACKGROUND, CLASSES, COLOUR_WORDS, COLUMNS, NONE, OCTANTS, OPENINGS

WEIGHTS: Final[Mapping[str, float]] = MappingProxyType(
    {
        "main": 0.3, "thing": 1.0, "colour": 0.4, "facing": 0.2, "near_m": 0.5, "thing_m": 0.5,
        "free_m": 1.0, "open_kind": 0.8, "open_m": 0.3, "place": 0.2,
    }
)  # fmt: skip
"""How much each label's loss counts."""
_CHOICES: Final = {
    "main": len(CLASSES), "thing": len(CLASSES), "colour": len(COLOUR_WORDS), "facing": OCTANTS,
}  # fmt: skip
_MOST_WEIGHT: Final = 6.0  # of a rare class: a few noisy cells must not rule
_LEAST_SHARE: Final = 0.01
_BETA: Final = 0.1  # where the loss of a distance turns from square to linear, in its logarithm

Predictions = Mapping[str, Tensor]


class EncoderHeads(nn.Module):
    """Tokens [n, side², dim], row by row from the top left, to predictions of every label."""

    def __init__(self, dim: int, side: int) -> None:
        super().__init__()
        if side < 1 or COLUMNS % side:
            raise ValueError(f"heads: expected a side that divides {COLUMNS}, found {side}")
        self.side = side
        self.norm = nn.LayerNorm(dim)
        self.cells = nn.Linear(dim, sum(_CHOICES.values()) + 2)
        self.columns = nn.Linear(dim * side, COLUMNS // side * (len(OPENINGS) + 2))
        self.place = nn.Linear(dim, len(OPENINGS))

    def initialise(self, generator: torch.Generator) -> None:
        """Weights that the generator names."""
        with torch.no_grad():
            for layer in (self.cells, self.columns, self.place):
                layer.weight.normal_(0.0, layer.in_features**-0.5, generator=generator)
                layer.bias.zero_()

    def forward(self, tokens: Tensor) -> dict[str, Tensor]:
        """Scores [n, side, side, choices] of `main`, `thing`, `colour`, `facing`; [n, 32, kinds] of `open_kind`.

        [n, kinds] of `place`; logarithms of `near_m`, `thing_m` [n, side, side] and of 1 + `free_m`, `open_m` [n, 32].
        """
        n, side = tokens.shape[0], self.side
        seen = self.norm(tokens)
        grid = seen.reshape(n, side, side, -1)
        cells = self.cells(grid).float()
        *scores, distances = cells.split([*_CHOICES.values(), 2], dim=-1)
        # A column of the picture, top to bottom, knows what stands there and where the floor ends.
        upright = grid.transpose(1, 2).reshape(n, side, -1)
        columns = self.columns(upright).float().reshape(n, COLUMNS, len(OPENINGS) + 2)
        return {
            **dict(zip(_CHOICES, scores, strict=True)),
            "near_m": distances[..., 0],
            "thing_m": distances[..., 1],
            "free_m": columns[..., 0],
            "open_m": columns[..., 1],
            "open_kind": columns[..., 2:],
            "place": self.place(seen.mean(dim=1)).float(),
        }


@dataclass(frozen=True)
class Balance:
    """Weights of classes, and shares of cells and columns that have a label, from the pictures to learn from.

    `classes`: float32 weights of `main`, `thing` and `open_kind` by class, 1 on average over the data.
    """

    classes: Mapping[str, NDArray[np.float32]]
    shares: Mapping[str, float]

    @staticmethod
    def of(labels: Mapping[str, NDArray[np.generic]]) -> Balance:
        """From all labels of a data set, arrays [N, ...]."""
        classes = {
            name: _weights(np.bincount(labels[name].ravel(), minlength=count).astype(np.float64))
            for name, count in (("main", len(CLASSES)), ("thing", len(CLASSES)), ("open_kind", len(OPENINGS)))
        }
        there = {
            "colour": labels["colour"] != NONE,
            "facing": labels["facing"] != NONE,
            "thing_m": np.greater(labels["rank"], BACKGROUND),
            "open_m": np.greater(labels["open_kind"], 0),
        }
        return Balance(classes, {name: max(float(mask.mean()), _LEAST_SHARE) for name, mask in there.items()})


def as_tensors(labels: Mapping[str, NDArray[np.generic]], device: str) -> dict[str, Tensor]:
    """Labels of a batch as float32 where they are distances, m, and as int64 elsewhere."""
    return {
        name: torch.from_numpy(array.astype(np.float32 if array.dtype == np.float16 else np.int64)).to(device)
        for name, array in labels.items()
    }


def losses(predicted: Predictions, labels: Mapping[str, Tensor], balance: Balance) -> dict[str, Tensor]:
    """[n] of each label: what a picture's predictions cost, before `WEIGHTS`."""
    found = {
        name: _choice(predicted[name], labels[name], balance.classes[name]) for name in ("main", "thing", "open_kind")
    }
    for name in ("colour", "facing"):
        found[name] = _choice(predicted[name], labels[name], None) / balance.shares[name]
    found["place"] = F.cross_entropy(predicted["place"], labels["place"], reduction="none")
    found["near_m"] = _far(predicted["near_m"], labels["near_m"].log(), None)
    found["thing_m"] = _far(predicted["thing_m"], labels["thing_m"].log(), labels["rank"] > BACKGROUND)
    found["free_m"] = _far(predicted["free_m"], labels["free_m"].log1p(), None)
    found["open_m"] = _far(predicted["open_m"], labels["open_m"].log1p(), labels["open_kind"] > 0)
    for name in ("thing_m", "open_m"):
        found[name] = found[name] / balance.shares[name]
    return found


def total(parts: Mapping[str, Tensor]) -> Tensor:
    """[n]: the weighted sum."""
    return torch.stack([WEIGHTS[name] * part for name, part in sorted(parts.items())]).sum(dim=0)


def _choice(scores: Tensor, wanted: Tensor, weights: NDArray[np.float32] | None) -> Tensor:
    """[n]: mean over all cells of the cross-entropy; cells that have NONE cost nothing."""
    weight = None if weights is None else torch.from_numpy(weights).to(scores.device)
    cost = F.cross_entropy(
        scores.reshape(-1, scores.shape[-1]), wanted.reshape(-1), weight=weight, ignore_index=NONE, reduction="none"
    )
    return cost.reshape(len(scores), -1).mean(dim=1)


def _far(predicted: Tensor, wanted: Tensor, where: Tensor | None) -> Tensor:
    """[n]: mean over all cells of what logarithms of distances are off by; nothing where there is no such distance."""
    cost = F.smooth_l1_loss(predicted, wanted, beta=_BETA, reduction="none")
    if where is not None:
        cost = cost * where
    return cost.reshape(len(cost), -1).mean(dim=1)


def _weights(counts: NDArray[np.float64]) -> NDArray[np.float32]:
    """By the square root of how rare a class is, 1 on average over what is there."""
    shares = counts / max(counts.sum(), 1.0)
    # A class that is nowhere has no say: it gets what the rarest has.
    rare = np.maximum(shares, shares[shares > 0].min(initial=1.0)) ** -0.5
    for _ in range(4):  # the cap lowers the mean, which raises the rest
        rare = np.minimum(rare / (shares * rare).sum(), _MOST_WEIGHT)
    weights: NDArray[np.float32] = rare.astype(np.float32)
    return weights
