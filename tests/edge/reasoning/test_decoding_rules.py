"""What a text is held to while it is decoded: progress that follows what was said, a turn that comes nearer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tokenizers import Tokenizer

from edge.artifacts.manifest import Artifacts
from edge.core.geometry import SE2, wrap_angle
from edge.inference.language import Call, Chunk, LanguageModel
from edge.reasoning.decoding_rules import BACK, DONE, NOTHING_KNOWN, Known, TextGuide
from edge.reasoning.progress_rules import EITHER_WAY, FREE, ONWARD, followers
from edge.reasoning.turn_estimate import (
    AHEAD,
    MOST_LOOKS,
    MOST_REFUSED,
    SECOND_NS,
    Look,
    TurnLeft,
    TurnMemory,
    look_of,
    nearer,
)
from edge.state.reasoning_text import Progress, format_progress, parse_progress
from edge.state.ring import EncodedFrame
from tools.train.scenes.trace_sentences import turn

HERE = SE2(0.0, 0.0, 0.0)
SIDES = st.sampled_from(["left", "right"])
KINDS = st.sampled_from(["room", "corridor", "crossing"])


# A plan's line


@given(SIDES, KINDS, st.floats(0.0, 30.0))
def test_a_turn_is_read_as_training_writes_it(side: str, kind: str, metres: float) -> None:
    look = look_of(f"Plan: {turn(side, kind, metres)}.")
    assert look == Look(side, 0.0 if metres < 1.0 else float(round(metres)))


@pytest.mark.parametrize(
    "plan",
    ["stop in 3 m.", "stop now.", "wait, then stop in 3 m.", "wait, then stop now.", "turn back.", "turn left soon.",
     "turn left in 4 m"],
)  # fmt: skip
def test_other_plans_are_no_look_at_a_turn(plan: str) -> None:
    assert look_of(f"Plan: {plan}") is None


@pytest.mark.parametrize(("side", "kind"), [("straight", "corridor"), ("straight", "crossing")])
def test_an_opening_straight_ahead_is_a_turn_to_no_side(side: str, kind: str) -> None:
    assert look_of(f"Plan: {turn(side, kind, 4.0)}.") == Look(AHEAD, 4.0)


@given(SIDES, KINDS, st.floats(0.0, 30.0), st.lists(st.floats(-5.0, 30.0), min_size=1, max_size=4))
def test_a_turn_only_ever_comes_nearer(side: str, kind: str, metres: float, left_m: list[float]) -> None:
    line = f"Plan: {turn(side, kind, metres)}."
    before, after = look_of(line), look_of(nearer(line, TurnLeft(side, tuple(left_m))))
    assert before is not None and after is not None
    assert after.side == side and after.distance_m <= before.distance_m


@pytest.mark.parametrize(
    ("said_m", "left_m", "told"),
    [
        (6, (3.0, 3.2, 2.9, 3.1), "in 3 m"),
        (6, (0.4, 0.2, 0.9, 7.0), "now"),
        (6, (5.9, 6.3, 6.1), "in 6 m"),
        (2, (6.0, 6.0, 6.0, 6.0), "in 2 m"),
        (5, (3.0,), "in 4 m"),
        (0, (3.0, 3.0), "now"),
    ],
)
def test_the_median_of_the_looks_counts_where_it_is_nearer(said_m: int, left_m: tuple[float, ...], told: str) -> None:
    line = f"Plan: {turn('left', 'corridor', said_m)}."
    assert nearer(line, TurnLeft("left", left_m)) == f"Plan: turn left into the corridor {told}."


def test_looks_to_the_other_side_say_nothing() -> None:
    line = "Plan: cross left in 6 m."
    assert nearer(line, TurnLeft("right", (1.0, 1.0, 1.0))) == line


# What is remembered of turns

PROGRESS = Progress(1, 2, 0)
NEXT = Progress(2, 2, 0)


def heard(
    memory: TurnMemory, progress: Progress | None, look: Look | None, pose: SE2 = HERE, *, second: float = 0.0,
    overruled: bool = False, claimed: bool = False,
) -> None:  # fmt: skip
    frame = EncodedFrame(round(second * SECOND_NS), pose, np.zeros(1, np.float32))
    memory.heard(progress, look, frame, overruled=overruled, claimed=claimed)


def turning(memory: TurnMemory, degrees: Sequence[float], second: float = 0.0) -> float:
    """See headings 0.1 s apart; gives the time after them."""
    for number, heading in enumerate(degrees):
        memory.put(round((second + number / 10) * SECOND_NS), SE2(0.0, 0.0, wrap_angle(math.radians(heading))))
    return second + len(degrees) / 10


def to_turn(side: str = "left", heading: float = 0.0) -> TurnMemory:
    """Of a robot that has driven straight on for 2 s and has just said a turn."""
    memory = TurnMemory()
    turning(memory, [heading] * 20)
    heard(memory, PROGRESS, Look(side, 6.0), second=1.9)
    return memory


def test_what_is_left_of_a_turn_is_less_what_the_robot_has_come() -> None:
    memory = TurnMemory()
    assert memory.left(HERE) is None
    heard(memory, PROGRESS, Look("left", 6.0), SE2(1.0, 2.0, math.pi / 2))
    left = memory.left(SE2(1.0, 4.5, math.pi / 2))
    assert left == TurnLeft("left", (3.5,))


def test_who_has_gone_back_has_further_to_go() -> None:
    assert to_turn().left(SE2(-2.0, 0.0, 0.0)) == TurnLeft("left", (8.0,))


@pytest.mark.parametrize(
    "here", [SE2(2.0, 0.0, math.radians(50)), SE2(2.0, 0.0, -math.radians(50)), SE2(7.1, 0.0, 0.0)]
)
def test_a_look_from_another_leg_or_one_that_was_passed_says_nothing(here: SE2) -> None:
    memory = to_turn()
    assert memory.left(here) is None
    heard(memory, PROGRESS, Look("left", 3.0), here)
    left = memory.left(here)
    assert left is not None and left.left_m == pytest.approx([3.0])


@pytest.mark.parametrize("here", [SE2(2.0, 0.0, math.radians(30)), SE2(6.9, 0.0, 0.0)])
def test_a_look_from_about_here_still_counts(here: SE2) -> None:
    assert to_turn().left(here) is not None


def test_headings_beside_the_cut_of_angles_are_alike() -> None:
    memory = TurnMemory()
    heard(memory, PROGRESS, Look("left", 4.0), SE2(0.0, 0.0, math.pi - 0.1))
    assert memory.left(SE2(0.0, 0.0, 0.1 - math.pi)) == TurnLeft("left", (4.0,))


def test_the_last_looks_count() -> None:
    memory = TurnMemory()
    for metres in range(20):
        heard(memory, PROGRESS, Look("left", float(metres)))
    assert memory.left(HERE) == TurnLeft("left", tuple(float(metres) for metres in range(20 - MOST_LOOKS, 20)))


@pytest.mark.parametrize(("progress", "look"), [(PROGRESS, Look("right", 3.0)), (Progress(1, 2, 1), Look("left", 3.0))])
def test_another_turn_begins_anew(progress: Progress, look: Look) -> None:
    memory = to_turn()
    heard(memory, progress, look)
    assert memory.left(HERE) == TurnLeft(look.side, (3.0,))


@pytest.mark.parametrize(
    ("progress", "look"), [(PROGRESS, None), (None, Look("left", 3.0)), (PROGRESS, Look(AHEAD, 3.0))]
)
def test_an_answer_without_a_turn_or_progress_forgets_it(progress: Progress | None, look: Look | None) -> None:
    memory = to_turn()
    heard(memory, progress, look)
    assert memory.left(HERE) is None


def test_an_answer_that_was_overruled_says_nothing_of_the_turn() -> None:
    memory = to_turn()
    heard(memory, PROGRESS, Look("right", 2.0), overruled=True)
    assert memory.left(HERE) == TurnLeft("left", (6.0,)) and not memory.may_be_done


@pytest.mark.parametrize("progress", [NEXT, Progress(1, 2, 1)])
def test_looks_are_of_one_turn_also_where_an_answer_that_was_overruled_leads_to_the_next(progress: Progress) -> None:
    memory = to_turn()
    heard(memory, progress, Look("left", 8.0), overruled=True)
    assert memory.left(HERE) is None


STRAIGHT, SWAY = [0.0] * 30, [-13.0, -13.0, 0.0, 13.0, 13.0, 0.0, 0.0]
SLOWLY = [3.0 * n for n in range(31)]


@pytest.mark.parametrize("from_degrees", [0.0, 170.0, -100.0])
@pytest.mark.parametrize(
    ("side", "degrees", "done"),
    [
        ("left", SLOWLY[:10], True),
        ("left", SLOWLY[:8], False),
        ("right", SLOWLY, False),
        ("left", STRAIGHT, False),
        ("left", [*SWAY, *SWAY], False),
        ("left", [*SLOWLY[:12], *SLOWLY[11::-1]], False),
        ("left", [*SLOWLY[:20], *SLOWLY[19::-1]], True),
    ],
    ids=["turns", "begins to", "turns the other way", "goes straight", "sways", "makes way", "turned, and back"],
)
def test_a_turn_may_be_done_once_the_robot_has_turned_that_way(
    side: str, degrees: list[float], done: bool, from_degrees: float
) -> None:
    memory = to_turn(side, from_degrees)
    turning(memory, [from_degrees + heading for heading in degrees], second=2.0)
    assert memory.may_be_done == done
    mirrored = to_turn({"left": "right", "right": "left"}[side], from_degrees)
    turning(mirrored, [from_degrees - heading for heading in degrees], second=2.0)
    assert mirrored.may_be_done == done


@pytest.mark.parametrize("look", [None, Look(AHEAD, 4.0)])
def test_without_a_side_a_turn_may_always_be_done(look: Look | None) -> None:
    memory = TurnMemory()
    heard(memory, PROGRESS, look)
    assert memory.may_be_done


@pytest.mark.parametrize("said", ["right", AHEAD])
def test_the_side_is_what_most_answers_said(said: str) -> None:
    memory = to_turn("left")
    heard(memory, PROGRESS, Look(said, 4.0))
    assert memory.may_be_done
    heard(memory, PROGRESS, Look("left", 4.0))
    assert not memory.may_be_done
    turning(memory, [-heading for heading in SLOWLY], second=2.0)
    assert not memory.may_be_done
    for _ in range(2):
        heard(memory, PROGRESS, Look(said, 4.0))
    assert memory.may_be_done


def test_a_side_misread_from_afar_is_forgotten() -> None:
    memory = TurnMemory()
    turning(memory, [0.0] * 20)
    for side in ["right"] * 20 + ["left"] * 9:
        heard(memory, PROGRESS, Look(side, 6.0), second=1.9)
    turning(memory, SLOWLY, second=2.0)
    assert memory.may_be_done


@pytest.mark.parametrize("sides", [[], ["right"], ["right", "right"]], ids=["as said", "a tie", "misread"])
def test_the_rest_of_a_turn_is_not_the_next_one_to_the_same_side(sides: list[str]) -> None:
    memory = to_turn()
    for side in sides:
        heard(memory, PROGRESS, Look(side, 6.0), second=1.9)
    second = turning(memory, SLOWLY[:18], second=2.0)
    heard(memory, NEXT, Look("left", 6.0), second=second - 0.1)
    second = turning(memory, [*SLOWLY[18:], *[90.0] * 20], second=second)
    assert not memory.may_be_done
    turning(memory, [90.0 + heading for heading in SLOWLY[:10]], second=second)
    assert memory.may_be_done


def test_the_next_turn_to_the_same_side_may_begin_as_soon_as_it_is_said() -> None:
    memory = to_turn()
    second = turning(memory, [*SLOWLY, *[90.0] * 30], second=2.0)
    heard(memory, NEXT, Look("left", 1.0), second=second - 0.3)
    turning(memory, [90.0 + heading for heading in SLOWLY], second=second)
    assert memory.may_be_done


def test_the_next_turn_to_the_other_side_may_follow_at_once() -> None:
    memory = to_turn()
    second = turning(memory, SLOWLY, second=2.0)
    heard(memory, NEXT, Look("right", 1.0), second=second - 0.1)
    assert not memory.may_be_done
    turning(memory, [90.0 - heading for heading in SLOWLY[:10]], second=second)
    assert memory.may_be_done


def test_a_turn_may_begin_a_little_before_it_is_said_to_be_next() -> None:
    memory = to_turn("right")
    second = turning(memory, SLOWLY[:10], second=7.0)
    heard(memory, NEXT, Look("left", 1.0), second=second + 1.0)
    assert memory.may_be_done


def test_a_turn_that_was_made_need_not_be_made_again() -> None:
    memory = to_turn()
    turning(memory, SLOWLY, second=2.0)
    heard(memory, NEXT, Look("right", 6.0), second=6.0)
    heard(memory, PROGRESS, Look("left", 1.0), second=12.0)
    assert memory.may_be_done


def test_poses_that_come_again_change_nothing() -> None:
    memory = to_turn()
    for _ in range(3):
        turning(memory, [-90.0] * 20)
    assert not memory.may_be_done


def test_a_turn_that_is_claimed_again_and_again_counts_as_done() -> None:
    memory = to_turn()
    for _ in range(MOST_REFUSED - 1):
        heard(memory, PROGRESS, None, overruled=True, claimed=True)
    heard(memory, PROGRESS, Look("left", 3.0))
    for _ in range(MOST_REFUSED):
        assert not memory.may_be_done
        heard(memory, PROGRESS, None, overruled=True, claimed=True)
    assert memory.may_be_done
    heard(memory, PROGRESS, Look("left", 3.0))
    assert memory.may_be_done


def test_another_progress_that_is_overruled_claims_no_turn() -> None:
    memory = to_turn()
    for _ in range(2 * MOST_REFUSED):
        heard(memory, PROGRESS, None, overruled=True)
    assert not memory.may_be_done


# What is remembered of progress


def test_before_anything_was_said_anything_may_be() -> None:
    assert NOTHING_KNOWN.follow == FREE and NOTHING_KNOWN.before is None


def letters(text: str) -> list[int]:
    return [ord(letter) for letter in text]


def wanting(known: Known, words: str) -> TextGuide:
    """The guide of a text that would begin its line so."""
    guide = TextGuide(known, letters)
    for letter in f"Progress: {words}":
        guide.choose(ord(letter))
    return guide


def test_going_back_counts_when_it_is_said_twice_in_a_row() -> None:
    text, before = "Progress: turn 2 of 3, passed 0.", Progress(2, 3, 0)
    known = NOTHING_KNOWN.after(text, TextGuide(NOTHING_KNOWN, letters))
    assert known == Known(before, ONWARD)
    once = wanting(known, "turn 1")
    assert once.overruled and once.wanted == BACK
    again = known.after(text, once)
    assert again == Known(before, EITHER_WAY) and not wanting(again, "turn 1").overruled
    assert again.after(text, TextGuide(again, letters)) == Known(before, ONWARD)
    assert known.after("no such line", TextGuide(known, letters)).before == before


@pytest.mark.parametrize("words", ["turn 2 of 4", "last", "turn 2 of 3, passed 9"])
def test_another_progress_that_is_overruled_is_no_step_back(words: str) -> None:
    known = Known(Progress(2, 3, 0), ONWARD, may_be_done=False)
    guide = wanting(known, words)
    assert guide.overruled and guide.wanted is None
    assert known.after("Progress: turn 2 of 3, passed 0.", guide).follow == ONWARD


def test_a_turn_that_is_claimed_and_cannot_be_done_is_known_as_that() -> None:
    known = Known(Progress(2, 3, 0), ONWARD, may_be_done=False)
    assert wanting(known, "turn 3").wanted == DONE
    assert wanting(Known(Progress(2, 2, 0), ONWARD, may_be_done=False), "last").wanted == DONE
    assert not wanting(Known(Progress(2, 3, 0), ONWARD), "turn 3").overruled


@pytest.mark.parametrize(
    ("words", "wanted"),
    [("turn 3 of 3, passed 2.", DONE), ("turn 3 of 4, passed 1.", DONE), ("turn 1 of 3, passed 7.", BACK)],
)
def test_what_a_line_goes_on_with_does_not_change_what_it_was_corrected_for(words: str, wanted: str) -> None:
    assert wanting(Known(Progress(2, 3, 1), ONWARD, may_be_done=False), words).wanted == wanted


@pytest.mark.parametrize(("words", "said"), [("Plan: stop now.\n", True), ("Plan: stop", False), ("", False)])
def test_a_plan_is_said_once_its_line_is_complete(words: str, said: bool) -> None:
    guide = TextGuide(NOTHING_KNOWN, letters)
    for line in words.splitlines(keepends=True):
        if line.endswith("\n"):
            guide.line(line.rstrip("\n"))
    assert guide.plan_said == said


# In the decoding loop


class Script:
    """A decode call that says the lines of a text, whatever the ones before have become; it keeps what it was fed."""

    def __init__(self, lines: list[list[int]], prompt: int) -> None:
        self._lines, self._prompt = lines, prompt
        self._fed: list[int] = []

    def __call__(self, chunk: Chunk, past: int, kv: object, interrupt: object) -> int:
        self._fed = [*self._fed[:past], *chunk.ids]
        ends = {line[-1] for line in self._lines[:-1]}
        number, place = 0, 0
        for token in self.heard():
            number, place = (number + 1, 0) if token in ends else (number, place + 1)
        line = self._lines[number]
        return line[min(place, len(line) - 1)]

    def heard(self) -> list[int]:
        """What it was fed behind the prompt."""
        return self._fed[self._prompt :]


def said(artifacts: Artifacts, text: str, known: Known) -> tuple[str, TextGuide, bool]:
    """(text, its guide, whether what was fed is what was said) of a model that would say `text`."""
    language = LanguageModel(artifacts, threads=1)
    tail = language.prompt.tail((), known.before)
    tokenizer = Tokenizer.from_buffer(artifacts.contents["tokenizer.json"])
    lines = [tokenizer.encode(line, add_special_tokens=False).ids for line in text.splitlines(keepends=True)]
    script = Script([*lines[:-1], [*lines[-1], language.runtime.im_end_id]], len(tail.ids))
    language.prefill_call = language.decode_call = cast("Call", script)
    guide = language.guide(known)
    made = language.generate([tail], max_new_tokens=60, cancelled=lambda: False, guide=guide)
    assert made.last_layer_kv.shape[1] == made.prompt_tokens + made.new_tokens
    return made.text, guide, script.heard() == list(made.token_ids)


TEXT = "Situation: in a corridor.\nMotion: nobody near.\nProgress: {}\nPlan: {}.\nwaypoints: (2.0, 0.1)"
BEFORE = Progress(2, 3, 1)


@pytest.mark.parametrize("follow", [ONWARD, EITHER_WAY])
@pytest.mark.parametrize("progress", [BEFORE, Progress(2, 3, 2), Progress(3, 3, 0)])
def test_a_text_that_goes_onward_is_left_as_the_model_says_it(
    artifacts: Artifacts, progress: Progress, follow: str
) -> None:
    text = TEXT.format(format_progress(progress), "turn left into the room in 3 m")
    made, guide, heard = said(artifacts, text, Known(BEFORE, follow))
    assert (made, guide.overruled, heard, guide.look) == (text, False, True, Look("left", 3.0))


@pytest.mark.parametrize("wrong", [Progress(1, 3, 0), Progress(2, 2, 1), Progress(4, 3, 0), Progress(2, 3, 7)])
def test_a_text_that_does_not_is_held_to_the_grammar_and_the_model_hears_it(
    artifacts: Artifacts, wrong: Progress
) -> None:
    text = TEXT.format(format_progress(wrong), "turn back")
    made, guide, heard = said(artifacts, text, Known(BEFORE, ONWARD))
    assert guide.overruled and heard and parse_progress(made) in followers(BEFORE, ONWARD)
    assert made.startswith("Situation: in a corridor.\n") and made.endswith("Plan: turn back.\nwaypoints: (2.0, 0.1)")


def test_a_turn_is_undone_where_either_way_may_be_said(artifacts: Artifacts) -> None:
    text = TEXT.format("turn 1 of 1, passed 0.", "turn back")
    last_leg = Progress(2, 1, 0)
    assert said(artifacts, text, Known(last_leg, ONWARD))[0] == TEXT.format("last leg of 1, passed 0.", "turn back")
    assert said(artifacts, text, Known(last_leg, EITHER_WAY))[0] == text


def test_with_nothing_known_the_model_says_what_it_will(artifacts: Artifacts) -> None:
    text = TEXT.format("turn 9 of 9, passed 9.", "turn left into the room in 9 m")
    made, guide, heard = said(artifacts, text, NOTHING_KNOWN)
    assert (made, guide.overruled, heard) == (text, False, True)


@pytest.mark.parametrize(("left_m", "told"), [((3.0, 3.0, 2.9), "in 3 m"), ((0.5, 0.2), "now"), ((11.0,), "in 12 m")])
def test_a_turn_that_looks_nearer_is_said_nearer_and_the_model_hears_that_alone(
    artifacts: Artifacts, left_m: tuple[float, ...], told: str
) -> None:
    text = TEXT.format(format_progress(BEFORE), "turn left into the corridor {}")
    known = Known(BEFORE, ONWARD, TurnLeft("left", left_m))
    made, guide, heard = said(artifacts, text.format("in 12 m"), known)
    assert made == text.format(told) and heard
    assert guide.look == Look("left", 12.0)


def test_a_turn_that_was_not_made_is_still_to_come(artifacts: Artifacts) -> None:
    text = TEXT.format(format_progress(Progress(3, 3, 0)), "turn back")
    made, guide, heard = said(artifacts, text, Known(BEFORE, ONWARD, None, may_be_done=False))
    assert parse_progress(made) == BEFORE and guide.overruled and heard


def test_another_turn_is_as_far_as_the_model_says(artifacts: Artifacts) -> None:
    text = TEXT.format(format_progress(Progress(3, 3, 0)), "turn left into the corridor in 12 m")
    assert said(artifacts, text, Known(BEFORE, ONWARD, TurnLeft("left", (1.0, 1.0, 1.0))))[0] == text
