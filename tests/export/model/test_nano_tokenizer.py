"""The small model's tokenizer: a word of the robot's sentences is one token, a coordinate two, any text survives."""

from __future__ import annotations

import itertools
import re
import statistics
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tokenizers import Tokenizer

from edge.core.geometry import SE2
from edge.reasoning.prompt import EXAMPLE_BEFORE, EXAMPLE_PAST_PATH, PromptBuilder, PromptIds
from edge.state.reasoning_text import format_waypoints
from edge.state.ring import EncodedFrame
from export.model.config import PRESETS
from export.model.tokenizers.nano import FARTHEST_M, NANO_TOKENIZER, train
from export.targets.file import list_targets, load_target
from sim_hil.benchmark.language.instruction_words import AREAS, COLOUR_WORDS, NOUNS, ORDINALS
from sim_hil.benchmark.language.instructions import wordings
from sim_hil.benchmark.language.route import Passed, RouteDescription, Step
from sim_hil.benchmark.suite.episode import load_suite
from sim_hil.scene.scene import load_scene, scene_names
from tools.train.drives import trace_sentences as trace_words

TOKENIZER = Tokenizer.from_file(str(NANO_TOKENIZER))
LANGUAGE = PRESETS["nano"].language
ANSWER = """Situation: in a corridor.
Objects: vending machine left 6 m, door right 3 m.
Motion: person ahead 2 m coming.
Progress: turn 2 of 3, passed 1.
Plan: turn left in 3 m.
waypoints: (2.4, 0.0) (4.8, 0.1) (6.0, 1.5)"""


def tokens(text: str) -> int:
    return len(TOKENIZER.encode(text, add_special_tokens=False).ids)


def in_pieces(words: set[str]) -> list[str]:
    """Those of the words that are more than one token each, as they stand in a sentence."""
    return sorted(word for word in words if tokens(f" {word}") > 1)


def instructions() -> list[str]:
    """Every instruction of the suite; the grammar of training has the same words."""
    return sorted({text for episode in load_suite("dynanav") for text in episode.instructions})


def test_every_word_of_the_suite_s_instructions_is_one_token() -> None:
    words = {word for text in instructions() for word in re.findall(r"[A-Za-z]+", text)}
    assert len(words) > 100 and in_pieces(words) == []


WAYS = (
    ("corridor", "corridor"), ("corridor", "main aisle"), ("aisle", "aisle"), ("sidewalk", "sidewalk"),
    ("room", "office"), ("lobby", "elevator lobby"), ("plaza", "plaza"), ("yard", "loading area"),
    ("crossing", "zebra crossing"),
)  # fmt: skip


def routes() -> Iterator[RouteDescription]:
    """Ways with every kind of step, on either side, counted, at an end and at a landmark, and with none."""
    near, past = (Passed("bench 1", "blue bench", "left"),), (Passed("sofa 1", "sofa", "right"),)
    for (kind, name), side, (ordinal, at_end, by) in itertools.product(
        WAYS, ("left", "right", "straight"), ((2, False, near), (0, True, ()), (0, False, near))
    ):
        if kind in ("room", "crossing") and not ordinal:
            continue
        step = Step(side, kind, name, ordinal, at_end, by, past, "corridor", "corridor", 9.0, (0.0, 0.0))
        end = ("desk 1", "red desk", "desk", "left", True, kind, name, 9.0, past)
        yield RouteDescription((step,), *end, leaves_room=False, length_m=30.0)
    yield RouteDescription((), *end, leaves_room=False, length_m=9.0)
    leaving = Step("left", "corridor", "corridor", 0, False, (), (), "room", "office", 3.0, (0.0, 0.0))
    yield RouteDescription((leaving,), *end, leaves_room=True, length_m=9.0)


@pytest.mark.slow
def test_every_word_of_the_grammar_of_training_is_one_token() -> None:
    texts = [text for seed, route in enumerate(routes()) for text in wordings(route, 12, seed, held_out=False)]
    words = {word for text in texts for word in re.findall(r"[A-Za-z]+", text)}
    assert len(texts) > 500 and len(words) > 100 and in_pieces(words) == []


@pytest.mark.slow
def test_everything_that_can_be_named_is_one_token_a_word() -> None:
    scenes = [load_scene(name) for name in scene_names()]
    names = {thing.landmark for scene in scenes for thing in scene.landmarks()}
    names |= {area.name for scene in scenes for area in scene.areas}
    phrases = (*NOUNS, *COLOUR_WORDS, *ORDINALS, *AREAS, *names)
    assert in_pieces({word for phrase in phrases for word in phrase.split()}) == []


def test_every_word_of_the_traces_is_one_token() -> None:
    words = {word for text in trace_words.corpus() for word in re.findall(r"[A-Za-z]+(?![\w:])", text)}
    assert in_pieces(words) == []


@pytest.mark.slow
def test_the_longest_answer_that_training_writes_fits_every_target() -> None:
    room = min(load_target(name, "nano").runtime.max_new_tokens for name in list_targets())
    far = "\n" + format_waypoints(((-12.5, 30.4), (-20.1, -25.3), (29.9, -30.9)))
    written = [text.rsplit("\n", 1)[0] for text in trace_words.corpus()]
    lengths = [tokens(text + far) for text in written if len(text.split()) <= trace_words.MAX_WORDS]
    assert 60 < max(lengths) < room  # one more: the end of the answer


def test_a_whole_exchange_with_four_frames_has_at_most_260_tokens() -> None:
    """Of the suite's median instruction, with all points of a way."""
    frames = [EncodedFrame(i, SE2(0.0, 0.0, 0.0), np.zeros((1, 64, 256), dtype=np.float32)) for i in range(4)]
    builder = PromptBuilder(Tokenizer.from_file(str(NANO_TOKENIZER)), PromptIds(1, 2, 3, 4, 5), frame_tokens=16)
    lengths = [
        sum(len(segment.ids) for segment in builder.build(frames, text, EXAMPLE_PAST_PATH, EXAMPLE_BEFORE))
        for text in instructions()
    ]
    assert statistics.median(lengths) + tokens(ANSWER) + 1 <= 260
    assert max(lengths) + 72 <= LANGUAGE.max_context


def test_a_point_is_four_tokens_as_far_as_it_is_common() -> None:
    metres = [tenth / 10 for tenth in range(-10 * FARTHEST_M, 10 * FARTHEST_M + 1, 7)]
    for x, y in itertools.pairwise(metres):
        assert tokens(f" ({x:.1f}, {-y:.1f})") == 4
    assert tokens(format_waypoints(((2.4, 0.0), (4.8, 0.1), (6.0, 1.5)))) == 13


def test_the_tokenizer_is_what_its_word_lists_give() -> None:
    made = train(LANGUAGE.vocab)
    assert made.get_vocab() == TOKENIZER.get_vocab()
    assert [made.encode(text).ids for text in instructions()] == [TOKENIZER.encode(t).ids for t in instructions()]


@pytest.mark.slow
@given(st.text(max_size=80))
def test_any_text_survives(text: str) -> None:
    ids = TOKENIZER.encode(text, add_special_tokens=False).ids
    assert TOKENIZER.decode(ids, skip_special_tokens=False) == text
