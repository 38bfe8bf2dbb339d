"""The switches of decoding rules and recoveries: their defaults, what overrides them, and what each turns off."""

from __future__ import annotations

import numpy as np
import pytest

from edge.core.geometry import SE2
from edge.motion.recovery import ARRIVED
from edge.reasoning.decoding_rules import FREE, DecodingContext, TextConstraint
from edge.reasoning.instruction_state import InstructionMemory
from edge.reasoning.line_constraint import TextForms
from edge.run import command as runner
from edge.state.ring import EncodedFrame
from edge.state.switches import Decoding, RecoverySwitch, Speculation, Switches, SwitchOptions
from firmware_bridge.core.config import ConfigError
from sim_hil.realtime.robots import GO2
from tests.support.runner.control_bench import Bench

CONSTRAINED, ON, OFF = Decoding.CONSTRAINED, RecoverySwitch.ON, RecoverySwitch.OFF


def asked(*arguments: str) -> SwitchOptions:
    """Switches that the runner's command line asks for."""
    command = ["--artifacts", "a", "--robot", str(GO2.file), "--instruction", "stop at the desk", *arguments]
    return runner.read_options(runner.parser().parse_args(command))[1].switches


def in_force(*arguments: str, recovery: RecoverySwitch = ON) -> Switches:
    """Over a manifest's defaults."""
    return asked(*arguments).over(Switches(CONSTRAINED, recovery, False), stand_at_goal=True)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ((), Switches(CONSTRAINED, ON, True)),
        (("--no-stay",), Switches(CONSTRAINED, ON, False)),
        (("--stay",), Switches(CONSTRAINED, ON, True)),
        (("--decoding", "free"), Switches(Decoding.FREE, ON, True)),
        (("--recovery", "off"), Switches(CONSTRAINED, OFF, False)),
        (("--speculation", "off"), Switches(CONSTRAINED, ON, True, Speculation.OFF)),
        (("--recovery", "off", "--no-stay"), Switches(CONSTRAINED, OFF, False)),
    ],
)
def test_every_rule_is_on_unless_an_option_disables_it(arguments: tuple[str, ...], expected: Switches) -> None:
    assert in_force(*arguments) == expected


def test_an_option_overrides_the_manifest() -> None:
    assert in_force(recovery=OFF) == Switches(CONSTRAINED, OFF, False)
    assert in_force("--recovery", "on", recovery=OFF) == Switches(CONSTRAINED, ON, True)


def test_standing_at_the_goal_without_recovery_is_refused_in_one_line() -> None:
    with pytest.raises(ConfigError, match="expected --recovery on with it, found off") as caught:
        asked("--recovery", "off", "--stay")
    assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match="found off"):
        in_force("--stay", recovery=OFF)


# Decoding

TEXT = "Progress: turn 2 of 3, passed 0.\nPlan: turn left into the room in 6 m.\nwaypoints: (1.0, 0.0) (2.0, 0.0)"


def letters(text: str) -> list[int]:
    return [ord(letter) for letter in text]


def context_after_a_text(decoding: Decoding) -> DecodingContext:
    memory, frame = (
        InstructionMemory(None, "go", decoding),
        EncodedFrame(10**9, SE2(0.0, 0.0, 0.0), np.zeros(1, np.float32)),
    )
    constraint = TextConstraint(memory.context(frame), letters, TextForms(letters))
    for line in TEXT.split("\n"):
        constraint.replace_line(line)
    memory.update(TEXT, constraint, frame)
    return memory.context(frame)


def test_constrained_decoding_knows_the_turn_and_what_may_follow() -> None:
    context = context_after_a_text(CONSTRAINED)
    assert context.turn is not None and not context.turn_may_be_done and context.follow != FREE and context.keeps_form


def test_free_decoding_gives_the_prompt_its_progress_and_constrains_nothing() -> None:
    context = context_after_a_text(Decoding.FREE)
    assert context == DecodingContext(context_after_a_text(CONSTRAINED).before)
    constraint = TextConstraint(context, letters)
    answer = "Progress: last leg of 9, passed 0.\n"
    assert "".join(chr(constraint.choose(ord(letter))) for letter in answer) == answer
    assert constraint.replace_line("Plan: turn left into the room in 9 m.") is None


# Recovery

STANDS = "Plan: turn right into the room in 3 m.\nwaypoints: (1.0, -1.0) (1.0, -2.0) (1.0, -4.0)"


def reasons_at_a_standstill(switches: Switches) -> set[str]:
    """Of 10 s in which the plan stands while the waypoints lead to the right."""
    bench = Bench(switches=switches)
    bench.policy.step = (0.0, 0.0, 0.0)
    bench.see(0.0)
    reasons = set()
    for number in range(100):
        if number % 10 == 0:
            bench.think(number, 0.0, text=STANDS)
        bench.see(0.0)
        reasons.add(bench.tick()[1])
    return reasons


def test_without_recovery_only_the_plan_moves_the_robot() -> None:
    assert "turning-to-waypoints" in reasons_at_a_standstill(Switches())
    assert reasons_at_a_standstill(Switches(CONSTRAINED, OFF, False)) == {"ok"}


@pytest.mark.parametrize(
    ("switches", "reason"),
    [(Switches(), ARRIVED), (Switches(CONSTRAINED, ON, False), "ok"), (Switches(CONSTRAINED, OFF, False), "ok")],
)
def test_the_robot_stands_at_the_goal_only_where_that_is_on(switches: Switches, reason: str) -> None:
    bench = Bench(switches=switches)
    bench.drive()
    bench.think(stop=SE2(bench.walked_m + 0.1, 0.0, 0.0))
    bench.see()
    assert bench.tick()[1] == reason
