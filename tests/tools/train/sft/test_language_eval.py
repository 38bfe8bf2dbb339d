"""What the language model says is held against what is true, also where it hears only itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from edge.reasoning.decoding_rules import BACK, EITHER_WAY, FREE, ONWARD, DecodingContext
from edge.state.reasoning_text import Plan, Progress, ReasoningText, Stop, TurnBack, format_progress, format_text
from tests.support.train.train_drives import WORDINGS, made_up_drive
from tools.train.config.sft import EvalConfig
from tools.train.samples.anchors import Anchor, Drawn, anchors_of
from tools.train.sft.language_eval import Score, closed_loop


@pytest.fixture(scope="module")
def anchors() -> list[Anchor]:
    return anchors_of(made_up_drive("a"))


def test_the_truth_is_right_in_everything(anchors: list[Anchor]) -> None:
    score = Score(2.0)
    for anchor in anchors:
        score.add(format_text(anchor.reasoning), anchor)
    numbers = score.numbers()
    assert numbers["answers"] == len(anchors) == 13
    shares = ("waypoints_parsable", "progress_parsable", "progress_right", "change_right", "side_right")
    assert all(numbers[key] == 1.0 for key in (*shares, "landmark_precision", "landmark_recall"))
    assert numbers["sides"] == 9
    assert max(numbers["waypoint_error_m"]) < 0.08


def test_changes_are_where_repeating_the_last_text_is_wrong(anchors: list[Anchor]) -> None:
    score = Score(2.0)
    for anchor in anchors:
        repeated = anchor.before(2.0) or anchor.progress
        truth = format_progress(anchor.progress)
        score.add(format_text(anchor.reasoning).replace(truth, format_progress(repeated)), anchor)
    numbers = score.numbers()
    # passed grows at frames 30 and 60, the turn is done at 90; each is news at two of the anchors.
    assert numbers["changes"] == 6
    assert numbers["change_right"] == 0.0
    assert numbers["progress_right"] == pytest.approx(7 / 13)


def test_nothing_is_right_about_a_text_of_another_form(anchors: list[Anchor]) -> None:
    score = Score(2.0)
    score.add("I see a desk on the left.", anchors[3])
    numbers = score.numbers()
    shares = ("waypoints_parsable", "progress_parsable", "progress_right", "side_right", "landmark_recall")
    assert all(numbers[key] == 0.0 for key in shares)
    assert numbers["landmark_precision"] is None and numbers["waypoint_error_m"] is None


def test_turning_back_is_scored_where_it_is_true_and_where_it_is_said(anchors: list[Anchor]) -> None:
    def with_plan(action: Stop | TurnBack) -> ReasoningText:
        return replace(anchors[0].reasoning, plan=Plan(action))

    score = Score(2.0)
    back, on = with_plan(TurnBack()), with_plan(Stop(3))
    for truth, said in ((back, back), (back, on), (back, on), (on, back), (on, on)):
        score.add(format_text(said), replace(anchors[0], reasoning=truth))
    numbers = score.numbers()
    assert (numbers["backs"], numbers["back_recall"], numbers["back_precision"]) == (3, pytest.approx(1 / 3), 0.5)


class Parrot:
    """Answers every anchor with one text, and keeps its prompts."""

    def __init__(self, texts: Sequence[str]) -> None:
        self.texts = list(texts)
        self.told: list[tuple[str, int, Progress | None]] = []
        self.guided: list[tuple[Progress | None, str]] = []

    def constraint(self, known: DecodingContext) -> SimpleNamespace:
        """One whose first answer would go back."""
        self.guided.append((known.before, known.follow))
        return SimpleNamespace(refused=BACK if len(self.guided) == 1 else None)

    def generate(self, questions: Sequence[tuple[Anchor, Drawn]], constraints: Sequence[object]) -> list[str]:
        assert len(constraints) == len(questions)
        self.told += [(anchor.drive_id, anchor.k, drawn.before) for anchor, drawn in questions]
        assert all(drawn.wording in WORDINGS and not drawn.waypoints_only for _, drawn in questions)
        return [self.texts.pop(0) for _ in questions]


def test_along_a_drive_the_prompt_has_the_models_own_last_progress() -> None:
    anchors = [*anchors_of(made_up_drive("a", 60)), *anchors_of(made_up_drive("b", 25))]
    says = [
        "Progress: turn 1 of 1, passed 4.",
        "nothing of that form",
        "nor this",
        "Progress: last leg of 1, passed 0.",
    ]
    parrot = Parrot([*says, "Progress: turn 1 of 1, passed 9."])
    numbers = closed_loop(parrot, anchors, 2.0, np.random.default_rng(0))  # type: ignore[arg-type]
    assert parrot.told == [
        ("a", 0, None),
        ("b", 0, None),
        ("a", 20, Progress(1, 1, 4)),
        ("b", 20, None),
        ("a", 40, Progress(1, 1, 4)),
    ]
    assert numbers["answers"] == 5 and numbers["progress_parsable"] == 0.6
    assert parrot.guided == [
        (None, FREE), (None, FREE), (Progress(1, 1, 4), EITHER_WAY), (None, FREE), (Progress(1, 1, 4), ONWARD),
    ]  # fmt: skip


def test_a_gap_that_is_no_whole_second_is_refused() -> None:
    with pytest.raises(ValueError, match="whole seconds"):
        EvalConfig(gap_s=1.5)
