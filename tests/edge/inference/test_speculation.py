"""Speculative decoding changes the number of calls, and no bit of a generation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.artifacts.manifest import LEAST_ROWS, MOST_ROWS, Artifacts, load_artifacts
from edge.inference.calls import Call, Chunk
from edge.inference.graph import CancelledError, Interrupt
from edge.inference.language import Generation, LanguageModel
from edge.inference.speculation import (
    FIRST_TEXT,
    MOST_FOLLOWERS,
    Drafter,
    EarlierTexts,
    Speculator,
    TextUnderWay,
    most_rows,
    next_rows,
)
from edge.reasoning.decoding_rules import EITHER_WAY, ONWARD, DecodingContext, TurnDistances
from edge.reasoning.line_constraint import LineConstraint
from edge.reasoning.prompt import Segment
from edge.state.reasoning_text import Progress, parse_text
from tests.edge.inference.test_language import SENTENCE, frames
from tests.support.scripted_model import decode_script, ids_of

LINE_END, NUMBER = 9, 5
EVEN = dict.fromkeys(range(LEAST_ROWS, MOST_ROWS + 1), 1.0)
"""Durations of a device on which every call takes as long."""
TOKENS = st.lists(st.integers(1, 9), max_size=40)


def ends_line(token: int) -> bool:
    return token == LINE_END


def speculator(call_ns: Mapping[int, float] = EVEN) -> Speculator:
    return Speculator([1, LINE_END], call_ns, ends_line, lambda token: token == NUMBER)


def drafter(previous: list[int], taken: list[int]) -> Drafter:
    texts = EarlierTexts([1, LINE_END])
    texts.put(previous)
    draft = Drafter(texts, ends_line)
    for token in taken:
        draft.take(token)
    return draft


# Guesses


@given(TOKENS, st.integers(0, 40), st.integers(1, 16))
def test_a_repeated_text_is_guessed_from_any_position(text: list[int], at: int, most: int) -> None:
    lines = "".join(map(str, text)).split(str(LINE_END))
    if len(set(lines)) == len(lines):
        assert drafter(text, text[:at]).guess(most)[:1] == text[at : at + 1]


@given(TOKENS, TOKENS, st.integers(0, 16))
def test_no_text_has_more_guesses_than_wanted(previous: list[int], taken: list[int], most: int) -> None:
    assert len(drafter(previous, taken).guess(most)) <= most


@pytest.mark.parametrize(
    ("previous", "taken", "expected"),
    [
        ([1, 2, 3, 9, 4, 5, 9], [1, 7], [3, 9, 4]),
        ([1, 2, 3, 9, 4, 5, 9], [1, 7, 7, 3], [9, 4, 5]),
        ([1, 2, 3, 9, 4, 5, 9, 6, 7], [1, 2, 3, 9, 6], [7]),
    ],
    ids=["a number changed", "an item more", "a line less"],
)
def test_a_line_is_aligned_with_the_previous_text(previous: list[int], taken: list[int], expected: list[int]) -> None:
    assert drafter(previous, taken).guess(3) == expected


def test_an_item_that_an_earlier_text_had_is_guessed_from_there() -> None:
    texts = EarlierTexts([1, 6, 7, LINE_END])
    texts.put([1, 2, 3, LINE_END])
    draft = Drafter(texts, ends_line)
    for token in (1, 6):
        draft.take(token)
    assert draft.guess(1) == [7]


def test_hours_of_new_texts_take_bounded_memory_and_the_newest_are_known() -> None:
    texts = EarlierTexts([1, LINE_END])
    for token in range(2, 20_000, 2):
        texts.put([token, token + 1])
        assert len(texts) <= MOST_FOLLOWERS
    assert texts.follower([19_998]) == 19_999
    assert texts.follower([2]) is None


def test_what_the_rules_force_comes_first() -> None:
    constraint = LineConstraint([(7, 1, 2, 9), (7, 1, 3, 9)])
    assert constraint.forced() == ()
    constraint.choose(7)
    assert constraint.forced() == (1,)
    constraint.choose(8)
    constraint.choose(8)
    assert constraint.forced() == (9,)


# Their number


def test_the_more_guesses_are_accepted_the_more_are_verified() -> None:
    rising = {rows: 1.0 + 0.2 * rows for rows in EVEN}
    wrong, right = speculator(rising), speculator(rising)
    for _ in range(300):
        wrong.record(1, accepted=False)
        right.record(1, accepted=True)
    guesses = [1] * 15
    assert wrong.length(guesses, 0, 1, math.inf) == 1 < right.length(guesses, 0, 1, math.inf) == 15


def test_numbers_have_an_acceptance_of_their_own() -> None:
    rising = {rows: 1.0 + 0.2 * rows for rows in EVEN}
    some = speculator(rising)
    for _ in range(300):
        some.record(NUMBER, accepted=False)
        some.record(1, accepted=True)
    assert some.length([1, 1, 1, NUMBER, 1, 1], 0, 1, math.inf) == 3


def test_no_call_with_guesses_is_longer_than_the_gap_between_two_ticks() -> None:
    some = speculator({rows: 1.0 + 0.2 * rows for rows in EVEN})
    assert some.length([1] * 15, 15, 1, 2.2) == 5
    assert some.length([1] * 15, 15, 1, 0.0) == 1, "a call of the fewest rows is never refused"


def test_no_guess_exceeds_the_limit_of_the_text() -> None:
    some = speculator()
    text = TextUnderWay(3, None, drafter([1, 2, 3, 4, 5, 6], [1]), [1])
    assert len(some.guess(text, 1, math.inf)) <= 2


def test_a_call_has_a_permitted_number_of_rows() -> None:
    some = speculator({2: 1.0, 4: 1.1, 8: 9.0})
    assert [next_rows(some.rows, tokens) for tokens in (1, 2, 3, 4, 5, 8, 9)] == [2, 2, 4, 4, 8, 8, 8]
    assert [most_rows(some.rows, room) for room in (1, 2, 3, 4, 7, 8, 99)] == [2, 2, 2, 4, 4, 8, 8]
    assert some.length([1] * 7, 7, 1, math.inf) == 3


def test_a_short_call_that_was_measured_on_a_busy_machine_counts_as_no_longer_than_a_long_one() -> None:
    some = speculator({2: 9.0, 4: 1.1, 8: 1.2})
    assert some.length([1], 1, 1, 2.0) == 1 and some.length([1] * 7, 7, 1, 2.0) == 7


@pytest.mark.parametrize("durations", [{4: 1.0}, {2: 0.0}, {2: 1.0, MOST_ROWS + 1: 1.0}])
def test_durations_that_make_no_sense_are_refused(durations: dict[int, float]) -> None:
    with pytest.raises(ValueError, match="durations above 0"):
        speculator(durations)


# With the decoding rules: a scripted model, so that guesses are right, wrong, and made beyond a replaced line

TEXT = "Situation: in a {}.\nObjects: doorway left {} m.\nProgress: {}\nPlan: {}.\nwaypoints: (2.0, 0.{})"
TEXTS = st.builds(
    TEXT.format,
    st.sampled_from(["corridor", "room, few people"]),
    st.integers(1, 12),
    st.sampled_from(["turn 2 of 3, passed 1.", "turn 3 of 3, passed 0.", "turn 1 of 3, passed 0.", "last leg of 3."]),
    st.sampled_from(["turn left into the room in 9 m", "stop now", "turn back", "turn left into the room now"]),
    st.integers(0, 9),
)
CONTEXTS = st.builds(
    DecodingContext,
    st.just(Progress(2, 3, 1)),
    st.sampled_from([ONWARD, EITHER_WAY]),
    st.sampled_from([None, TurnDistances("left", (3.0, 3.0, 2.9))]),
    st.booleans(),
)


Models = tuple[LanguageModel, LanguageModel]
"""One that guesses nothing, and one whose guesses a test provides."""


def open_models(artifacts: Artifacts) -> Models:
    return LanguageModel(artifacts, threads=1), LanguageModel(artifacts, threads=1)


@pytest.fixture(scope="module")
def models(artifacts: Artifacts) -> Models:
    return open_models(artifacts)


@pytest.fixture(scope="module")
def scripted(artifacts: Artifacts) -> Models:
    """Models whose graphs a script replaces."""
    return open_models(artifacts)


@pytest.mark.slow
@settings(max_examples=30)
@given(TEXTS, TEXTS, CONTEXTS, st.integers(1, 60))
def test_a_constrained_text_is_the_same_with_any_guesses(
    scripted: Models, previous: str, text: str, context: DecodingContext, most: int
) -> None:
    plain, guessing = scripted
    guessing.speculator = _even(guessing)
    guessing.speculator.end(ids_of(guessing, previous))
    expected, constraint = decode_script(plain, text, context, most)
    found, constraint_found = decode_script(guessing, text, context, most)
    assert (found.token_ids, found.text) == (expected.token_ids, expected.text)
    for name in ("overruled", "refused", "planned", "has_plan", "turn"):
        assert getattr(constraint_found, name) == getattr(constraint, name)


def test_a_repeated_text_takes_few_calls(scripted: Models) -> None:
    text = TEXT.format("corridor", 4, "turn 2 of 3, passed 1.", "stop now", 1)
    _, guessing = scripted
    guessing.speculator = _even(guessing)
    guessing.speculator.end(ids_of(guessing, text))
    made, _ = decode_script(guessing, text, DecodingContext())
    assert made.accepted == made.guessed >= 20
    assert len(made.call_tokens) <= math.ceil((made.new_tokens + 1) / MOST_ROWS)


@pytest.mark.parametrize("prompt_tokens", range(450, 458))
def test_up_to_the_end_of_the_context_a_call_has_a_permitted_number_of_rows(
    scripted: Models, prompt_tokens: int
) -> None:
    """Every guess is right, so that the last calls are as long as the context allows."""
    _, guessing = scripted
    token, permitted, fed = ids_of(guessing, "corridor")[0], (2, 4, 8), list[int]()
    guessing.rows = permitted
    guessing.guess_for(dict.fromkeys(permitted, 1.0))
    assert guessing.speculator is not None
    guessing.speculator.end([token] * guessing.runtime.max_context)

    def repeat(chunk: Chunk, *_: object) -> list[int]:
        fed.append(len(chunk.ids))
        return [token] * len(chunk.ids)

    guessing.kept_ids = ()
    guessing.prefill_call, guessing.decode_call = cast("Call", lambda *_: []), cast("Call", repeat)
    segments = [Segment((token,) * prompt_tokens, None)]
    made = guessing.generate(segments, max_new_tokens=guessing.runtime.max_context, cancelled=lambda: False)
    assert made.prompt_tokens + made.new_tokens == guessing.runtime.max_context - 1
    assert 8 in fed and set(fed) <= set(permitted)


def test_the_first_text_is_guessed_from_one_that_the_grammar_writes() -> None:
    parts = parse_text(FIRST_TEXT)
    assert None not in (parts.situation, parts.objects, parts.people, parts.progress, parts.plan, parts.waypoints)


def _even(model: LanguageModel) -> Speculator:
    model.rows = tuple(EVEN)
    return Speculator(ids_of(model, FIRST_TEXT), EVEN, model.ends_line, lambda _: False)


# With real graphs


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Artifacts:
    """`nano` with an int8 prefill and an int4 decode graph."""
    from export.model.config import PRESETS
    from export.model.network import build
    from export.quantize.precision import Precision
    from tests.support.artifact_directory import write_artifacts

    directory = tmp_path_factory.mktemp("pair")
    precisions = {"language_model.prefill": Precision("int8"), "language_model.decode": Precision("int4-b32")}
    return load_artifacts(write_artifacts(build(PRESETS["nano"], 0), directory, pair=True, precisions=precisions))


@pytest.fixture(scope="module")
def dynamic(tmp_path_factory: pytest.TempPathFactory) -> Artifacts:
    """`nano` with one graph that rounds all rows of a call together."""
    from export.model.config import PRESETS
    from export.model.network import build
    from export.quantize.precision import Precision
    from tests.support.artifact_directory import write_artifacts

    directory = tmp_path_factory.mktemp("dynamic")
    return load_artifacts(write_artifacts(build(PRESETS["nano"], 0), directory, precision=Precision("int8")))


def generated(model: LanguageModel, seed: int, most: int = 40) -> Generation:
    segments = model.prompt.build(frames(4, 64, 256, seed), SENTENCE)
    return model.generate(segments, max_new_tokens=most, cancelled=lambda: False)


def assert_equal(found: Generation, expected: Generation) -> None:
    assert found.token_ids == expected.token_ids
    np.testing.assert_array_equal(found.last_layer_kv, expected.last_layer_kv)


@pytest.mark.parametrize("directory", ["artifacts", pytest.param("pair", marks=pytest.mark.slow)])
def test_guesses_change_no_bit_of_tokens_keys_and_values(request: pytest.FixtureRequest, directory: str) -> None:
    plain, guessing = open_models(request.getfixturevalue(directory))
    if guessing.speculate() is not None:
        pytest.skip("calls of different lengths give different bits on this machine, so nothing is guessed")
    assert guessing.speculator is not None
    guessing.speculator = Speculator(
        ids_of(guessing, FIRST_TEXT), dict.fromkeys(guessing.rows, 1.0), guessing.ends_line, lambda _: False
    )
    rng, accepted = np.random.default_rng(0), 0
    for seed in range(6):
        expected = generated(plain, seed)
        # Guesses from right to wrong: the text itself with more and more other tokens.
        ids = np.array(expected.token_ids)
        other = rng.random(len(ids)) < seed / 6
        guessing.speculator.end(np.where(other, rng.integers(1, 900, len(ids)), ids).tolist())
        found = generated(guessing, seed)
        assert_equal(found, expected)
        accepted += found.accepted
    assert accepted > 50


def test_a_graph_that_rounds_rows_together_is_never_given_guesses(dynamic: Artifacts) -> None:
    model = LanguageModel(dynamic, threads=1)
    line = model.speculate()
    assert line is not None and line.startswith("speculation is off: ") and "\n" not in line
    assert model.speculator is None and model.rows == (2,), "a call has the rows that it has without speculation"
    assert len(generated(model, 0, most=5).call_tokens) >= 5


@pytest.mark.slow
def test_an_interrupted_text_leaves_no_trace_in_the_next_one(models: Models) -> None:
    plain, guessing = models
    guessing.speculator = _even(guessing)
    generated(guessing, 1)
    interrupt = Interrupt()
    run = guessing.begin(lambda: False, interrupt=interrupt, before_call=lambda _: interrupt.set())
    with pytest.raises(CancelledError):
        run.finish(guessing.prompt.build(frames(4, 64, 256, 2), SENTENCE), max_new_tokens=20)
    assert_equal(generated(guessing, 3), generated(plain, 3))


@pytest.mark.slow
def test_a_full_context_ends_the_text_at_the_same_token(models: Models) -> None:
    plain, guessing = models
    guessing.speculator = _even(guessing)
    room = plain.runtime.max_context
    for _ in range(2):
        expected, found = generated(plain, 5, most=room), generated(guessing, 5, most=room)
        assert_equal(found, expected)
    assert expected.prompt_tokens + expected.new_tokens <= room
