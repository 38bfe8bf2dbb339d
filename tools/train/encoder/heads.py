"""Linear heads on the visual tokens, used only during the encoder's training, and their losses.

The heads are linear so that the tokens themselves contain the predicted quantities. Every loss is a sum over an image's
cells or columns with fixed weights: a batch's loss is the mean over its images, for any distribution among processes.
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
"""Weight of each label's loss."""
_CHOICES: Final = {
    "main": len(CLASSES), "thing": len(CLASSES), "colour": len(COLOUR_WORDS), "facing": OCTANTS,
}  # fmt: skip
_MOST_WEIGHT: Final = 6.0  # largest weight of a rare class, so that a few noisy cells do not dominate
_LEAST_SHARE: Final = 0.01  # smallest share of labelled cells that a loss is divided by
_BETA: Final = 0.1  # error of a log distance at which the loss changes from quadratic to linear

Predictions = Mapping[str, Tensor]


class EncoderHeads(nn.Module):
    """Maps tokens [n, side², dim], row by row from the top left, to predictions of every label."""

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
        """Initialise the weights from a generator."""
        with torch.no_grad():
            for layer in (self.cells, self.columns, self.place):
                layer.weight.normal_(0.0, layer.in_features**-0.5, generator=generator)
                layer.bias.zero_()

    def forward(self, tokens: Tensor) -> dict[str, Tensor]:
        """Compute the predictions.

        Scores: `main`, `thing`, `colour`, `facing` [n, side, side, choices], `open_kind` [n, 32, kinds], `place`
        [n, kinds]. Logarithms: `near_m`, `thing_m` [n, side, side], and of 1 + `free_m`, 1 + `open_m` [n, 32].
        """
        n, side = tokens.shape[0], self.side
        seen = self.norm(tokens)
        grid = seen.reshape(n, side, side, -1)
        cells = self.cells(grid).float()
        *scores, distances = cells.split([*_CHOICES.values(), 2], dim=-1)
        # A column of the image, top to bottom, shows what stands there and where the floor ends.
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
    """Weights of classes, and shares of labelled cells and columns, from the training images.

    `classes`: float32 weights of `main`, `thing` and `open_kind` by class, 1 on average over the data.
    """

    classes: Mapping[str, NDArray[np.float32]]
    shares: Mapping[str, float]

    @staticmethod
    def of(labels: Mapping[str, NDArray[np.generic]]) -> Balance:
        """Compute the balance from all labels of a data set, arrays [N, ...]."""
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
    """Convert a batch's labels to tensors: distances, m, as float32, others as int64."""
    return {
        name: torch.from_numpy(array.astype(np.float32 if array.dtype == np.float16 else np.int64)).to(device)
        for name, array in labels.items()
    }


def losses(predicted: Predictions, labels: Mapping[str, Tensor], balance: Balance) -> dict[str, Tensor]:
    """Compute the loss of each label for every image [n], before `WEIGHTS`."""
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
    """Return the weighted sum of the losses [n]."""
    return torch.stack([WEIGHTS[name] * part for name, part in sorted(parts.items())]).sum(dim=0)


def _choice(scores: Tensor, wanted: Tensor, weights: NDArray[np.float32] | None) -> Tensor:
    """Compute the mean cross-entropy over all cells [n]; cells with NONE have no loss."""
    weight = None if weights is None else torch.from_numpy(weights).to(scores.device)
    cost = F.cross_entropy(
        scores.reshape(-1, scores.shape[-1]), wanted.reshape(-1), weight=weight, ignore_index=NONE, reduction="none"
    )
    return cost.reshape(len(scores), -1).mean(dim=1)


def _far(predicted: Tensor, wanted: Tensor, where: Tensor | None) -> Tensor:
    """Compute the mean error of log distances over all cells [n]; cells outside `where` have no loss."""
    cost = F.smooth_l1_loss(predicted, wanted, beta=_BETA, reduction="none")
    if where is not None:
        cost = cost * where
    return cost.reshape(len(cost), -1).mean(dim=1)


def _weights(counts: NDArray[np.float64]) -> NDArray[np.float32]:
    """Compute class weights proportional to share^-0.5, with mean 1 over the data and a cap."""
    shares = counts / max(counts.sum(), 1.0)
    # A class that does not occur gets the weight of the rarest class.
    rare = np.maximum(shares, shares[shares > 0].min(initial=1.0)) ** -0.5
    for _ in range(4):  # the cap lowers the mean, which raises the rest
        rare = np.minimum(rare / (shares * rare).sum(), _MOST_WEIGHT)
    weights: NDArray[np.float32] = rare.astype(np.float32)
    return weights
