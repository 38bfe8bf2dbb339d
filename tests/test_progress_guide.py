"""What a generation may say of its progress: onward from what was said, and back only when it is meant twice."""

from __future__ import annotations

from typing import cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.instruction_memory import InstructionMemory
from edge.language import Call, Chunk, LanguageModel
from edge.manifest import Artifacts
from edge.progress_guide import EITHER_WAY, FOLLOWS, FREE, ONWARD, LineGuide, followers
from edge.reasoning_text import MAX_COUNT, Progress, format_progress, parse_progress

PROGRESS = st.integers(0, 6).flatmap(
    lambda steps: st.one_of(
        st.just(Progress(steps + 1, steps, 0)),
        *([st.builds(Progress, st.integers(1, steps), st.just(steps), st.integers(0, 9))] if steps else []),
    )
)


@given(PROGRESS, st.sampled_from([ONWARD, EITHER_WAY]))
def test_what_was_said_may_always_be_said_again_and_is_preferred(before: Progress, follow: str) -> None:
    assert followers(before, follow)[0] == before


@given(PROGRESS, st.sampled_from(FOLLOWS))
def test_a_way_keeps_its_number_of_turns(before: Progress, follow: str) -> None:
    assert {after.steps for after in followers(before, follow)} <= {before.steps}


@given(PROGRESS)
def test_onward_no_turn_is_undone_and_none_is_left_out(before: Progress) -> None:
    assert {after.step - before.step for after in followers(before, ONWARD)} <= {0, 1}


@given(PROGRESS)
def test_either_way_the_turn_before_may_be_the_next_one_again(before: Progress) -> None:
    steps = {after.step - before.step for after in followers(before, EITHER_WAY)}
    assert (-1 in steps) == (before.step > 1)


@given(PROGRESS, st.sampled_from(FOLLOWS))
def test_every_follower_is_of_the_grammar(before: Progress, follow: str) -> None:
    for after in followers(before, follow):
        assert parse_progress(f"Progress: {format_progress(after)}") == after


def test_counts_end_where_the_grammar_does() -> None:
    assert all(after.passed <= MAX_COUNT for after in followers(Progress(1, 2, MAX_COUNT), ONWARD))


def test_free_is_free_and_an_unknown_word_is_refused() -> None:
    assert followers(Progress(1, 2, 0), FREE) == ()
    with pytest.raises(ValueError, match="backwards"):
        followers(Progress(1, 2, 0), "backwards")


# The line: 7 begins it.

LINES = [(7, 1, 2, 9), (7, 1, 3, 9), (7, 4, 9)]


def chosen(guide: LineGuide, *tokens: int) -> list[int]:
    return [guide.choose(token) for token in tokens]


@pytest.mark.parametrize("line", LINES)
def test_a_line_that_is_allowed_is_left_alone(line: tuple[int, ...]) -> None:
    guide = LineGuide(LINES)
    assert chosen(guide, 5, 5, *line, 7, 8, 6) == [5, 5, *line, 7, 8, 6]
    assert not guide.overruled


def test_a_token_that_no_line_has_there_becomes_the_preferred_lines() -> None:
    guide = LineGuide(LINES)
    assert chosen(guide, 7, 8, 8, 8, 8) == [7, 1, 2, 9, 8]
    assert guide.overruled


def test_what_the_model_has_chosen_so_far_is_kept() -> None:
    assert chosen(LineGuide(LINES), 7, 4, 8, 6) == [7, 4, 9, 6]


def test_a_text_without_the_line_is_left_alone() -> None:
    guide = LineGuide(LINES)
    assert chosen(guide, 1, 2, 3, 9) == [1, 2, 3, 9] and not guide.overruled


def test_lines_that_begin_differently_are_no_guide() -> None:
    with pytest.raises(ValueError, match="same token"):
        LineGuide([(1, 2), (2, 2)])


# What is remembered of it


def test_before_anything_was_said_anything_may_be() -> None:
    assert InstructionMemory(None).follow == FREE


def test_going_back_counts_when_it_is_said_twice_in_a_row() -> None:
    memory = InstructionMemory(None)
    memory.heard("Progress: turn 2 of 3, passed 0.")
    assert memory.follow == ONWARD
    memory.heard("Progress: turn 2 of 3, passed 0.", overruled=True)
    assert memory.follow == EITHER_WAY
    memory.heard("Progress: turn 2 of 3, passed 0.")
    assert memory.follow == ONWARD


# In the decoding loop


class Script:
    """A decode call that chooses tokens by rote, whatever it is fed; it keeps what it was fed."""

    def __init__(self, ids: list[int]) -> None:
        self.ids, self.fed = ids, list[int]()

    def __call__(self, chunk: Chunk, past: int, kv: object, interrupt: object) -> int:
        self.fed += list(chunk.ids)
        return self.ids.pop(0)


def said(artifacts: Artifacts, text: str, before: Progress | None, follow: str) -> tuple[str, bool, bool]:
    """(text, overruled, whether what was fed is what was said) of a model that would say `text`."""
    language = LanguageModel(artifacts, threads=1)
    ids = language._tokenizer.encode(text, add_special_tokens=False).ids
    script = Script([*ids, language.runtime.im_end_id])
    language.prefill_call = language.decode_call = cast("Call", script)
    tail = [language.prompt.tail((), before)]
    guide = language.guide(before, follow)
    made = language.generate(tail, max_new_tokens=60, cancelled=lambda: False, guide=guide)
    fed = script.fed[made.prompt_tokens :]
    return made.text, made.overruled, fed == list(made.token_ids)


TEXT = "Situation: in a corridor.\nMotion: nobody near.\nProgress: {}\nPlan: turn left.\nwaypoints: (2.0, 0.1)"


@pytest.mark.parametrize("follow", [ONWARD, EITHER_WAY])
@pytest.mark.parametrize("progress", [Progress(2, 3, 1), Progress(2, 3, 2), Progress(3, 3, 0)])
def test_a_text_that_goes_onward_is_left_as_the_model_says_it(
    artifacts: Artifacts, progress: Progress, follow: str
) -> None:
    text = TEXT.format(format_progress(progress))
    assert said(artifacts, text, Progress(2, 3, 1), follow) == (text, False, True)


@pytest.mark.parametrize("wrong", [Progress(1, 3, 0), Progress(2, 2, 1), Progress(4, 3, 0), Progress(2, 3, 7)])
def test_a_text_that_does_not_repeats_what_was_said_and_the_model_hears_it(
    artifacts: Artifacts, wrong: Progress
) -> None:
    text, overruled, heard = said(artifacts, TEXT.format(format_progress(wrong)), Progress(2, 3, 1), ONWARD)
    progress = parse_progress(text)
    assert overruled and heard and progress in followers(Progress(2, 3, 1), ONWARD)
    assert text.startswith("Situation: in a corridor.\n") and text.endswith("Plan: turn left.\nwaypoints: (2.0, 0.1)")


def test_a_turn_is_undone_where_either_way_may_be_said(artifacts: Artifacts) -> None:
    text = TEXT.format("turn 1 of 1, passed 0.")
    last_leg = Progress(2, 1, 0)
    assert said(artifacts, text, last_leg, ONWARD)[0] == TEXT.format("last leg of 1, passed 0.")
    assert said(artifacts, text, last_leg, EITHER_WAY) == (text, False, True)


def test_with_nothing_before_the_model_says_what_it_will(artifacts: Artifacts) -> None:
    text = TEXT.format("turn 9 of 9, passed 9.")
    assert said(artifacts, text, None, FREE) == (text, False, True)
