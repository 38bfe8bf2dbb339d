"""Progress that may follow a text: onward, and back only when the model chooses it twice."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.artifacts.manifest import Artifacts
from edge.inference.language import LanguageModel
from edge.reasoning.decoding_rules import (
    BACK,
    DONE,
    EITHER_WAY,
    FREE,
    ONWARD,
    DecodingContext,
    TextConstraint,
    TurnDistances,
    TurnObservation,
    allowed_progress,
)
from edge.state.reasoning_text import MAX_COUNT, Progress, format_progress, parse_progress
from tests.support.scripted_model import decode_script

PROGRESS = st.integers(0, 6).flatmap(
    lambda steps: st.one_of(
        st.just(Progress(steps + 1, steps, 0)),
        *([st.builds(Progress, st.integers(1, steps), st.just(steps), st.integers(0, 9))] if steps else []),
    )
)


@given(PROGRESS, st.sampled_from([ONWARD, EITHER_WAY]))
def test_the_number_of_turns_stays_and_none_is_left_out_or_undone_but_either_way(before: Progress, follow: str) -> None:
    allowed = allowed_progress(before, follow)
    assert allowed[0] == before, "the same progress is preferred"
    assert {after.steps for after in allowed} == {before.steps}
    steps = {after.step - before.step for after in allowed}
    assert steps <= {-1, 0, 1} and (-1 in steps) == (follow == EITHER_WAY and before.step > 1)
    assert all(parse_progress(f"Progress: {format_progress(after)}") == after for after in allowed)


def test_counts_end_where_the_grammar_does() -> None:
    assert all(after.passed <= MAX_COUNT for after in allowed_progress(Progress(1, 2, MAX_COUNT), ONWARD))


def test_free_is_free_and_an_unknown_rule_is_refused() -> None:
    assert allowed_progress(Progress(1, 2, 0), FREE) == ()
    with pytest.raises(ValueError, match="backwards"):
        allowed_progress(Progress(1, 2, 0), "backwards")


def letters(text: str) -> list[int]:
    return [ord(letter) for letter in text]


def begun(context: DecodingContext, line: str) -> TextConstraint:
    """Return the constraint of a text whose progress line the model would begin so."""
    constraint = TextConstraint(context, letters)
    for letter in f"Progress: {line}":
        constraint.choose(ord(letter))
    return constraint


def test_going_back_counts_when_the_model_chooses_it_twice_in_a_row() -> None:
    text, before = "Progress: turn 2 of 3, passed 0.", Progress(2, 3, 0)
    first = DecodingContext()
    assert (first.follow, first.before) == (FREE, None)
    context = first.after(text, TextConstraint(first, letters))
    assert context == DecodingContext(before, ONWARD)
    once = begun(context, "turn 1")
    assert once.overruled and once.refused == BACK
    again = context.after(text, once)
    assert again == DecodingContext(before, EITHER_WAY) and not begun(again, "turn 1").overruled
    assert again.after(text, TextConstraint(again, letters)) == DecodingContext(before, ONWARD)
    assert context.after("no such line", TextConstraint(context, letters)).before == before


@pytest.mark.parametrize(
    ("before", "may_be_done", "line", "refused"),
    [
        (Progress(2, 3, 0), False, "turn 2 of 4", None),
        (Progress(2, 3, 0), False, "last", None),
        (Progress(2, 3, 0), False, "turn 2 of 3, passed 9", None),
        (Progress(2, 3, 0), False, "turn 3", DONE),
        (Progress(2, 2, 0), False, "last", DONE),
        (Progress(2, 3, 1), False, "turn 3 of 3, passed 2.", DONE),
        (Progress(2, 3, 1), False, "turn 3 of 4, passed 1.", DONE),
        (Progress(2, 3, 1), False, "turn 1 of 3, passed 7.", BACK),
    ],
)
def test_the_kind_of_a_refused_progress_is_found_whatever_the_rest_of_its_line(
    before: Progress, may_be_done: bool, line: str, refused: str | None
) -> None:
    context = DecodingContext(before, ONWARD, turn_may_be_done=may_be_done)
    constraint = begun(context, line)
    assert constraint.overruled and constraint.refused == refused
    follow = EITHER_WAY if refused == BACK else ONWARD
    assert context.after(f"Progress: {format_progress(before)}", constraint).follow == follow


def test_a_turn_that_may_be_done_is_not_refused() -> None:
    assert not begun(DecodingContext(Progress(2, 3, 0), ONWARD), "turn 3").overruled


@pytest.mark.parametrize(("lines", "complete"), [(["Plan: stop now."], True), (["Objects: none."], False), ([], False)])
def test_a_text_has_a_plan_once_its_line_is_complete(lines: list[str], complete: bool) -> None:
    constraint = TextConstraint(DecodingContext(), letters)
    for line in lines:
        constraint.replace_line(line)
    assert constraint.has_plan == complete


# In the decoding loop


def decode(artifacts: Artifacts, text: str, context: DecodingContext) -> tuple[str, TextConstraint]:
    """Return the decoded text and its constraint, of a model that would write `text`."""
    language = LanguageModel(artifacts, threads=1)
    made, constraint = decode_script(language, text, context)
    return made.text, constraint


TEXT = "Situation: in a corridor.\nMotion: nobody near.\nProgress: {}\nPlan: {}.\nwaypoints: (2.0, 0.1)"
BEFORE = Progress(2, 3, 1)
LAST_LEG = Progress(2, 1, 0)


@pytest.mark.parametrize(
    ("context", "progress"),
    [
        *((DecodingContext(BEFORE, f), p) for f in (ONWARD, EITHER_WAY) for p in (BEFORE, Progress(2, 3, 2))),
        (DecodingContext(BEFORE, ONWARD), Progress(3, 3, 0)),
        (DecodingContext(LAST_LEG, EITHER_WAY), Progress(1, 1, 0)),
        (DecodingContext(), Progress(9, 9, 9)),
    ],
)
def test_a_text_that_is_allowed_is_left_as_the_model_writes_it(
    artifacts: Artifacts, context: DecodingContext, progress: Progress
) -> None:
    text = TEXT.format(format_progress(progress), "turn left into the room in 3 m")
    made, constraint = decode(artifacts, text, context)
    assert (made, constraint.overruled, constraint.turn) == (text, False, TurnObservation("left", 3.0))


@pytest.mark.parametrize(
    ("context", "wrong", "expected"),
    [
        *(
            (DecodingContext(BEFORE, ONWARD), wrong, allowed_progress(BEFORE, ONWARD))
            for wrong in (Progress(1, 3, 0), Progress(2, 2, 1), Progress(4, 3, 0), Progress(2, 3, 7))
        ),
        (DecodingContext(LAST_LEG, ONWARD), Progress(1, 1, 0), [LAST_LEG]),
        (DecodingContext(BEFORE, ONWARD, None, turn_may_be_done=False), Progress(3, 3, 0), [BEFORE]),
    ],
)
def test_a_text_that_is_not_allowed_is_held_to_the_grammar(
    artifacts: Artifacts, context: DecodingContext, wrong: Progress, expected: Sequence[Progress]
) -> None:
    made, constraint = decode(artifacts, TEXT.format(format_progress(wrong), "turn back"), context)
    assert constraint.overruled and parse_progress(made) in expected
    assert made.startswith("Situation: in a corridor.\n") and made.endswith("Plan: turn back.\nwaypoints: (2.0, 0.1)")


@pytest.mark.parametrize(("left_m", "when"), [((3.0, 3.0, 2.9), "in 3 m"), ((0.5, 0.2), "now"), ((11.0,), "in 12 m")])
def test_a_turn_that_is_nearer_by_odometry_is_written_nearer(
    artifacts: Artifacts, left_m: tuple[float, ...], when: str
) -> None:
    text = TEXT.format(format_progress(BEFORE), "turn left into the corridor {}")
    context = DecodingContext(BEFORE, ONWARD, TurnDistances("left", left_m))
    made, constraint = decode(artifacts, text.format("in 12 m"), context)
    assert made == text.format(when)
    assert constraint.turn == TurnObservation("left", 12.0)


def test_another_turn_is_as_far_as_the_model_writes(artifacts: Artifacts) -> None:
    text = TEXT.format(format_progress(Progress(3, 3, 0)), "turn left into the corridor in 12 m")
    assert decode(artifacts, text, DecodingContext(BEFORE, ONWARD, TurnDistances("left", (1.0, 1.0, 1.0))))[0] == text
