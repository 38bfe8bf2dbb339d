"""Lines of a text that are kept to a few ones, or within the grammar."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.artifacts.manifest import Artifacts
from edge.inference.language import LanguageModel
from edge.reasoning.decoding_rules import DecodingContext, TextConstraint
from edge.reasoning.line_constraint import FormConstraint, LineConstraint, TextForms
from edge.state.reasoning_text import (
    AREAS,
    CROSSING,
    CROWDS,
    ENTERED_AREAS,
    SIDES,
    Plan,
    Progress,
    ReasoningText,
    Situation,
    Stop,
    Turn,
    TurnBack,
    format_text,
    parse_text,
)
from tests.support.scripted_model import decode_script

# One of a few lines: 7 begins it.

LINES = [(7, 1, 2, 9), (7, 1, 3, 9), (7, 4, 9)]


def chosen(constraint: LineConstraint, *tokens: int) -> list[int]:
    return [constraint.choose(token) for token in tokens]


@pytest.mark.parametrize("line", LINES)
def test_a_line_that_is_allowed_is_left_alone(line: tuple[int, ...]) -> None:
    constraint = LineConstraint(LINES)
    assert chosen(constraint, 5, 5, *line, 7, 8, 6) == [5, 5, *line, 7, 8, 6]
    assert not constraint.overruled


@pytest.mark.parametrize(
    ("lines", "tokens", "expected"),
    [
        (LINES, (7, 8, 8, 8, 8), [7, 1, 2, 9, 8]),
        (LINES[:2], (7, 8, 3, 9), [7, 1, 2, 9]),
        (LINES, (7, 4, 8, 6), [7, 4, 9, 6]),
    ],
    ids=["preferred line", "also where the model would rejoin another one", "what was chosen so far is kept"],
)
def test_a_token_that_no_line_has_there_is_replaced(
    lines: list[tuple[int, ...]], tokens: tuple[int, ...], expected: list[int]
) -> None:
    constraint = LineConstraint(lines)
    assert chosen(constraint, *tokens) == expected and constraint.overruled


def test_a_text_without_the_line_is_left_alone() -> None:
    constraint = LineConstraint(LINES)
    assert chosen(constraint, 1, 2, 3, 9) == [1, 2, 3, 9] and not constraint.overruled


def test_lines_that_begin_differently_are_no_guide() -> None:
    with pytest.raises(ValueError, match="same token"):
        LineConstraint([(1, 2), (2, 2)])


# Within the grammar: letters are the tokens.


def letters(text: str) -> list[int]:
    return [ord(letter) for letter in text]


FORMS = TextForms(letters)


def kept(text: str) -> str:
    """Return what becomes of a text whose letters the model chooses one after the other."""
    form = FormConstraint(FORMS)
    return "".join(chr(form.choose(ord(letter))) for letter in text)


SITUATIONS = st.builds(Situation, st.sampled_from(sorted(AREAS)), st.integers(0, len(CROWDS) - 1))
TURNS = st.builds(Turn, st.sampled_from(SIDES), st.sampled_from((*ENTERED_AREAS, CROSSING)), st.integers(0, 99))
PLANS = st.builds(Plan, st.one_of(TURNS, st.builds(Stop, st.integers(0, 99)), st.just(TurnBack())), st.booleans())


@given(SITUATIONS, PLANS)
def test_a_text_that_follows_the_grammar_is_left_alone(situation: Situation, plan: Plan) -> None:
    text = format_text(ReasoningText(situation, (), (), Progress(1, 2, 0), plan, ((1.0, 0.0), (2.0, 0.0), (3.0, 0.0))))
    assert kept(text) == text


@pytest.mark.parametrize(
    ("begun", "line"),
    [
        ("Situation: on a0", "Situation: on a sidewalk."),
        ("Situation: on l", "Situation: on a sidewalk."),
        ("Situation: in a sidewalk", "Situation: in a corridor."),
        ("Plan: turn left into the room in (", "Plan: turn left into the room in 3 m."),
        ("Plan: wait, then fly", "Plan: wait, then go straight to the corridor in 3 m."),
    ],
)
def test_a_line_that_leaves_the_grammar_becomes_one_that_begins_like_it(begun: str, line: str) -> None:
    assert kept(begun + 60 * "?").startswith(line + "\n?")


def test_a_plan_that_was_completed_for_the_model_is_not_the_models() -> None:
    for written, its_own in (("Plan: stop in 4 m.\n", True), ("Plan: stop in (1.0, 0.0)", False)):
        constraint = TextConstraint(DecodingContext(keeps_form=True), letters, FORMS)
        text = "".join(chr(constraint.choose(ord(letter))) for letter in written).split("\n")[0]
        assert constraint.replace_line(text) is None and constraint.has_plan is its_own


@pytest.mark.parametrize("text", ["Progress: what?\n", "no such line\n", "Objects: a Plan: x\n", ""])
def test_other_lines_are_left_alone(text: str) -> None:
    assert kept(text) == text


@given(st.text("Situaon: cdhrle.Pw,\n", max_size=80))
def test_tokens_that_are_forced_are_taken_whatever_the_model_chooses(text: str) -> None:
    form = FormConstraint(FORMS)
    for letter in text:
        form.choose(ord(letter))
    forced = form.forced()
    assert tuple(form.choose(0) for _ in forced) == forced


@pytest.mark.parametrize("tokens", [lambda _: [], lambda _: [1], lambda text: [len(text)], lambda text: [1, *text[:9]]])
def test_a_tokenizer_that_does_not_tell_the_lines_apart_gives_no_form(tokens: Callable[[str], list[int]]) -> None:
    assert TextForms(tokens).heads == {}


def test_the_language_model_keeps_the_form_where_the_context_asks_for_it(artifacts: Artifacts) -> None:
    language = LanguageModel(artifacts)
    text = "Situation: on left 6 m.\nPlan: turn left into the room in (1.0, 0.0)\nwaypoints: (1.0, 0.0)"
    free, _ = decode_script(language, text, DecodingContext())
    assert free.text == text
    kept, _ = decode_script(language, text, DecodingContext(keeps_form=True))
    parts = parse_text(kept.text)
    assert parts.situation is not None and parts.plan is not None and parts.plan.action.distance_m == 3
