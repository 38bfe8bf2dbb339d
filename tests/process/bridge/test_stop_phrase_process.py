"""`edge-say stop` as a process, with the real bridge and the real runner; the robot's side is the judge."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from firmware_bridge.operate import operate
from firmware_bridge.unitree.messages import ids
from tests.support.processes import (
    GO2_SIM,
    REPOSITORY,
    HostStall,
    Running,
    check_stop_latency,
    hil_arguments,
    running,
    wait_for,
)
from tests.support.robot.fake_go2 import FakeGo2
from tools.bench.stop import received_moves

pytestmark = pytest.mark.process

ZERO = (0.0, 0.0, 0.0)


def say(text: str, *arguments: object, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run edge-say as a user whose own folder for sockets is `folder`, so that no other bridge is found."""
    command = [sys.executable, "-m", "edge.run.say", text, *map(str, arguments)]
    environment = {**os.environ, "XDG_RUNTIME_DIR": str(folder)}
    return subprocess.run(
        command, capture_output=True, text=True, timeout=30, cwd=REPOSITORY, check=False, env=environment
    )


def test_with_neither_a_runner_nor_a_bridge_it_fails_and_names_the_remote(tmp_path: Path) -> None:
    done = say("stop", "--to", tmp_path / "say.sock", folder=tmp_path)
    assert done.returncode == 1 and done.stdout == ""
    assert "NOT confirmed" in done.stderr and "use the remote" in done.stderr


# A robot at the wire, the real bridge, the smallest driver


@pytest.fixture
def robot(dds_domain: int) -> Iterator[FakeGo2]:
    """Gone at the end of its test: the simulated robot below must be the only one."""
    robot = FakeGo2(dds_domain)
    yield robot
    robot.close()


@dataclass(frozen=True)
class Side:
    """The bridge's side of one robot."""

    bridge: Running
    socket: Path
    folder: Path

    def drive(self) -> object:
        return running("tests.support.robot.bridge_driver", self.socket, 0.5, folder=self.folder)


@pytest.fixture
def side(robot: FakeGo2, dds_domain: int, tmp_path: Path) -> Iterator[Side]:
    socket = tmp_path / "bridge.sock"
    robot.reset()
    arguments = ("--robot", GO2_SIM, "--domain", dds_domain, "--socket", socket)
    with running("firmware_bridge.bridge", *arguments, folder=tmp_path) as bridge:
        robot.reset()
        yield Side(bridge, socket, tmp_path)


def test_a_driven_robot_stops_and_no_runner_arms_before_an_operator_does(robot: FakeGo2, side: Side) -> None:
    with HostStall() as host, side.drive():
        wait_for(robot.is_driven, 20, "the robot is driven")
        done = say("STOP now!", "--to", side.folder / "none", "--socket", side.socket, folder=side.folder)
        ended_ns = time.monotonic_ns()
        assert done.returncode == 0, done.stderr
        assert "stopped" in done.stdout and "`edge-bridge arm`" in done.stdout
        first_zero = next(command for command in robot.moves() if command.velocity == ZERO and _lasts(robot, command))
        check_stop_latency(first_zero.received_ns - ended_ns, 0, ended_ns, host)
        assert ids.STOP_MOVE in [command.api_id for command in robot.received]
    with side.drive():
        wait_for(lambda: "arm refused" in side.bridge.stderr(), 10, "the refusal")
        time.sleep(0.5)
        assert not robot.is_driven()
        wait_for(lambda: operate("arm", side.socket)[0] == 0, 5, "the permission")
        wait_for(robot.is_driven, 20, "the robot is driven again")


def _lasts(robot: FakeGo2, command: object) -> bool:
    """Whether nothing but zero came after this one."""
    moves = robot.moves()
    return all(later.velocity == ZERO for later in moves[moves.index(command) :])  # type: ignore[arg-type]


def test_a_bridge_that_hangs_is_no_confirmed_stop(robot: FakeGo2, side: Side) -> None:
    os.kill(side.bridge.pid, signal.SIGSTOP)
    try:
        done = say("stop", "--to", side.folder / "none", "--socket", side.socket, folder=side.folder)
    finally:
        os.kill(side.bridge.pid, signal.SIGCONT)
    assert done.returncode == 1 and done.stdout == ""
    assert "NOT confirmed" in done.stderr


def test_a_text_with_a_stop_word_in_it_stops_nothing(robot: FakeGo2, side: Side) -> None:
    with side.drive():
        wait_for(robot.is_driven, 20, "the robot is driven")
        done = say("stop at the door", "--to", side.folder / "none", "--socket", side.socket, folder=side.folder)
        assert done.returncode == 2  # there is no runner that takes instructions
        time.sleep(0.3)
        assert robot.is_driven()


# The simulated robot, the real bridge, the real runner


class Stack:
    """A simulated robot with a bridge in front of it; `drive` lets the runner take instructions."""

    def __init__(self, folder: Path, domain: int, artifacts: Path) -> None:
        self.folder, self.domain, self.artifacts = folder, domain, artifacts
        self.bridge, self.instructions, self.trace = folder / "b.sock", folder / "say.sock", folder / "trace.jsonl"

    def drive(self, ready: str = "driving") -> object:
        where = ("--robot", GO2_SIM, "--socket", self.bridge, "--domain", self.domain)
        texts = ("--instruction", "walk down the corridor", "--instructions", self.instructions)
        return running(
            "edge.run.command", "--artifacts", self.artifacts, *where, *texts, folder=self.folder, ready=ready
        )

    def say(self, text: str) -> subprocess.CompletedProcess[str]:
        return say(text, "--to", self.instructions, folder=self.folder)

    def moves(self) -> list[tuple[int, bool]]:
        """Every velocity command that reached the robot: stamp, and whether it was zero."""
        return [(stamp_ns, not any(velocity)) for stamp_ns, velocity in received_moves(self.trace)]

    def is_moving(self) -> bool:
        moves = self.moves()
        return bool(moves) and not moves[-1][1]


@pytest.fixture
def stack(tmp_path: Path, dds_domain: int, nano_dir: Path) -> Iterator[Stack]:
    stack = Stack(tmp_path, dds_domain, nano_dir)
    hil = hil_arguments(dds_domain, "--people", 2, "--seed", 1, "--trace", stack.trace)
    bridge = ("--robot", GO2_SIM, "--socket", stack.bridge, "--domain", dds_domain)
    with (
        running("sim_hil.hil.command", *hil, folder=tmp_path),
        running("firmware_bridge.bridge", *bridge, folder=tmp_path),
    ):
        yield stack


def check_stands(stack: Stack, host: HostStall, ended_ns: int) -> None:
    """Nothing but zero has reached the robot since edge-say has ended."""
    time.sleep(1.0)
    last_moving_ns = max(stamp_ns for stamp_ns, zero in stack.moves() if not zero)
    check_stop_latency(last_moving_ns - ended_ns, 0, ended_ns, host)
    assert not stack.is_moving()


@pytest.mark.slow
def test_the_runners_bridge_is_stopped_as_by_an_operator_and_its_run_ends(stack: Stack) -> None:
    with HostStall() as host, stack.drive() as runner:
        wait_for(stack.is_moving, 20, "the robot to be told to move")
        done = stack.say("stop")
        ended_ns = time.monotonic_ns()
        assert done.returncode == 0, done.stderr
        assert "`edge-bridge arm`" in done.stdout
        assert runner.process.wait(20) == 1
        assert "The instruction channel received a stop phrase." in runner.stderr()
        assert "new instruction" not in runner.stderr()
        check_stands(stack, host, ended_ns)
    assert operate("status", stack.bridge)[1]["blocked_by"] == "estop"


DENIED = """
import sys
from firmware_bridge import operate
from firmware_bridge.peer import BridgeUnavailable

def denied(*_, **__):
    raise BridgeUnavailable("no permission") from PermissionError()

operate.BridgeClient = denied
from edge.run.say import main
sys.exit(main())
"""
"""`edge-say` of a user who may not reach the bridge: root, as whom tests may run, may always."""


@pytest.mark.slow
def test_without_a_bridge_that_this_user_can_reach_the_runner_stops_the_robot_itself(stack: Stack) -> None:
    with HostStall() as host, stack.drive() as runner:
        wait_for(stack.is_moving, 20, "the robot to be told to move")
        command = [sys.executable, "-c", DENIED, "halt", "--to", stack.instructions]
        done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False, timeout=300)
        ended_ns = time.monotonic_ns()
        assert done.returncode == 0, done.stderr
        assert "no operator's stop was possible" in done.stdout
        assert runner.process.wait(20) == 1
        check_stands(stack, host, ended_ns)


@pytest.mark.slow
def test_a_stop_phrase_while_the_robot_stands_up_ends_the_arming(stack: Stack) -> None:
    with stack.drive(ready="edge-run") as runner:
        wait_for(stack.instructions.exists, 60, "the instruction socket")
        done = stack.say("stop")
        assert done.returncode == 0, done.stderr
        code = runner.process.wait(20)
        # Its start may be over before the phrase arrives: then it is a run that ended.
        assert code == 3 or (code == 1 and "driving" in runner.stderr())
        assert not stack.is_moving()
