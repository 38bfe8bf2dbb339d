"""`edge-bridge` drives a robot that is the maker's own, unmodified Python SDK: RPC server, lease server, publishers.

It lives in an environment of its own, as test_interop_unitree_sdk.py says. Times are the robot's. The bridge runs on
this environment's Cyclone DDS, and on the SDK's 0.10.2, the version in the robot.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from firmware_bridge.unitree.messages import ids
from tests.support.processes import GO2_SIM, HostStall, Running, check_stop_latency, read_trace, running, wait_for

SDK_PYTHON = os.environ.get("TIC_VLA_SDK_PYTHON", "")
pytestmark = [
    pytest.mark.process,
    pytest.mark.slow,
    pytest.mark.skipif(
        not SDK_PYTHON,
        reason="TIC_VLA_SDK_PYTHON is not set: install the maker's SDK with tools/interop/install_unitree_sdk.sh",
    ),
]
RUNNER_BOUND_NS = 300_000_000
ROBOT_BOUND_NS = 1_100_000_000  # state_timeout_ms of the robot file, and two periods of the bridge
SPEED_MPS = 0.5


class SdkRobot:
    """A running robot and its trace of received requests."""

    def __init__(self, process: subprocess.Popen[str], trace: Path) -> None:
        self._process = process
        self._trace = trace

    def tell(self, command: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(f"{command}\n")
        self._process.stdin.flush()

    def requests(self) -> list[int]:
        return [line["api_id"] for line in read_trace(self._trace)]

    def moves(self) -> list[tuple[int, tuple[float, ...]]]:
        """Every Move received: (ns, velocity)."""
        found = [line for line in read_trace(self._trace) if line["api_id"] == ids.MOVE]
        return [(line["t_ns"], tuple(line["velocity"])) for line in found]

    def is_driven(self) -> bool:
        moves = self.moves()
        return bool(moves) and moves[-1][1][0] == pytest.approx(SPEED_MPS)

    def check_lasting_zero(self, since_ns: int, bound_ns: int, host: HostStall) -> None:
        """Check that zero came within the bound of `since_ns`, and nothing but zeros after it."""
        time.sleep(bound_ns / 1e9 + 0.6)
        moves = self.moves()
        last_moving = max(i for i, (_, velocity) in enumerate(moves) if any(velocity))
        assert last_moving + 1 < len(moves), "no zero velocity was ever received"
        latency_ns = moves[last_moving + 1][0] - since_ns
        sys.stdout.write(f"zero {latency_ns / 1e6:.1f} ms after it, {len(moves)} Moves received\n")  # for `pytest -s`
        check_stop_latency(latency_ns, bound_ns, since_ns, host)


@pytest.fixture
def robot(dds_domain: int, tmp_path: Path) -> Iterator[SdkRobot]:
    """A robot that lies down and has received nothing."""
    script, trace = Path(__file__).with_name("unitree_sdk_robot.py"), tmp_path / "robot.jsonl"
    command = [SDK_PYTHON, str(script), str(dds_domain), "lo", str(trace)]
    with (
        (tmp_path / "robot.stdout").open("w") as stdout,
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=stdout, stderr=stdout, text=True) as process,
    ):
        wait_for(lambda: "ready" in (tmp_path / "robot.stdout").read_text(), 30, "the robot")
        yield SdkRobot(process, trace)
        assert process.poll() is None, (tmp_path / "robot.stdout").read_text()
        process.stdin.close()  # type: ignore[union-attr]
        assert process.wait(20) == 0


@pytest.fixture(params=["this environment's DDS", "the maker's DDS 0.10.2"])
def bridge(
    request: pytest.FixtureRequest, robot: SdkRobot, dds_domain: int, tmp_path: Path
) -> Iterator[tuple[Running, Path]]:
    python = SDK_PYTHON if "maker" in request.param else sys.executable
    socket = tmp_path / "bridge.sock"
    arguments = ("--robot", GO2_SIM, "--domain", dds_domain, "--socket", socket)
    with running("firmware_bridge.bridge", *arguments, folder=tmp_path, python=python) as started:
        yield started, socket


@contextmanager
def driven(robot: SdkRobot, bridge: tuple[Running, Path], folder: Path) -> Iterator[Running]:
    """Start a runner at the bridge and enter the block once the robot is driven."""
    with running("tests.support.robot.bridge_driver", bridge[1], SPEED_MPS, folder=folder) as runner:
        wait_for(robot.is_driven, 30, f"the robot is driven; the bridge: {bridge[0].stderr()}")
        yield runner


def test_the_bridge_stands_it_up_and_drives_it_until_the_runner_freezes(
    robot: SdkRobot, bridge: tuple[Running, Path], tmp_path: Path
) -> None:
    with HostStall() as host, driven(robot, bridge, tmp_path) as runner:
        time.sleep(1.0)
        since_ns = time.monotonic_ns()
        os.kill(runner.pid, signal.SIGSTOP)
        robot.check_lasting_zero(since_ns, RUNNER_BOUND_NS, host)
        runner.process.kill()
    assert list(dict.fromkeys(robot.requests())) == [ids.STAND_UP, ids.BALANCE_STAND, ids.MOVE, ids.STOP_MOVE]


def test_a_robot_that_falls_silent_gets_zero(robot: SdkRobot, bridge: tuple[Running, Path], tmp_path: Path) -> None:
    with HostStall() as host, driven(robot, bridge, tmp_path):
        since_ns = time.monotonic_ns()
        robot.tell("silent")
        robot.check_lasting_zero(since_ns, ROBOT_BOUND_NS, host)
    assert "silent" in bridge[0].stderr()


def test_a_bridge_that_ends_leaves_zero(robot: SdkRobot, bridge: tuple[Running, Path], tmp_path: Path) -> None:
    with HostStall() as host, driven(robot, bridge, tmp_path):
        since_ns = time.monotonic_ns()
        assert bridge[0].end() == 0
        robot.check_lasting_zero(since_ns, RUNNER_BOUND_NS, host)
    assert robot.requests()[-1] in (ids.STOP_MOVE, ids.MOVE)
