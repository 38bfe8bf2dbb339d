"""The operator's path as one property: `edge-bridge stop`, `arm`, `release` and `status` in any order, over a line that
loses messages, breaks or hangs, beside a runner that asks and drives. A confirmed stop is a robot that stands still and
stays so; a confirmed arm is a permission that a waiting runner may use; asking for the status changes nothing.
"""

from __future__ import annotations

import contextlib
import io
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule, run_state_machine_as_test

from firmware_bridge import operate as operate_module
from firmware_bridge.client import BridgeUnavailable
from firmware_bridge.core.link import Arm, BridgeStatus, Message, Release, Stop, Velocity
from firmware_bridge.operate import operate
from tests.support.robot.bridge_bench import MS
from tests.support.robot.bridge_world import World

SOCKET = Path("/nowhere/bridge.sock")
IDLE = ("stopped", "disarmed")
STILL_MPS = 0.05


class Desk:
    """A world's bridge behind the operator's socket, whose clock runs while the operator waits.

    `runner`: "absent", "asks" once a second, or "drives" too. `line`: "good", "loses" every second message, "breaks" at
    its first three polls, "hangs" (the bridge gets no processor), "refuses" (no listener) or "denies" this user.
    """

    def __init__(self, *, operator_arm: bool) -> None:
        self.world = World(operator_arm=operator_arm)
        self.runner, self.line = "absent", "good"
        self.sent: list[Message] = []
        self._waiting: list[Message] = []
        self._asked_ns = self._commanded_ns = -(2**62)
        self._breaks = 0
        self.status = self.world.step().status

    def run(self, command: str) -> tuple[int, dict[str, object], str]:
        """The command's exit code, result and messages."""
        self.sent.clear()
        self._breaks = 3 if self.line == "breaks" else 0
        with self._in_place(), contextlib.redirect_stderr(io.StringIO()) as said:
            code, result = operate(command, SOCKET)
        return code, result, said.getvalue()

    def wait(self, ms: int) -> None:
        for _ in range(max(ms // 10, 1)):
            self._pass(10 * MS)

    @contextmanager
    def _in_place(self) -> Iterator[None]:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(operate_module, "BridgeClient", lambda _, first: _Client(self, first))
            patch.setattr(operate_module, "time", self)
            yield

    # The functions of `time` that the command uses.

    def monotonic_ns(self) -> int:
        return self.world.bench.now_ns

    def sleep(self, seconds: float) -> None:
        self._pass(round(seconds * 1e9))

    def connect(self) -> None:
        if self.line == "refuses":
            raise BridgeUnavailable("no bridge") from ConnectionRefusedError()
        if self.line == "denies":
            raise BridgeUnavailable("no permission") from PermissionError()

    def send(self, message: Message) -> None:
        self.sent.append(message)
        if self.line != "loses" or len(self.sent) % 2 == 0:
            self._waiting.append(message)

    def poll(self) -> BridgeStatus:
        if self._breaks:
            self._breaks -= 1
            self._waiting.clear()
            raise BridgeUnavailable("the bridge has closed the connection")
        return self.status

    def _pass(self, duration_ns: int) -> None:
        """Let time pass; the runner acts, and the bridge takes what waits."""
        world = self.world
        world.bench.now_ns += duration_ns
        if self.line == "hangs":
            return
        messages: list[Message] = []
        now_ns = world.bench.now_ns
        if self.runner != "absent" and world.state in IDLE and now_ns - self._asked_ns >= 1_000 * MS:
            self._asked_ns = now_ns
            messages.append(Arm())
        if self.runner == "drives" and now_ns - self._commanded_ns >= 100 * MS:
            self._commanded_ns = now_ns
            world.bench.seq += 1
            messages.append(Velocity(world.bench.seq, now_ns, 0.6, 0.0, 0.2))
        self.status = world.step(*messages, operator=tuple(self._waiting)).status
        self._waiting.clear()


class _Client:
    """What `operate` uses of `BridgeClient`."""

    def __init__(self, desk: Desk, first: Message | None) -> None:
        self._desk = desk
        desk.connect()
        if first is not None:
            desk.send(first)

    def stop(self) -> None:
        self._desk.send(Stop())

    def arm(self) -> None:
        self._desk.send(Arm())

    def release(self) -> None:
        self._desk.send(Release())

    def poll(self) -> BridgeStatus:
        return self._desk.poll()

    def close(self) -> None:
        """Nothing is open."""


class OperatorMachine(RuleBasedStateMachine):
    """Each rule is one command of the operator, or one event around the bridge."""

    commands = 0
    confirmed_stops = confirmed_arms = 0

    @initialize(operator_arm=st.booleans())
    def robot_file(self, operator_arm: bool) -> None:
        self.desk = Desk(operator_arm=operator_arm)

    def _run(self, command: str) -> tuple[int, dict[str, object], str]:
        OperatorMachine.commands += 1
        code, result, said = self.desk.run(command)
        assert code in (0, 1, 3) and said.startswith("edge-bridge: ")
        if self.desk.line in ("refuses", "denies"):
            assert code == 3 and "error" in result
            assert ("NOT stopped" in said) == (command == "stop")
        return code, result, said

    @rule()
    def operator_stops(self) -> None:
        desk, world = self.desk, self.desk.world
        code, result, _ = self._run("stop")
        if desk.line in ("good", "loses", "breaks"):
            assert world.rules.held and world.state in IDLE, "a stop that arrived holds, confirmed or not"
        if code == 0:
            OperatorMachine.confirmed_stops += 1
            assert (result["blocked_by"], result["motion"]) == ("estop", "still") and result["state"] in IDLE
            assert world.rules.held and abs(world.robot.speed_mps) < STILL_MPS
            desk.wait(3_000)  # with a runner that goes on asking and commanding
            assert world.state in IDLE and abs(world.robot.speed_mps) < STILL_MPS
        elif desk.line == "good" and not (world.silent or world.publishers):
            assert abs(world.robot.speed_mps) >= STILL_MPS or code == 0, "a robot that stands still confirms"

    @rule()
    def operator_arms(self) -> None:
        desk, rules = self.desk, self.desk.world.rules
        needed, idle = rules.needs_operator, desk.world.state in IDLE
        code, result, _ = self._run("arm")
        if code == 0:
            OperatorMachine.confirmed_arms += needed
            assert result["permit"] != "needed" or result["state"] in ("arming", "armed")
            assert not (needed and idle) or desk.runner != "absent" or rules.asked_ns is not None
        assert not rules.held or desk.world.state in IDLE or rules.arming_is_permitted

    @rule()
    def operator_asks_for_the_status(self) -> None:
        held = self.desk.world.rules.held
        code, result, _ = self._run("status")
        assert self.desk.sent == [] and self.desk.world.rules.held == held
        if self.desk.line in ("good", "loses"):
            assert code == 0 and result["state"] == self.desk.world.state

    @rule()
    def operator_releases(self) -> None:
        code, result, _ = self._run("release")
        if code == 0:
            assert result["state"] in IDLE and not result["zero_after_stop"]

    @rule(runner=st.sampled_from(("absent", "asks", "drives", "drives")))
    def runner_changes(self, runner: str) -> None:
        desk = self.desk
        desk.runner, desk.world.bench.client = runner, runner != "absent"
        desk.wait(300)

    @rule(runner=st.sampled_from(("asks", "drives")), ms=st.integers(1_500, 4_000))
    def all_is_well_for_a_while(self, runner: str, ms: int) -> None:
        self.desk.line = "good"
        self.desk.world.recover()
        self.desk.runner = runner
        self.desk.wait(ms)

    @rule(line=st.sampled_from(("good", "good", "good", "loses", "breaks", "hangs", "refuses", "denies")))
    def line_changes(self, line: str) -> None:
        self.desk.line = line

    @rule(silent=st.booleans())
    def robot_stops_reporting(self, silent: bool) -> None:
        self.desk.world.silent = silent

    @rule(pressed=st.booleans())
    def local_input(self, pressed: bool) -> None:
        self.desk.world.gpio = pressed
        self.desk.wait(20)

    @rule(ms=st.sampled_from((10, 300, 1_100, 3_100, 10_100)))
    def time_passes(self, ms: int) -> None:
        self.desk.wait(ms)


def run(max_examples: int) -> None:
    """Run the machine with 30 rules an example; the same every time."""
    World.core_steps = OperatorMachine.commands = 0
    OperatorMachine.confirmed_stops = OperatorMachine.confirmed_arms = 0
    run_state_machine_as_test(
        OperatorMachine,
        settings=settings(
            max_examples=max_examples,
            stateful_step_count=30,
            deadline=None,
            derandomize=True,
            database=None,
            phases=(Phase.explicit, Phase.generate),
            suppress_health_check=list(HealthCheck),
        ),
    )
    found = (
        OperatorMachine.commands,
        World.core_steps,
        OperatorMachine.confirmed_stops,
        OperatorMachine.confirmed_arms,
    )
    sys.stdout.write("{} commands, {} core steps, {} stops and {} arms confirmed\n".format(*found))


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_what_an_operator_is_told_is_true_over_a_hundred_thousand_steps() -> None:
    run(40)
    assert World.core_steps >= 100_000 and OperatorMachine.commands >= 300
    assert OperatorMachine.confirmed_stops >= 40 and OperatorMachine.confirmed_arms >= 8
