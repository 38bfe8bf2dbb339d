"""A ROS 2 base between the real `edge-hil` and the real `edge-bridge`: whatever dies, the base stops.

Times are edge-hil's own stamps of what came over the wire and of the base's motion.
"""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest

from firmware_bridge.core.config import DdsConfig
from firmware_bridge.dds.bus import Bus
from firmware_bridge.operate import operate
from firmware_bridge.ros2.messages.common import Twist_, Vector3_
from sim_hil.protocols.fault_socket import FaultClient
from sim_hil.protocols.ros2.front_end import BASE_TIMEOUT_S
from tests.support.processes import GO2_SIM, HostStall, Running, check_stop_latency, read_trace, running, wait_for

pytestmark = pytest.mark.process

CARTER = GO2_SIM.with_name("carter_ros2_sim.toml")
BOUND_NS = 300_000_000
ZERO = (0.0, 0.0, 0.0)
Velocity = tuple[float, float, float]


class Base:
    """A running edge-hil with the base's own record of its commands and motion."""

    def __init__(self, folder: Path) -> None:
        self.trace, self.faults, self.folder = folder / "t.jsonl", folder / "faults", folder

    def twists(self) -> list[tuple[int, Velocity]]:
        """Every command received: (ns, velocity)."""
        found = []
        for line in read_trace(self.trace):
            if line["kind"] == "wire" and line["name"] == "Twist":
                velocity = json.loads(line["parameter"])
                found.append((line["t_ns"], (velocity["x"], velocity["y"], velocity["z"])))
        return found

    def poses(self) -> list[tuple[int, float]]:
        """Every pose of the trace: (ns, speed in m/s)."""
        poses = [line for line in read_trace(self.trace) if line["kind"] == "pose"]
        return [(line["t_ns"], (line["vx"] ** 2 + line["vy"] ** 2) ** 0.5) for line in poses]

    def is_driving(self) -> bool:
        twists = self.twists()
        return bool(twists) and any(twists[-1][1]) and self.poses()[-1][1] > 0.3

    def is_stopped(self) -> bool:
        return self.twists()[-1][1] == ZERO and self.poses()[-1][1] < 0.05

    def first_lasting_zero_ns(self) -> int:
        """When the base received the zero after which it received nothing else."""
        twists = self.twists()
        last_moving = max(i for i, (_, velocity) in enumerate(twists) if velocity != ZERO)
        assert last_moving + 1 < len(twists), "no zero velocity was ever received"
        return twists[last_moving + 1][0]


@pytest.fixture(scope="module")
def base(dds_domain: int, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Base]:
    """In a corridor of 24 m, with a second of driving a test: no test reaches its end."""
    base = Base(tmp_path_factory.mktemp("ros2"))
    options = ("--robot", "carter", "--scene", "corridor", "--protocol", "ros2", "--camera", "none", "--pose-hz", 100)
    files = ("--trace", base.trace, "--faults", base.faults, "--domain", dds_domain)
    with running("sim_hil.hil.command", *options, *files, folder=base.folder):
        yield base


@pytest.fixture
def bridge(base: Base, dds_domain: int, tmp_path: Path) -> Iterator[Running]:
    arguments = ("--robot", CARTER, "--domain", dds_domain, "--socket", tmp_path / "b.sock")
    with running("firmware_bridge.bridge", *arguments, folder=tmp_path) as started:
        yield started


Drive = Callable[[], AbstractContextManager[Running]]


@pytest.fixture
def drive(base: Base, bridge: Running, tmp_path: Path) -> Drive:
    """Start a runner and enter the block once the base drives."""

    @contextmanager
    def start() -> Iterator[Running]:
        with running("tests.support.robot.bridge_driver", tmp_path / "b.sock", 0.5, folder=tmp_path) as runner:
            wait_for(base.is_driving, 20, f"the base drives; the bridge: {bridge.stderr()}")
            yield runner

    return start


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_dead_or_frozen_runner_leaves_zero_at_the_base_within_300_ms(
    base: Base, drive: Drive, number: signal.Signals
) -> None:
    with HostStall() as host, drive() as runner:
        since_ns = time.monotonic_ns()
        os.kill(runner.pid, number)
        wait_for(base.is_stopped, 10, "the base to stand")
        check_stop_latency(base.first_lasting_zero_ns() - since_ns, BOUND_NS, since_ns, host)
        runner.process.kill()


def test_a_dead_bridge_leaves_the_base_to_its_own_timeout(base: Base, bridge: Running, drive: Drive) -> None:
    with HostStall() as host, drive():
        wait_for(lambda: base.poses()[-1][1] > 0.47, 5, "full speed")
        since_ns = time.monotonic_ns()
        bridge.process.kill()
        wait_for(lambda: base.poses()[-1][1] < 0.05, 10, "the base to stand")
        last_ns, last = base.twists()[-1]
        assert last != ZERO, "the killed bridge has sent zero"
        braking_ns = next(t_ns for t_ns, speed in base.poses() if t_ns > last_ns and speed < 0.45)
        timeout_ns = round(BASE_TIMEOUT_S * 1e9)
        assert braking_ns - last_ns > 0.9 * timeout_ns
        # 0.5 m/s is gone after 25 ms of braking at 2 m/s², and a pose is written every 10 ms.
        check_stop_latency(braking_ns - last_ns, timeout_ns + 100_000_000, since_ns, host)


def test_a_second_commander_gets_the_base_zeroed_and_the_bridge_stopped(
    base: Base, bridge: Running, drive: Drive, dds_domain: int
) -> None:
    rogue = Bus(DdsConfig(dds_domain, "lo", ("127.0.0.1",)))
    try:
        with HostStall() as host, drive():
            since_ns = time.monotonic_ns()
            writer = rogue.writer("rt/cmd_vel", Twist_)
            writer.write(Twist_(Vector3_(0.2, 0.0, 0.0), Vector3_(0.0, 0.0, 0.0)))
            wait_for(base.is_stopped, 10, "the base to stand")
            check_stop_latency(base.first_lasting_zero_ns() - since_ns, 500_000_000, since_ns, host)
    finally:
        rogue.close()
    assert "another client commands the robot (" in bridge.stderr()


def test_silent_odometry_stops_the_base(base: Base, bridge: Running, drive: Drive, tmp_path: Path) -> None:
    with FaultClient(base.faults, tmp_path / "asker") as faults:
        try:
            with HostStall() as host, drive():
                since_ns = faults.inject("odometry_off")
                wait_for(base.is_stopped, 10, "the base to stand")
                # After a deadman time without a report the bridge sends zero; it stops for good after 1 s.
                check_stop_latency(base.first_lasting_zero_ns() - since_ns, BOUND_NS, since_ns, host)
                wait_for(lambda: "no state from the robot any more" in bridge.stderr(), 5, "the reason")
        finally:
            faults.inject("clear")


def test_an_operators_stop_latches(base: Base, bridge: Running, drive: Drive, tmp_path: Path) -> None:
    with drive():
        code, status = operate("stop", tmp_path / "b.sock")
        assert (code, status["state"], status["cause"]) == (0, "stopped", "estop")
        wait_for(base.is_stopped, 10, "the base to stand")
