"""Linear heads on the visual tokens, used only to train the encoder: their losses, and scores on held-out images.

The heads are linear so that the tokens themselves contain the predicted quantities. Every loss is a sum over an image's
cells or columns with fixed weights: a batch's loss is the mean over its images, for any distribution among processes.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from math import inf, isinf, radians
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 - torch's own idiom

from sim_hil.simulation.camera import CAMERA_HFOV_RAD
from tools.train.encoder.labels import (
    BACKGROUND,
    CLASSES,
    COLOUR_WORDS,
    COLUMNS,
    DOOR,
    LANDMARK,
    NONE,
    OCTANTS,
    OPENINGS,
    PERSON,
    bearing_rad,
)

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


Arrays = Mapping[str, NDArray[Any]]

BEARING_RAD: Final = radians(10.0)
_NEAR_BINS: Final = (0.0, 2.0, 5.0, 10.0, inf)  # m
_FREE_BINS: Final = (0.0, 2.0, 5.0, 8.0, inf)
_LEAST_CELLS: Final = 20  # classes with fewer cells are not reported
_HALF_WIDTH: Final = float(np.tan(CAMERA_HFOV_RAD / 2))


def decide(predicted: Predictions) -> dict[str, NDArray[Any]]:
    """Convert predictions to labels, and to `share` [n, side, side, classes], the probabilities of each cell."""
    scores = {name: predicted[name].argmax(dim=-1) for name in ("main", "thing", "colour", "facing", "open_kind")}
    scores["place"] = predicted["place"].argmax(dim=-1)
    distances = {name: predicted[name].exp() for name in ("near_m", "thing_m")}
    distances |= {name: predicted[name].expm1().clamp_min(0.0) for name in ("free_m", "open_m")}
    share = {"share": torch.softmax(predicted["thing"], dim=-1)}
    return {name: tensor.cpu().numpy() for name, tensor in {**scores, **distances, **share}.items()}


class Fixed:
    """Constant baseline: the most frequent or median label at each position of the image."""

    def __init__(self, labels: Arrays) -> None:
        """Compute the baseline from all training labels, arrays [N, ...]."""
        share = np.stack([(labels["thing"] == c).mean(axis=0) for c in range(len(CLASSES))], axis=-1)
        there = labels["rank"] > BACKGROUND
        opens = labels["open_kind"] > 0
        self._one: dict[str, NDArray[Any]] = {
            "main": _most_common(labels["main"], len(CLASSES)),
            "thing": share.argmax(axis=-1),
            "share": share.astype(np.float32),
            "colour": np.full(share.shape[:2], _most_common_of(labels["colour"], len(COLOUR_WORDS))),
            "facing": np.full(share.shape[:2], _most_common_of(labels["facing"], OCTANTS)),
            "near_m": np.median(labels["near_m"].astype(np.float32), axis=0),
            "thing_m": np.full(share.shape[:2], _middle(labels["thing_m"], there)),
            "free_m": np.median(labels["free_m"].astype(np.float32), axis=0),
            "open_kind": _most_common(labels["open_kind"], len(OPENINGS)),
            "open_m": np.full(labels["open_m"].shape[1:], _middle(labels["open_m"], opens)),
            "place": _most_common(labels["place"], len(OPENINGS)),
        }

    def of(self, count: int) -> dict[str, NDArray[Any]]:
        """Return the baseline's labels for `count` images."""
        return {name: np.broadcast_to(one, (count, *np.shape(one))) for name, one in self._one.items()}


class Score:
    """Accumulates predictions and labels batch by batch."""

    def __init__(self) -> None:
        self._confusion = np.zeros((len(CLASSES), len(CLASSES)), np.int64)
        self._shares: dict[str, list[int]] = {}
        self._pairs: dict[str, list[NDArray[np.float32]]] = {}
        self._pictures = 0

    def add(self, found: Arrays, labels: Arrays) -> None:
        """Add predictions and labels of some images, arrays [n, ...]."""
        self._pictures += len(labels["thing"])
        thing, rank = labels["thing"], labels["rank"]
        np.add.at(self._confusion, (thing.ravel(), found["thing"].ravel()), 1)
        right = found["thing"] == thing
        self._share("main_accuracy", found["main"] == labels["main"])
        self._share("landmark_recall", right[rank == LANDMARK])
        self._share("door_recall", right[rank == DOOR])
        self._share("colour_accuracy", (found["colour"] == labels["colour"])[labels["colour"] != NONE])
        self._share("place_accuracy", found["place"] == labels["place"])
        turned = (found["facing"].astype(int) - labels["facing"].astype(int)) % OCTANTS
        self._share("facing_within_octant", np.isin(turned, (0, 1, OCTANTS - 1))[labels["facing"] != NONE])
        opens, predicted = labels["open_kind"] > 0, found["open_kind"] > 0
        self._share("opening_recall", predicted[opens])
        self._share("opening_precision", opens[predicted])
        self._share("opening_kind_accuracy", (found["open_kind"] == labels["open_kind"])[opens])
        self._share("landmark_bearing", _bearings(found["share"], thing, rank))
        self._pair("near", found["near_m"], labels["near_m"])
        self._pair("thing", found["thing_m"][rank > BACKGROUND], labels["thing_m"][rank > BACKGROUND])
        self._pair("free", found["free_m"], labels["free_m"])
        self._pair("open", found["open_m"][opens], labels["open_m"][opens])

    def result(self) -> dict[str, Any]:
        """Return shares from 0 to 1 and distances in m; None for scores without cases."""
        found: dict[str, Any] = {name: _ratio(*counts) for name, counts in sorted(self._shares.items())}
        found["landmarks"] = self._shares.get("landmark_bearing", [0, 0])[1]
        found["pictures"] = self._pictures
        found["person_recall"] = _ratio(self._confusion[PERSON, PERSON], self._confusion[PERSON].sum())
        found["person_precision"] = _ratio(self._confusion[PERSON, PERSON], self._confusion[:, PERSON].sum())
        found["things"] = {
            name: {
                "recall": _ratio(self._confusion[c, c], self._confusion[c].sum()),
                "precision": _ratio(self._confusion[c, c], self._confusion[:, c].sum()),
                "cells": int(self._confusion[c].sum()),
            }
            for c, name in enumerate(CLASSES)
            if self._confusion[c].sum() >= _LEAST_CELLS
        }
        for name, bins in (("near", _NEAR_BINS), ("thing", _NEAR_BINS), ("free", _FREE_BINS), ("open", _FREE_BINS)):
            predicted, true = self._distances(name)
            off = np.abs(predicted - true)
            found[f"{name}_relative_error"] = float(np.median(off / np.maximum(true, 0.1))) if len(true) else None
            found[f"{name}_error_m"] = {
                (f"{low:g}+" if isinf(high) else f"{low:g}-{high:g}"): float(off[inside].mean())
                for low, high in itertools.pairwise(bins)
                if (inside := (true >= low) & (true < high)).any()
            }
        return found

    def _share(self, name: str, right: NDArray[np.bool_]) -> None:
        counts = self._shares.setdefault(name, [0, 0])
        counts[0] += int(right.sum())
        counts[1] += int(right.size)

    def _pair(self, name: str, predicted: NDArray[Any], true: NDArray[Any]) -> None:
        both = np.stack((predicted.ravel(), true.ravel())).astype(np.float32)
        self._pairs.setdefault(name, []).append(both)

    def _distances(self, name: str) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        both = np.concatenate(self._pairs.get(name, [np.zeros((2, 0), np.float32)]), axis=1)
        return both[0], both[1]


def _bearings(share: NDArray[Any], thing: NDArray[Any], rank: NDArray[Any]) -> NDArray[np.bool_]:
    """Return for every kind of landmark in every image whether its most probable cell is within 10° of a true one."""
    side = thing.shape[1]
    angles = np.array([bearing_rad(_HALF_WIDTH, column, side) for column in range(side)])
    hits: list[bool] = []
    for one, kinds, ranks in zip(share, thing, rank, strict=True):
        named = ranks == LANDMARK
        for kind in np.unique(kinds[named]):
            true = np.flatnonzero((named & (kinds == kind)).any(axis=0))
            best = int(one[..., kind].argmax()) % side
            hits.append(bool(np.abs(angles[true] - angles[best]).min() <= BEARING_RAD))
    return np.array(hits, bool)


def _most_common(values: NDArray[Any], count: int) -> NDArray[np.int64]:
    """Return the most frequent number below `count` at each position [...] of [N, ...]."""
    winners: NDArray[np.int64] = np.stack([(values == c).sum(axis=0) for c in range(count)], axis=-1).argmax(axis=-1)
    return winners


def _most_common_of(values: NDArray[Any], count: int) -> int:
    return int(np.bincount(values[values != NONE], minlength=count).argmax())


def _middle(values: NDArray[Any], where: NDArray[np.bool_]) -> float:
    return float(np.median(values[where].astype(np.float32))) if where.any() else 1.0


def _ratio(part: Any, whole: Any) -> float | None:
    return float(part / whole) if whole else None
