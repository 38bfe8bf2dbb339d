"""What a generation may say of its progress: onward from what was said, and back only when it is meant twice."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.reasoning.decoding_rules import EITHER_WAY, FOLLOWS, FREE, ONWARD, LineConstraint, allowed_progress
from edge.state.reasoning_text import MAX_COUNT, Progress, format_progress, parse_progress

PROGRESS = st.integers(0, 6).flatmap(
    lambda steps: st.one_of(
        st.just(Progress(steps + 1, steps, 0)),
        *([st.builds(Progress, st.integers(1, steps), st.just(steps), st.integers(0, 9))] if steps else []),
    )
)


@given(PROGRESS, st.sampled_from([ONWARD, EITHER_WAY]))
def test_what_was_said_may_always_be_said_again_and_is_preferred(before: Progress, follow: str) -> None:
    assert allowed_progress(before, follow)[0] == before


@given(PROGRESS, st.sampled_from(FOLLOWS))
def test_a_way_keeps_its_number_of_turns(before: Progress, follow: str) -> None:
    assert {after.steps for after in allowed_progress(before, follow)} <= {before.steps}


@given(PROGRESS)
def test_onward_no_turn_is_undone_and_none_is_left_out(before: Progress) -> None:
    assert {after.step - before.step for after in allowed_progress(before, ONWARD)} <= {0, 1}


@given(PROGRESS)
def test_either_way_the_turn_before_may_be_the_next_one_again(before: Progress) -> None:
    steps = {after.step - before.step for after in allowed_progress(before, EITHER_WAY)}
    assert (-1 in steps) == (before.step > 1)


@given(PROGRESS, st.sampled_from(FOLLOWS))
def test_every_follower_is_of_the_grammar(before: Progress, follow: str) -> None:
    for after in allowed_progress(before, follow):
        assert parse_progress(f"Progress: {format_progress(after)}") == after


def test_counts_end_where_the_grammar_does() -> None:
    assert all(after.passed <= MAX_COUNT for after in allowed_progress(Progress(1, 2, MAX_COUNT), ONWARD))


def test_free_is_free_and_an_unknown_word_is_refused() -> None:
    assert allowed_progress(Progress(1, 2, 0), FREE) == ()
    with pytest.raises(ValueError, match="backwards"):
        allowed_progress(Progress(1, 2, 0), "backwards")


# The line: 7 begins it.

LINES = [(7, 1, 2, 9), (7, 1, 3, 9), (7, 4, 9)]


def chosen(constraint: LineConstraint, *tokens: int) -> list[int]:
    return [constraint.choose(token) for token in tokens]


@pytest.mark.parametrize("line", LINES)
def test_a_line_that_is_allowed_is_left_alone(line: tuple[int, ...]) -> None:
    constraint = LineConstraint(LINES)
    assert chosen(constraint, 5, 5, *line, 7, 8, 6) == [5, 5, *line, 7, 8, 6]
    assert not constraint.overruled


def test_a_token_that_no_line_has_there_becomes_the_preferred_lines() -> None:
    constraint = LineConstraint(LINES)
    assert chosen(constraint, 7, 8, 8, 8, 8) == [7, 1, 2, 9, 8]
    assert constraint.overruled


def test_a_line_that_was_overruled_goes_on_as_the_preferred_one_whatever_the_model_chooses() -> None:
    assert chosen(LineConstraint([(7, 1, 2, 9), (7, 1, 3, 9)]), 7, 8, 3, 9) == [7, 1, 2, 9]


def test_what_the_model_has_chosen_so_far_is_kept() -> None:
    assert chosen(LineConstraint(LINES), 7, 4, 8, 6) == [7, 4, 9, 6]


def test_a_text_without_the_line_is_left_alone() -> None:
    constraint = LineConstraint(LINES)
    assert chosen(constraint, 1, 2, 3, 9) == [1, 2, 3, 9] and not constraint.overruled


def test_lines_that_begin_differently_are_no_guide() -> None:
    with pytest.raises(ValueError, match="same token"):
        LineConstraint([(1, 2), (2, 2)])
