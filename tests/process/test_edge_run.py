"""`edge-run` as a process, with the real bridge and the real simulated robot; the robot's side is the judge."""

from __future__ import annotations

import fcntl
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from edge.flightlog.reader import read_messages
from firmware_bridge.operate import operate
from tests.support.processes import (
    GO2_SIM,
    REPOSITORY,
    HostStall,
    Running,
    check_stop_latency,
    hil_arguments,
    need_room_to_record,
    read_trace,
    running,
    wait_for,
)
from tools.bench.stop import received_moves

pytestmark = pytest.mark.process

INSTRUCTION = "walk down the corridor and stop at the vending machine"
STOP_BOUND_NS = 300_000_000


class Robot:
    """A simulated robot with a bridge in front of it."""

    def __init__(self, folder: Path, domain: int, artifacts: Path) -> None:
        self.folder = folder
        self.domain = domain
        self.artifacts = artifacts
        self.socket = folder / "b.sock"
        self.trace = folder / "trace.jsonl"

    def arguments(self, *more: object) -> tuple[object, ...]:
        where = ("--robot", GO2_SIM, "--socket", self.socket, "--domain", self.domain)
        return ("--artifacts", self.artifacts, "--instruction", INSTRUCTION, *where, *more)

    def moves(self) -> list[tuple[int, bool]]:
        """Every velocity command that reached the robot: stamp, and whether it was zero."""
        return [(stamp_ns, not any(velocity)) for stamp_ns, velocity in received_moves(self.trace)]

    def is_moving(self) -> bool:
        moves = self.moves()
        return bool(moves) and not moves[-1][1]


@pytest.fixture
def robot(tmp_path: Path, dds_domain: int, nano_dir: Path) -> Iterator[Robot]:
    robot = Robot(tmp_path, dds_domain, nano_dir)
    hil = hil_arguments(dds_domain, "--people", 2, "--seed", 1, "--trace", robot.trace)
    bridge = ("--robot", GO2_SIM, "--socket", robot.socket, "--domain", dds_domain)
    with (
        running("sim_hil.hil.command", *hil, folder=tmp_path),
        running("firmware_bridge.bridge", *bridge, folder=tmp_path),
    ):
        yield robot


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "edge.run.command", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=90, cwd=REPOSITORY, check=False)


def drive(robot: Robot, *more: object) -> Running:
    """Context in which edge-run is driving; the robot has been told to move."""
    return running("edge.run.command", *robot.arguments(*more), folder=robot.folder, ready="driving")


def check_zero_in_time(robot: Robot, since_ns: int, host: HostStall) -> None:
    """The robot gets zero within the bound, and nothing but zero after that."""
    after = [(stamp_ns, zero) for stamp_ns, zero in robot.moves() if stamp_ns >= since_ns]
    zero_ns = next(stamp_ns for stamp_ns, zero in after if zero)
    check_stop_latency(zero_ns - since_ns, STOP_BOUND_NS, since_ns, host)
    assert all(zero for stamp_ns, zero in after if stamp_ns > zero_ns)


def test_a_run_drives_the_robot_and_leaves_it_standing_still(robot: Robot) -> None:
    need_room_to_record(robot.folder)
    flight = robot.folder / "flight.mcap"
    done = run(*robot.arguments("--duration", 8, "--release-delay", 1, "--record", flight, "--json", "-"))
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)

    assert result["faults"] == []
    assert result["control"]["ticks"] >= 60
    assert result["reasoning"]["generations"] >= 2
    assert result["bridge"]["zero_after_stop"] is True
    moves = robot.moves()
    assert any(not zero for _, zero in moves)
    assert moves[-1][1], "the last command on the wire is zero velocity"
    poses = [r for r in read_trace(robot.trace) if r["kind"] == "pose"]
    assert poses[-1]["x"] - poses[0]["x"] > 0.5

    records: dict[str, list[dict]] = {}
    for topic, _, payload in read_messages(flight):
        records.setdefault(topic, []).append(payload)
    ticks, states = records["/tick"], {s["generation"]: s for s in records["/semantic"]}
    assert len(ticks) == result["control"]["ticks"]
    driven = [t for t in ticks if t["generation"] is not None]
    first = ticks.index(driven[0])
    assert all(t["generation"] is not None for t in ticks[first:]), "after the first generation every tick has one"
    assert all(t["command"] == [0, 0, 0] for t in ticks[:first]), "before it the robot is told to stand still"
    for tick in driven:
        state = states[tick["generation"]]
        assert state["ready_ns"] <= tick["now_ns"]
        assert tick["delay_s"] == pytest.approx((tick["now_ns"] - state["frames_ns"][-1]) / 1e9, abs=1e-3)


@pytest.mark.slow
def test_killed_while_driving_the_robot_gets_zero_within_300_ms(robot: Robot) -> None:
    with drive(robot) as runner, HostStall() as host:
        wait_for(robot.is_moving, 20, "the robot to be told to move")
        time.sleep(1.0)
        runner.process.send_signal(signal.SIGKILL)
        killed_ns = time.monotonic_ns()
        runner.process.wait(5)
    time.sleep(1.0)
    check_zero_in_time(robot, killed_ns, host)


@pytest.mark.slow
def test_after_an_emergency_stop_the_runner_waits_and_reports_it_in_one_line_until_an_operator_arms_it(
    robot: Robot,
) -> None:
    waiting = "waiting for `edge-bridge arm`"
    assert operate("stop", robot.socket)[0] == 0
    with running("edge.run.command", *robot.arguments(), folder=robot.folder, ready=waiting) as runner:
        time.sleep(3.0)
        assert all(is_zero for _, is_zero in robot.moves()), "the stop itself sends one zero"
        assert operate("arm", robot.socket)[0] == 0
        wait_for(robot.is_moving, 30, "the robot to be told to move")
        assert runner.stderr().count(waiting) == 1


@pytest.mark.slow
def test_frozen_while_driving_the_robot_gets_zero_within_300_ms_and_old_commands_stay_dead(robot: Robot) -> None:
    with drive(robot) as runner, HostStall() as host:
        wait_for(robot.is_moving, 20, "the robot to be told to move")
        time.sleep(1.0)
        runner.process.send_signal(signal.SIGSTOP)
        frozen_ns = time.monotonic_ns()
        time.sleep(1.0)
        runner.process.send_signal(signal.SIGCONT)
        status = runner.process.wait(20)
    check_zero_in_time(robot, frozen_ns, host)
    assert status == 1, "a run that the bridge had to stop is a failed run"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "status"),
    [(signal.SIGINT, 130), (signal.SIGTERM, 0), pytest.param(signal.SIGHUP, 0, marks=pytest.mark.slow)],
)
def test_a_signal_ends_the_run_with_the_robot_standing_still(robot: Robot, number: int, status: int) -> None:
    result = robot.folder / "run.json"
    with drive(robot, "--json", result) as runner:
        wait_for(robot.is_moving, 20, "the robot to be told to move")
        runner.process.send_signal(number)
        assert runner.process.wait(20) == status
    assert json.loads(result.read_text())["bridge"]["zero_after_stop"] is True
    time.sleep(0.2)
    assert robot.moves()[-1][1], "the last command on the wire is zero velocity"


@pytest.mark.slow
def test_a_terminal_that_takes_nothing_does_not_keep_a_signal_from_stopping_the_robot(robot: Robot) -> None:
    """As with `edge-run 2>&1 | less` that nobody scrolls."""
    reader, writer = os.pipe()
    fcntl.fcntl(writer, fcntl.F_SETPIPE_SZ, 4096)
    os.write(writer, b"x" * fcntl.fcntl(writer, fcntl.F_GETPIPE_SZ))
    command = [sys.executable, "-m", "edge.run.command", *map(str, robot.arguments())]
    runner = subprocess.Popen(command, stderr=writer, cwd=REPOSITORY)
    try:
        wait_for(robot.is_moving, 30, "the robot to be told to move")
        runner.send_signal(signal.SIGTERM)
        assert runner.wait(20) == 0
    finally:
        runner.kill()
        runner.wait()
        os.close(reader)
        os.close(writer)
    assert robot.moves()[-1][1], "the last command on the wire is zero velocity"


def test_without_a_bridge_it_refuses(tmp_path: Path, nano_dir: Path, dds_domain: int) -> None:
    done = run(*Robot(tmp_path, dds_domain, nano_dir).arguments("--duration", 1))
    assert done.returncode == 3
    assert "start `edge-bridge" in done.stderr.splitlines()[-1]


@pytest.mark.slow
def test_an_instruction_that_would_not_fit_with_four_frames_is_refused(
    tmp_path: Path, nano_dir: Path, dds_domain: int
) -> None:
    robot = Robot(tmp_path, dds_domain, nano_dir)
    done = run(*robot.arguments("--instruction", "0123456789" * 40))
    assert done.returncode == 2
    assert "shorten it" in done.stderr


def test_artifacts_that_do_not_verify_are_refused_by_name(tmp_path: Path, nano_dir: Path) -> None:
    broken = tmp_path / "nano"
    broken.mkdir()
    for path in nano_dir.iterdir():
        (broken / path.name).write_bytes(path.read_bytes())
    (broken / "action_expert.onnx").write_bytes((broken / "action_expert.onnx").read_bytes()[:-1] + b"\x55")
    done = run(*Robot(tmp_path, 1, broken).arguments())
    assert done.returncode == 3
    assert len(done.stderr.splitlines()) == 1
    assert "action_expert.onnx" in done.stderr
