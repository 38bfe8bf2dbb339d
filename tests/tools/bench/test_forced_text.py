"""A forced text is written token by token, whatever the model chooses, as long as its rules allow it."""

from __future__ import annotations

import json

import pytest
from tokenizers import Tokenizer

from edge.reasoning.decoding_rules import ONWARD, DecodingContext
from edge.state.reasoning_text import Progress
from export.checkpoint.tokenizer import tokenizer_for
from export.model.config import PRESETS
from tools.bench.peers.forced_text import ForcedText, context_of
from tools.bench.peers.workers.ours_worker import ANSWERS

END = 9_999


def spelled(text: str) -> list[int]:
    return [ord(letter) for letter in text]


def written(text: str, context: DecodingContext | None = None) -> list[int]:
    forced = ForcedText(spelled(text), END, spelled, context)
    return [forced.choose(0) for _ in range(len(text) + 1)]


def test_every_choice_is_the_texts_next_token_and_then_the_end() -> None:
    assert written("Plan: stop now.") == [*spelled("Plan: stop now."), END]


def test_a_text_that_breaks_its_rules_is_refused() -> None:
    context = DecodingContext(Progress(1, 3, 0), ONWARD)
    assert written("Progress: turn 2 of 3, passed 0.\n", context)[-1] == END
    with pytest.raises(ValueError, match="obeys them"):
        written("Progress: turn 3 of 3, passed 0.\n", context)


def test_what_the_rules_force_can_be_guessed() -> None:
    line = "Progress: turn 2 of 3, passed 0.\n"
    forced = ForcedText(spelled(line), END, spelled, DecodingContext(Progress(2, 3, 0), ONWARD))
    for _ in "Progress: ":
        forced.choose(0)
    assert list(forced.forced()[:5]) == spelled("turn ")


def test_recorded_rules_are_read_back() -> None:
    context = DecodingContext(Progress(1, 2, 1), ONWARD, None, turn_may_be_done=False)
    assert context_of({**context.record(), "before": {"step": 1, "steps": 2, "passed": 1}}) == context


@pytest.mark.parametrize("model", ["nano", "1b"])
def test_the_recorded_answers_obey_their_rules(model: str) -> None:
    tokenizer = Tokenizer.from_buffer(tokenizer_for(PRESETS[model], None))

    def encode(text: str) -> list[int]:
        return tokenizer.encode(text, add_special_tokens=False).ids

    for answer in json.loads(ANSWERS.read_text(encoding="utf-8"))["answers"]:
        tokens, context = encode(answer["text"]), context_of(answer["rules"])
        forced = ForcedText(tokens, END, encode, context)
        assert [forced.choose(0) for _ in tokens] == tokens
