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
from edge.reasoning.decoding_rules import (
    BACK,
    DONE,
    EITHER_WAY,
    FREE,
    MAX_OBSERVATIONS,
    MAX_REFUSALS,
    ONWARD,
    SECOND_NS,
    DecodingContext,
    TextConstraint,
    TurnDistances,
    TurnEstimator,
    TurnObservation,
    allowed_progress,
    limit_distance,
    observed_turn,
)
from edge.state.reasoning_text import AHEAD, Plan, Progress, Stop, Turn, TurnBack, format_progress, parse_progress
from edge.state.ring import EncodedFrame
from tools.train.drives.trace_sentences import plan_metres

HERE = SE2(0.0, 0.0, 0.0)
SIDES = st.sampled_from(["left", "right"])
KINDS = st.sampled_from(["room", "corridor", "crossing"])


# A plan


def plan(side: str, area: str, metres: float) -> Plan:
    return Plan(Turn(side, area, plan_metres(metres)))


@given(SIDES, KINDS, st.floats(0.0, 30.0))
def test_a_planned_turn_is_an_observation_of_it(side: str, kind: str, metres: float) -> None:
    expected = TurnObservation(side, 0.0 if metres < 1.0 else float(round(metres)))
    assert observed_turn(plan(side, kind, metres)) == expected


@pytest.mark.parametrize("other", [None, Plan(Stop(3)), Plan(Stop(0), waits=True), Plan(TurnBack())])
def test_other_plans_observe_no_turn(other: Plan | None) -> None:
    assert observed_turn(other) is None


@given(SIDES, KINDS, st.floats(0.0, 30.0), st.lists(st.floats(-5.0, 30.0), min_size=1, max_size=4))
def test_a_turn_only_ever_comes_nearer(side: str, kind: str, metres: float, distances_m: list[float]) -> None:
    before = plan(side, kind, metres)
    after = limit_distance(before, TurnDistances(side, tuple(distances_m)))
    assert isinstance(before.action, Turn) and isinstance(after.action, Turn)
    assert (after.action.side, after.action.area) == (side, kind)
    assert after.action.distance_m <= before.action.distance_m


@pytest.mark.parametrize(
    ("planned_m", "distances_m", "limited_m"),
    [
        (6, (3.0, 3.2, 2.9, 3.1), 3),
        (6, (0.4, 0.2, 0.9, 7.0), 0),
        (6, (5.9, 6.3, 6.1), 6),
        (2, (6.0, 6.0, 6.0, 6.0), 2),
        (5, (3.0,), 4),
        (0, (3.0, 3.0), 0),
    ],
)
def test_the_median_of_all_observations_limits_the_distance(
    planned_m: int, distances_m: tuple[float, ...], limited_m: int
) -> None:
    limited = limit_distance(plan("left", "corridor", planned_m), TurnDistances("left", distances_m))
    assert limited == plan("left", "corridor", limited_m)


def test_observations_to_the_other_side_limit_nothing() -> None:
    cross = plan("left", "crossing", 6)
    assert limit_distance(cross, TurnDistances("right", (1.0, 1.0, 1.0))) == cross


# What is remembered of turns

PROGRESS = Progress(1, 2, 0)
NEXT = Progress(2, 2, 0)


def heard(
    memory: TurnEstimator, progress: Progress | None, look: TurnObservation | None, pose: SE2 = HERE, *,
    second: float = 0.0, overruled: bool = False, claimed: bool = False,
) -> None:  # fmt: skip
    frame = EncodedFrame(round(second * SECOND_NS), pose, np.zeros(1, np.float32))
    memory.update(progress, look, frame, overruled=overruled, claimed=claimed)


def turning(memory: TurnEstimator, degrees: Sequence[float], second: float = 0.0) -> float:
    """See headings 0.1 s apart; gives the time after them."""
    for number, heading in enumerate(degrees):
        memory.put(round((second + number / 10) * SECOND_NS), SE2(0.0, 0.0, wrap_angle(math.radians(heading))))
    return second + len(degrees) / 10


def to_turn(side: str = "left", heading: float = 0.0) -> TurnEstimator:
    """Of a robot that has driven straight on for 2 s and has just said a turn."""
    memory = TurnEstimator()
    turning(memory, [heading] * 20)
    heard(memory, PROGRESS, TurnObservation(side, 6.0), second=1.9)
    return memory


def test_what_is_left_of_a_turn_is_less_what_the_robot_has_come() -> None:
    memory = TurnEstimator()
    assert memory.distances(HERE) is None
    heard(memory, PROGRESS, TurnObservation("left", 6.0), SE2(1.0, 2.0, math.pi / 2))
    left = memory.distances(SE2(1.0, 4.5, math.pi / 2))
    assert left == TurnDistances("left", (3.5,))


def test_who_has_gone_back_has_further_to_go() -> None:
    assert to_turn().distances(SE2(-2.0, 0.0, 0.0)) == TurnDistances("left", (8.0,))


@pytest.mark.parametrize(
    "here", [SE2(2.0, 0.0, math.radians(50)), SE2(2.0, 0.0, -math.radians(50)), SE2(7.1, 0.0, 0.0)]
)
def test_a_look_from_another_leg_or_one_that_was_passed_says_nothing(here: SE2) -> None:
    memory = to_turn()
    assert memory.distances(here) is None
    heard(memory, PROGRESS, TurnObservation("left", 3.0), here)
    left = memory.distances(here)
    assert left is not None and left.distances_m == pytest.approx([3.0])


@pytest.mark.parametrize("here", [SE2(2.0, 0.0, math.radians(30)), SE2(6.9, 0.0, 0.0)])
def test_a_look_from_about_here_still_counts(here: SE2) -> None:
    assert to_turn().distances(here) is not None


def test_headings_beside_the_cut_of_angles_are_alike() -> None:
    memory = TurnEstimator()
    heard(memory, PROGRESS, TurnObservation("left", 4.0), SE2(0.0, 0.0, math.pi - 0.1))
    assert memory.distances(SE2(0.0, 0.0, 0.1 - math.pi)) == TurnDistances("left", (4.0,))


def test_the_last_looks_count() -> None:
    memory = TurnEstimator()
    for metres in range(20):
        heard(memory, PROGRESS, TurnObservation("left", float(metres)))
    last_m = tuple(float(metres) for metres in range(20 - MAX_OBSERVATIONS, 20))
    assert memory.distances(HERE) == TurnDistances("left", last_m)


@pytest.mark.parametrize(
    ("progress", "look"),
    [(PROGRESS, TurnObservation("right", 3.0)), (Progress(1, 2, 1), TurnObservation("left", 3.0))],
)
def test_another_turn_begins_anew(progress: Progress, look: TurnObservation) -> None:
    memory = to_turn()
    heard(memory, progress, look)
    assert memory.distances(HERE) == TurnDistances(look.side, (3.0,))


@pytest.mark.parametrize(
    ("progress", "look"),
    [(PROGRESS, None), (None, TurnObservation("left", 3.0)), (PROGRESS, TurnObservation(AHEAD, 3.0))],
)
def test_an_answer_without_a_turn_or_progress_forgets_it(
    progress: Progress | None, look: TurnObservation | None
) -> None:
    memory = to_turn()
    heard(memory, progress, look)
    assert memory.distances(HERE) is None


def test_an_answer_that_was_overruled_says_nothing_of_the_turn() -> None:
    memory = to_turn()
    heard(memory, PROGRESS, TurnObservation("right", 2.0), overruled=True)
    assert memory.distances(HERE) == TurnDistances("left", (6.0,)) and not memory.may_be_done


@pytest.mark.parametrize("progress", [NEXT, Progress(1, 2, 1)])
def test_looks_are_of_one_turn_also_where_an_answer_that_was_overruled_leads_to_the_next(progress: Progress) -> None:
    memory = to_turn()
    heard(memory, progress, TurnObservation("left", 8.0), overruled=True)
    assert memory.distances(HERE) is None


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


@pytest.mark.parametrize("look", [None, TurnObservation(AHEAD, 4.0)])
def test_without_a_side_a_turn_may_always_be_done(look: TurnObservation | None) -> None:
    memory = TurnEstimator()
    heard(memory, PROGRESS, look)
    assert memory.may_be_done


@pytest.mark.parametrize("said", ["right", AHEAD])
def test_the_side_is_what_most_answers_said(said: str) -> None:
    memory = to_turn("left")
    heard(memory, PROGRESS, TurnObservation(said, 4.0))
    assert memory.may_be_done
    heard(memory, PROGRESS, TurnObservation("left", 4.0))
    assert not memory.may_be_done
    turning(memory, [-heading for heading in SLOWLY], second=2.0)
    assert not memory.may_be_done
    for _ in range(2):
        heard(memory, PROGRESS, TurnObservation(said, 4.0))
    assert memory.may_be_done


def test_a_side_misread_from_afar_is_forgotten() -> None:
    memory = TurnEstimator()
    turning(memory, [0.0] * 20)
    for side in ["right"] * 20 + ["left"] * 9:
        heard(memory, PROGRESS, TurnObservation(side, 6.0), second=1.9)
    turning(memory, SLOWLY, second=2.0)
    assert memory.may_be_done


@pytest.mark.parametrize("sides", [[], ["right"], ["right", "right"]], ids=["as said", "a tie", "misread"])
def test_the_rest_of_a_turn_is_not_the_next_one_to_the_same_side(sides: list[str]) -> None:
    memory = to_turn()
    for side in sides:
        heard(memory, PROGRESS, TurnObservation(side, 6.0), second=1.9)
    second = turning(memory, SLOWLY[:18], second=2.0)
    heard(memory, NEXT, TurnObservation("left", 6.0), second=second - 0.1)
    second = turning(memory, [*SLOWLY[18:], *[90.0] * 20], second=second)
    assert not memory.may_be_done
    turning(memory, [90.0 + heading for heading in SLOWLY[:10]], second=second)
    assert memory.may_be_done


def test_the_next_turn_to_the_same_side_may_begin_as_soon_as_it_is_said() -> None:
    memory = to_turn()
    second = turning(memory, [*SLOWLY, *[90.0] * 30], second=2.0)
    heard(memory, NEXT, TurnObservation("left", 1.0), second=second - 0.3)
    turning(memory, [90.0 + heading for heading in SLOWLY], second=second)
    assert memory.may_be_done


def test_the_next_turn_to_the_other_side_may_follow_at_once() -> None:
    memory = to_turn()
    second = turning(memory, SLOWLY, second=2.0)
    heard(memory, NEXT, TurnObservation("right", 1.0), second=second - 0.1)
    assert not memory.may_be_done
    turning(memory, [90.0 - heading for heading in SLOWLY[:10]], second=second)
    assert memory.may_be_done


def test_a_turn_may_begin_a_little_before_it_is_said_to_be_next() -> None:
    memory = to_turn("right")
    second = turning(memory, SLOWLY[:10], second=7.0)
    heard(memory, NEXT, TurnObservation("left", 1.0), second=second + 1.0)
    assert memory.may_be_done


def test_a_turn_that_was_made_need_not_be_made_again() -> None:
    memory = to_turn()
    turning(memory, SLOWLY, second=2.0)
    heard(memory, NEXT, TurnObservation("right", 6.0), second=6.0)
    heard(memory, PROGRESS, TurnObservation("left", 1.0), second=12.0)
    assert memory.may_be_done


def test_poses_that_come_again_change_nothing() -> None:
    memory = to_turn()
    for _ in range(3):
        turning(memory, [-90.0] * 20)
    assert not memory.may_be_done


def test_a_turn_that_is_claimed_again_and_again_counts_as_done() -> None:
    memory = to_turn()
    for _ in range(MAX_REFUSALS - 1):
        heard(memory, PROGRESS, None, overruled=True, claimed=True)
    heard(memory, PROGRESS, TurnObservation("left", 3.0))
    for _ in range(MAX_REFUSALS):
        assert not memory.may_be_done
        heard(memory, PROGRESS, None, overruled=True, claimed=True)
    assert memory.may_be_done
    heard(memory, PROGRESS, TurnObservation("left", 3.0))
    assert memory.may_be_done


def test_another_progress_that_is_overruled_claims_no_turn() -> None:
    memory = to_turn()
    for _ in range(2 * MAX_REFUSALS):
        heard(memory, PROGRESS, None, overruled=True)
    assert not memory.may_be_done


# What is remembered of progress


def test_before_anything_was_said_anything_may_be() -> None:
    assert DecodingContext().follow == FREE and DecodingContext().before is None


def letters(text: str) -> list[int]:
    return [ord(letter) for letter in text]


def wanting(known: DecodingContext, words: str) -> TextConstraint:
    """The constraint of a text whose progress line the model would begin so."""
    constraint = TextConstraint(known, letters)
    for letter in f"Progress: {words}":
        constraint.choose(ord(letter))
    return constraint


def test_going_back_counts_when_it_is_said_twice_in_a_row() -> None:
    text, before = "Progress: turn 2 of 3, passed 0.", Progress(2, 3, 0)
    known = DecodingContext().after(text, TextConstraint(DecodingContext(), letters))
    assert known == DecodingContext(before, ONWARD)
    once = wanting(known, "turn 1")
    assert once.overruled and once.refused == BACK
    again = known.after(text, once)
    assert again == DecodingContext(before, EITHER_WAY) and not wanting(again, "turn 1").overruled
    assert again.after(text, TextConstraint(again, letters)) == DecodingContext(before, ONWARD)
    assert known.after("no such line", TextConstraint(known, letters)).before == before


@pytest.mark.parametrize("words", ["turn 2 of 4", "last", "turn 2 of 3, passed 9"])
def test_another_progress_that_is_overruled_is_no_step_back(words: str) -> None:
    known = DecodingContext(Progress(2, 3, 0), ONWARD, turn_may_be_done=False)
    constraint = wanting(known, words)
    assert constraint.overruled and constraint.refused is None
    assert known.after("Progress: turn 2 of 3, passed 0.", constraint).follow == ONWARD


def test_a_turn_that_is_claimed_and_cannot_be_done_is_known_as_that() -> None:
    known = DecodingContext(Progress(2, 3, 0), ONWARD, turn_may_be_done=False)
    assert wanting(known, "turn 3").refused == DONE
    assert wanting(DecodingContext(Progress(2, 2, 0), ONWARD, turn_may_be_done=False), "last").refused == DONE
    assert not wanting(DecodingContext(Progress(2, 3, 0), ONWARD), "turn 3").overruled


@pytest.mark.parametrize(
    ("words", "wanted"),
    [("turn 3 of 3, passed 2.", DONE), ("turn 3 of 4, passed 1.", DONE), ("turn 1 of 3, passed 7.", BACK)],
)
def test_what_a_line_goes_on_with_does_not_change_what_it_was_corrected_for(words: str, wanted: str) -> None:
    assert wanting(DecodingContext(Progress(2, 3, 1), ONWARD, turn_may_be_done=False), words).refused == wanted


@pytest.mark.parametrize(("words", "said"), [("Plan: stop now.\n", True), ("Plan: stop", False), ("", False)])
def test_a_plan_is_said_once_its_line_is_complete(words: str, said: bool) -> None:
    constraint = TextConstraint(DecodingContext(), letters)
    for line in words.splitlines(keepends=True):
        if line.endswith("\n"):
            constraint.replace_line(line.rstrip("\n"))
    assert constraint.has_plan == said


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


def said(artifacts: Artifacts, text: str, known: DecodingContext) -> tuple[str, TextConstraint, bool]:
    """(text, its constraint, whether what was fed is what was said) of a model that would say `text`."""
    language = LanguageModel(artifacts, threads=1)
    tail = language.prompt.tail((), known.before)
    tokenizer = Tokenizer.from_buffer(artifacts.contents["tokenizer.json"])
    lines = [tokenizer.encode(line, add_special_tokens=False).ids for line in text.splitlines(keepends=True)]
    script = Script([*lines[:-1], [*lines[-1], language.runtime.im_end_id]], len(tail.ids))
    language.prefill_call = language.decode_call = cast("Call", script)
    constraint = language.constraint(known)
    made = language.generate([tail], max_new_tokens=60, cancelled=lambda: False, constraint=constraint)
    assert made.last_layer_kv.shape[1] == made.prompt_tokens + made.new_tokens
    return made.text, constraint, script.heard() == list(made.token_ids)


TEXT = "Situation: in a corridor.\nMotion: nobody near.\nProgress: {}\nPlan: {}.\nwaypoints: (2.0, 0.1)"
BEFORE = Progress(2, 3, 1)


@pytest.mark.parametrize("follow", [ONWARD, EITHER_WAY])
@pytest.mark.parametrize("progress", [BEFORE, Progress(2, 3, 2), Progress(3, 3, 0)])
def test_a_text_that_goes_onward_is_left_as_the_model_says_it(
    artifacts: Artifacts, progress: Progress, follow: str
) -> None:
    text = TEXT.format(format_progress(progress), "turn left into the room in 3 m")
    made, constraint, heard = said(artifacts, text, DecodingContext(BEFORE, follow))
    assert (made, constraint.overruled, heard, constraint.turn) == (text, False, True, TurnObservation("left", 3.0))


@pytest.mark.parametrize("wrong", [Progress(1, 3, 0), Progress(2, 2, 1), Progress(4, 3, 0), Progress(2, 3, 7)])
def test_a_text_that_does_not_is_held_to_the_grammar_and_the_model_hears_it(
    artifacts: Artifacts, wrong: Progress
) -> None:
    text = TEXT.format(format_progress(wrong), "turn back")
    made, constraint, heard = said(artifacts, text, DecodingContext(BEFORE, ONWARD))
    assert constraint.overruled and heard and parse_progress(made) in allowed_progress(BEFORE, ONWARD)
    assert made.startswith("Situation: in a corridor.\n") and made.endswith("Plan: turn back.\nwaypoints: (2.0, 0.1)")


def test_a_turn_is_undone_where_either_way_may_be_said(artifacts: Artifacts) -> None:
    text = TEXT.format("turn 1 of 1, passed 0.", "turn back")
    last_leg = Progress(2, 1, 0)
    held = TEXT.format("last leg of 1, passed 0.", "turn back")
    assert said(artifacts, text, DecodingContext(last_leg, ONWARD))[0] == held
    assert said(artifacts, text, DecodingContext(last_leg, EITHER_WAY))[0] == text


def test_with_nothing_known_the_model_says_what_it_will(artifacts: Artifacts) -> None:
    text = TEXT.format("turn 9 of 9, passed 9.", "turn left into the room in 9 m")
    made, constraint, heard = said(artifacts, text, DecodingContext())
    assert (made, constraint.overruled, heard) == (text, False, True)


@pytest.mark.parametrize(("left_m", "told"), [((3.0, 3.0, 2.9), "in 3 m"), ((0.5, 0.2), "now"), ((11.0,), "in 12 m")])
def test_a_turn_that_looks_nearer_is_said_nearer_and_the_model_hears_that_alone(
    artifacts: Artifacts, left_m: tuple[float, ...], told: str
) -> None:
    text = TEXT.format(format_progress(BEFORE), "turn left into the corridor {}")
    known = DecodingContext(BEFORE, ONWARD, TurnDistances("left", left_m))
    made, constraint, heard = said(artifacts, text.format("in 12 m"), known)
    assert made == text.format(told) and heard
    assert constraint.turn == TurnObservation("left", 12.0)


def test_a_turn_that_was_not_made_is_still_to_come(artifacts: Artifacts) -> None:
    text = TEXT.format(format_progress(Progress(3, 3, 0)), "turn back")
    made, constraint, heard = said(artifacts, text, DecodingContext(BEFORE, ONWARD, None, turn_may_be_done=False))
    assert parse_progress(made) == BEFORE and constraint.overruled and heard


def test_another_turn_is_as_far_as_the_model_says(artifacts: Artifacts) -> None:
    text = TEXT.format(format_progress(Progress(3, 3, 0)), "turn left into the corridor in 12 m")
    assert said(artifacts, text, DecodingContext(BEFORE, ONWARD, TurnDistances("left", (1.0, 1.0, 1.0))))[0] == text
