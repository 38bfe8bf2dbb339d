"""Instructions that begin with a turn on the spot: control makes it, and reasoning gets the rest."""

from __future__ import annotations

from dataclasses import replace
from math import pi

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.geometry import SE2
from edge.reasoning.generation_cycle import ReasoningConfig
from edge.reasoning.instruction_state import Instructions
from edge.reasoning.told_turn import split_turn
from edge.state.ring import EncodedFrame
from edge.state.semantic import SemanticSlot, ToldTurn
from sim_hil.benchmark.language.instruction_words import AROUND
from tests.support.runner.reasoning_bench import KV, Bench, Clock

CONFIG = ReasoningConfig((0.0, 3.0), 4)


@pytest.mark.parametrize(
    ("text", "turn_rad", "rest"),
    [
        ("Turn around, leave the room, then go left.", pi, "Leave the room, then go left."),
        ("turn round. Take the first right.", pi, "Take the first right."),
        ("Hey robot, turn around; head straight on.", pi, "Head straight on."),
        ("Could you please turn around and then leave the room?", pi, "Leave the room?"),
        ("Okay, make a U-turn. After that follow the hall.", pi, "Follow the hall."),
        ("Turn left on the spot, then go straight.", pi / 2, "Go straight."),
        ("Now, turn on the spot to the right. Stop at the bench.", -pi / 2, "Stop at the bench."),
        ("Turn to face left and follow the corridor", pi / 2, "Follow the corridor"),
        ("Find the red bench. Turn around. Go on.", pi, "Find the red bench. Go on."),
        ("hey robot, hello robot, please turn around", pi, ""),
        ("robot, go to the drum: turn round, then walk along the row", pi, "Go to the drum: walk along the row"),
        ("Turn around!", pi, ""),
        ("please turn around", pi, ""),
    ],
)
def test_a_clause_at_the_beginning_is_split_off(text: str, turn_rad: float, rest: str) -> None:
    turn, found = split_turn(text)
    assert turn is not None and turn.turn_rad == pytest.approx(turn_rad) and found == rest


@pytest.mark.parametrize(
    "text",
    ["Turn around the corner and stop.", "Turn left, then go straight.", "Leave the room and turn around.",
     "Go around the table.", "Take the first right turn, around the plant.", "Do not turn around.", "",
     "Go to the bench. Turn around and come back.", "Find the red bench. Turn around.",
     "Turn around, if you see a door.", "hey robot " * 39 + "go", "please " * 57 + "x"],
)  # fmt: skip
def test_any_other_instruction_is_left_whole(text: str) -> None:
    assert split_turn(text) == (None, text)


@given(st.text("turn aroundleft,.;:?! \nspotheyrbi", max_size=400))
def test_whatever_the_text_it_is_split_at_once_and_nothing_is_added(text: str) -> None:
    turn, rest = split_turn(text)
    assert rest == text if turn is None else len(rest) < len(text)


def test_control_gets_the_turn_and_reasoning_the_rest() -> None:
    slot = SemanticSlot()
    made = Instructions(CONFIG, slot, "Turn around. Go to the bench.")
    assert slot.turn is not None and slot.turn.turn_rad == pytest.approx(pi)
    assert made.job.instruction == "Go to the bench."


def test_the_job_is_ready_when_its_turn_has_ended_and_begins_there() -> None:
    slot = SemanticSlot()
    made = Instructions(CONFIG, slot, "Turn around. Go to the bench.")
    assert not made.ready(made.job, 5)
    assert slot.turn is not None
    slot.end(slot.turn)
    assert made.ready(made.job, 7) and made.job.memory.from_ns == 7
    assert made.ready(made.job, 9) and made.job.memory.from_ns == 7, "it begins once"


def test_after_a_turn_alone_the_instruction_before_goes_on_with_its_memory() -> None:
    slot = SemanticSlot()
    made = Instructions(CONFIG, slot, "Go to the bench.")
    before = made.job
    after = made.next("Turn around.", 3)
    assert slot.turn is not None and after == replace(before, number=1) and after.memory is before.memory


def test_the_model_reads_a_turn_alone_as_the_first_instruction() -> None:
    slot = SemanticSlot()
    assert Instructions(CONFIG, slot, "Turn around.").job.instruction == "Turn around." and slot.turn is None


def test_an_instruction_without_a_turn_ends_the_one_before_it() -> None:
    slot = SemanticSlot()
    made = Instructions(CONFIG, slot, "Turn around. Go to the bench.")
    job = made.next("Go to the door.", 4)
    assert slot.turn is None and job.instruction == "Go to the door." and made.ready(job, 8) and job.memory.from_ns == 4


def test_the_end_of_a_turn_does_not_end_the_one_that_has_replaced_it() -> None:
    slot, first, second = SemanticSlot(), ToldTurn(pi), ToldTurn(pi)
    slot.tell(first)
    slot.tell(second)
    slot.end(first)
    assert slot.turn is second
    slot.end(second)
    assert slot.turn is None


def test_without_recoveries_the_model_reads_the_turn() -> None:
    slot = SemanticSlot()
    made = Instructions(replace(CONFIG, turns_as_told=False), slot, "Turn around. Go to the bench.")
    assert made.job.instruction == "Turn around. Go to the bench." and slot.turn is None


def test_waiting_for_a_turn_is_no_call_that_hangs_and_forgets_the_texts_that_held_the_robot() -> None:
    clock = Clock()
    bench = Bench(clock=clock)
    bench.cycle.invalid_in_a_row = 3
    bench.loop.submit("Turn around. Go to the bench.")
    clock.s += 60.0
    assert not bench.loop.step()
    assert bench.loop.last_progress_ns == clock() and bench.cycle.invalid_in_a_row == 0


def test_reasoning_waits_for_the_turn_and_sees_nothing_from_before_its_end() -> None:
    bench = Bench(instruction=f"Turn {AROUND}, go to the bench.")
    for second in (1, 2, 3, 4):
        bench.frame(second)
    assert not bench.loop.step() and bench.language.prompts == []
    assert bench.slot.turn is not None
    bench.slot.end(bench.slot.turn)
    bench.ring.put(EncodedFrame(5 * 10**9, SE2(4.0, 0.0, pi), KV))
    bench.loop.step()
    bench.ring.put(EncodedFrame(6 * 10**9, SE2(4.0, 0.0, pi), KV))
    bench.loop.step()
    assert set(bench.language.instructions) == {"Go to the bench."}
    assert bench.language.prompts and min(stamp for prompt in bench.language.prompts for stamp in prompt) >= 5.0
