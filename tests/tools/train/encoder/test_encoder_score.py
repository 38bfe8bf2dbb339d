"""The score is full for whoever is right, and says where somebody is wrong."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.tools.train.encoder.test_encoder_heads import perfect, some_labels
from tools.train.encoder.heads import Fixed, Score, as_tensors, decide
from tools.train.encoder.labels import CLASSES, LANDMARK, PERSON

SIDE = 8
MACHINE = CLASSES.index("vending_machine")


def scored(said: Any, labels: Any) -> dict[str, Any]:
    score = Score()
    score.add(said, labels)
    return score.result()


def right(labels: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return decide(perfect(as_tensors(labels, "cpu")))


def with_machine(column: int, count: int = 4) -> dict[str, np.ndarray]:
    """Pictures of walls with a machine in one column."""
    labels = some_labels(count, side=SIDE)
    labels["thing"][:], labels["rank"][:] = CLASSES.index("wall"), 0
    labels["thing"][:, 2:5, column], labels["rank"][:, 2:5, column] = MACHINE, LANDMARK
    return labels


def test_whoever_is_right_has_a_full_score() -> None:
    labels = some_labels(30, side=SIDE)
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


def test_missed_and_imagined_people_are_told_apart() -> None:
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
    labels = some_labels(10, side=SIDE)
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
