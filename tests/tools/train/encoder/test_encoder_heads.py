"""Heads predict labels from the tokens of their own cell or column; scores are full for correct predictions alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
import torch

from tools.train.encoder.heads import WEIGHTS, Balance, EncoderHeads, Fixed, Score, as_tensors, decide, losses, total
from tools.train.encoder.labels import CLASSES, COLUMNS, FREE_M, LANDMARK, NONE, OCTANTS, OPENINGS, PERSON, label_shapes

SIDE, DIM = 4, 16
CELLS = ("main", "thing", "colour", "facing", "near_m", "thing_m")
BY_COLUMN = ("free_m", "open_m", "open_kind")


def some_labels(count: int, seed: int = 1, side: int = SIDE) -> dict[str, np.ndarray]:
    """Labels that could be: a third of the cells has a thing with a colour, a third of the columns opens."""
    rng = np.random.default_rng(seed)
    found = {name: np.zeros((count, *shape), kind) for name, (kind, shape) in label_shapes(side).items()}
    cells = (count, side, side)
    there = rng.uniform(size=cells) < 1 / 3
    found["main"][:] = rng.integers(0, 5, cells)
    found["thing"][:] = np.where(there, rng.integers(5, len(CLASSES), cells), found["main"])
    found["rank"][:] = np.where(there, LANDMARK, 0)
    found["colour"][:] = np.where(there, rng.integers(0, 5, cells), NONE)
    found["facing"][:] = np.where(rng.uniform(size=cells) < 0.1, rng.integers(0, OCTANTS, cells), NONE)
    found["near_m"][:] = rng.uniform(0.2, 5.0, cells)
    found["thing_m"][:] = found["near_m"] * 1.5
    columns = (count, COLUMNS)
    found["open_kind"][:] = np.where(rng.uniform(size=columns) < 1 / 3, rng.integers(1, len(OPENINGS), columns), 0)
    found["free_m"][:] = rng.uniform(0.0, FREE_M, columns)
    found["open_m"][:] = rng.uniform(0.5, FREE_M, columns)
    found["place"][:] = rng.integers(0, len(OPENINGS), count)
    return found


def perfect(labels: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Predictions that are right and sure of it."""
    sizes = {"main": len(CLASSES), "thing": len(CLASSES), "colour": 11, "facing": OCTANTS, "open_kind": len(OPENINGS)}
    found = {}
    for name, size in {**sizes, "place": len(OPENINGS)}.items():
        wanted = labels[name].clone()
        wanted[wanted == NONE] = 0
        found[name] = 40.0 * torch.nn.functional.one_hot(wanted, size).float()
    found |= {name: labels[name].log() for name in ("near_m", "thing_m")}
    return found | {name: labels[name].log1p() for name in ("free_m", "open_m")}


@pytest.fixture(scope="module")
def heads() -> EncoderHeads:
    made = EncoderHeads(DIM, SIDE)
    made.initialise(torch.Generator().manual_seed(1))
    return made


def tokens(count: int = 3) -> torch.Tensor:
    return torch.randn(count, SIDE * SIDE, DIM, generator=torch.Generator().manual_seed(2))


def costs(heads: EncoderHeads, labels: Mapping[str, Any], seen: torch.Tensor) -> dict[str, torch.Tensor]:
    return losses(heads(seen), as_tensors(labels, "cpu"), Balance.of(some_labels(40)))


def test_a_cell_depends_on_its_own_token_and_a_column_on_its_own_column(heads: EncoderHeads) -> None:
    before, row, column = tokens(1), 1, 2
    after = before.clone()
    after[0, row * SIDE + column] += torch.linspace(-1, 1, DIM)
    one, other = heads(before), heads(after)
    for name in CELLS:
        moved = (one[name] != other[name]).reshape(SIDE, SIDE, -1).any(dim=-1)
        assert moved.nonzero().tolist() == [[row, column]], name
    for name in BY_COLUMN:
        moved = (one[name] != other[name]).reshape(SIDE, COLUMNS // SIDE, -1).any(dim=-1).any(dim=-1)
        assert moved.nonzero().tolist() == [[column]], name


def test_being_right_costs_nothing_and_being_wrong_does() -> None:
    labels = as_tensors(some_labels(5), "cpu")
    balance = Balance.of(some_labels(5))
    right = losses(perfect(labels), labels, balance)
    wrong = losses(perfect(as_tensors(some_labels(5, seed=2), "cpu")), labels, balance)
    for name in WEIGHTS:
        assert right[name].max() < 1e-4, name
        assert wrong[name].mean() > 0.1, name


def test_a_batchs_loss_is_the_mean_of_its_pictures_losses(heads: EncoderHeads) -> None:
    labels, seen = some_labels(6), tokens(6)
    together = total(costs(heads, labels, seen))
    for i in range(6):
        alone = total(costs(heads, {name: array[i : i + 1] for name, array in labels.items()}, seen[i : i + 1]))
        assert alone[0].item() == pytest.approx(together[i].item(), rel=1e-5)


def test_missing_labels_have_no_loss(heads: EncoderHeads) -> None:
    labels = some_labels(2)
    labels["colour"][:], labels["facing"][:], labels["rank"][:], labels["open_kind"][:] = NONE, NONE, 0, 0
    found = costs(heads, labels, tokens(2))
    assert all(found[name].detach().abs().max() == 0.0 for name in ("colour", "facing", "thing_m", "open_m"))


def test_rare_classes_count_more_and_all_together_count_as_one() -> None:
    labels = some_labels(40)
    labels["thing"][:] = np.where(np.random.default_rng(1).uniform(size=labels["thing"].shape) < 0.02, 5, 1)
    weights = Balance.of(labels).classes["thing"]
    shares = np.bincount(labels["thing"].ravel(), minlength=len(CLASSES)) / labels["thing"].size
    assert weights[5] > 2 * weights[1]
    assert float(weights @ shares) == pytest.approx(1.0, abs=0.05)
    assert np.isfinite(weights).all() and weights.max() <= 6.0


WIDE = 8
MACHINE = CLASSES.index("vending_machine")


def scored(said: Any, labels: Any) -> dict[str, Any]:
    score = Score()
    score.add(said, labels)
    return score.result()


def right(labels: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return decide(perfect(as_tensors(labels, "cpu")))


def with_machine(column: int, count: int = 4) -> dict[str, np.ndarray]:
    """Pictures of walls with a machine in one column."""
    labels = some_labels(count, side=WIDE)
    labels["thing"][:], labels["rank"][:] = CLASSES.index("wall"), 0
    labels["thing"][:, 2:5, column], labels["rank"][:, 2:5, column] = MACHINE, LANDMARK
    return labels


def test_correct_outputs_have_a_full_score() -> None:
    labels = some_labels(30, side=WIDE)
    found = scored(right(labels), labels)
    for name in (
        "main_accuracy", "landmark_recall", "colour_accuracy", "facing_within_octant", "place_accuracy",
        "opening_recall", "opening_precision", "opening_kind_accuracy", "landmark_bearing",
    ):  # fmt: skip
        assert found[name] == 1.0, name
    for name in ("near", "thing", "free", "open"):
        assert found[f"{name}_relative_error"] < 1e-3
        assert max(found[f"{name}_error_m"].values()) < 0.02
    assert all(each["recall"] == each["precision"] == 1.0 for each in found["things"].values())
    assert found["pictures"] == 30


@pytest.mark.parametrize(("said", "found"), [(2, 1.0), (3, 0.0), (6, 0.0)])
def test_a_landmark_is_found_where_it_stands_and_not_beside_it(said: int, found: float) -> None:
    assert scored(right(with_machine(said)), with_machine(2))["landmark_bearing"] == found


def test_missed_and_imagined_people_are_counted_separately() -> None:
    labels = with_machine(3)
    labels["thing"][:, 6:, :2] = PERSON
    said = right(labels)
    said["thing"][:, 6, :2] = CLASSES.index("wall")
    missed = scored(said, labels)
    assert missed["person_recall"] == 0.5 and missed["person_precision"] == 1.0
    said = right(labels)
    said["thing"][:, 4:6, :2] = PERSON
    imagined = scored(said, labels)
    assert imagined["person_recall"] == 1.0 and imagined["person_precision"] == 0.5


def test_distances_are_scored_by_how_far_away_things_are() -> None:
    labels = some_labels(10, side=WIDE)
    said = right(labels)
    said["free_m"] = np.where(labels["free_m"] >= 8, labels["free_m"] - 2.0, labels["free_m"]).astype(np.float32)
    found = scored(said, labels)["free_error_m"]
    assert found["8+"] == pytest.approx(2.0, abs=0.02) and found["2-5"] < 0.01


def test_the_fixed_answer_is_what_is_most_common_at_each_place() -> None:
    labels = with_machine(5, count=9)
    labels["free_m"][:] = 3.0
    labels["free_m"][0] = 12.0
    said = Fixed(labels).of(4)
    assert (said["thing"][:, 2:5, 5] == MACHINE).all() and (said["thing"][:, 0] == CLASSES.index("wall")).all()
    assert said["free_m"].shape == (4, 32) and (said["free_m"] == 3.0).all()
    assert scored(said, {name: array[:4] for name, array in labels.items()})["landmark_bearing"] == 1.0
    assert scored(said, with_machine(1))["landmark_bearing"] == 0.0
