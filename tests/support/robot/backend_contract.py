"""Contract of every backend of the bridge, as one test class; a protocol's own test derives from it.

The robot is a fake at the wire; the bridge's rules are the real ones.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import ClassVar, Protocol

import pytest

from firmware_bridge.backends import robot_table
from firmware_bridge.core.config import RobotConfig
from firmware_bridge.core.link import Arm, BridgeStatus, Velocity
from firmware_bridge.core.rules import BridgeCore
from firmware_bridge.core.step_types import Backend, Identify, Inputs, Move, Report, Stand, StopMotion
from tests.support.processes import REPOSITORY

MS = 1_000_000
_LIBRARIES = {
    "unitree": {"cyclonedds"},
    "ros2": {"cyclonedds"},
    "can": {"can", "cantools"},
    "mavlink": {"pymavlink"},
}
_LOAD = """
import sys
from firmware_bridge.backends import backend_opener, missing_link, robot_table
from firmware_bridge.core.config import load_robot_config
config = load_robot_config(sys.argv[1])
robot_table(config), missing_link(config), backend_opener(config)
print(*sorted(sys.modules))
"""


class Rig(Protocol):
    """A backend and its fake robot.

    `commands`: forward speed and yaw rate of every velocity command that has reached the robot. `requests`: number of
    its other commands. `reporting`: whether the robot sends anything.
    """

    config: RobotConfig
    link: Backend
    reporting: bool

    @property
    def commands(self) -> list[tuple[float, float]]: ...

    @property
    def requests(self) -> int: ...

    def now_ns(self) -> int: ...

    def spin(self) -> None:
        """Let 20 ms pass, in which the robot receives and reports."""

    def send_garbage(self) -> None:
        """Send input that this protocol must count as malformed."""

    def refuse(self) -> None:
        """Let the network refuse everything that is written from now on."""

    def close(self) -> None: ...


class BridgeBench:
    """The bridge's rules in front of a rig, with a runner that asks to arm and sends `speed` while it is not None."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        config = rig.config
        self.core = BridgeCore(config.bridge, config.limits, config.safety, robot_table(config), rig.now_ns())
        self.speed: tuple[float, float] | None = (0.0, 0.0)
        self.asking = True
        self.reports: list[Report] = []
        self._seq = 0
        self._asked_ns = 0

    def step(self) -> BridgeStatus:
        """20 ms of the robot, then one step of the bridge."""
        self.rig.spin()
        now_ns = self.rig.now_ns()
        messages: list[object] = []
        if self.asking and now_ns - self._asked_ns > 1_000 * MS:
            self._asked_ns = now_ns
            messages.append(Arm())
        if self.speed is not None:
            self._seq += 1
            messages.append(Velocity(self._seq, now_ns, self.speed[0], 0.0, self.speed[1]))
        report = self.rig.link.read(now_ns)
        self.reports.append(report)
        outputs = self.core.step(Inputs(messages, True, report), now_ns)
        for request in outputs.requests:
            self.rig.link.write(request)
        return outputs.status

    def until(self, done: Callable[[BridgeStatus], bool], seconds: float, what: str) -> BridgeStatus:
        """Step until `done(status)`."""
        end_ns = self.rig.now_ns() + int(seconds * 1e9)
        status = self.step()
        while not done(status):
            assert self.rig.now_ns() < end_ns, f"timed out: {what}; {status}"
            status = self.step()
        return status

    def run(self, seconds: float) -> BridgeStatus:
        """Step for that time."""
        end_ns = self.rig.now_ns() + int(seconds * 1e9)
        status = self.step()
        while self.rig.now_ns() < end_ns:
            status = self.step()
        return status

    def drive(self, vx_mps: float = 0.3, wz_radps: float = 0.0) -> BridgeStatus:
        """Arm, and drive until the robot has received this velocity."""
        self.until(lambda status: status.state == "armed", 20.0, "armed")
        self.asking, self.speed = False, (vx_mps, wz_radps)
        wanted = pytest.approx((vx_mps, wz_radps), abs=0.01)
        return self.until(lambda _: self.rig.commands[-1:] == [wanted], 3.0, "the velocity at the robot")


def report_of(rig: Rig, done: Callable[[Report], object], seconds: float = 10.0) -> Report:
    """Let the robot report until `done(report)`."""
    end_ns = rig.now_ns() + int(seconds * 1e9)
    while True:
        rig.spin()
        report = rig.link.read(rig.now_ns())
        if done(report):
            return report
        assert rig.now_ns() < end_ns, report


def wait_until(rig: Rig, done: Callable[[], object]) -> None:
    """Let time pass until `done()`."""
    report_of(rig, lambda _: done())


class BackendContract:
    """Derive from it, name the robot file and define `rig`: an open link and a robot that it can hear."""

    FILE: ClassVar[Path]
    STANDS: ClassVar[bool] = True
    """Whether the robot has modes that the bridge must change before it drives."""

    @pytest.fixture
    def rig(self) -> Iterator[Rig]:
        raise NotImplementedError

    def test_the_robots_messages_become_reports_of_state_and_battery(self, rig: Rig) -> None:
        seen: list[Report] = []

        def complete(report: Report) -> bool:
            seen.append(report)
            return any(each.state for each in seen) and any(each.battery for each in seen)

        report_of(rig, complete)
        state = next(each.state for each in reversed(seen) if each.state)
        battery = next(each.battery for each in seen if each.battery)
        assert state.error_code == 0 and abs(state.vx_mps) < 0.01 and abs(state.roll_rad) < 0.1
        assert 0 < battery.soc_percent <= 100
        assert not any(each.foreign or each.publishers or each.remote_estop or each.writes_fail for each in seen)

    def test_a_move_reaches_the_robot_with_its_sign_and_size(self, rig: Rig) -> None:
        report_of(rig, lambda report: report.state)
        for velocity in ((0.4, 0.5), (-0.2, -0.3)):
            rig.link.write(Move(velocity[0], 0.0, velocity[1]))
            wanted = pytest.approx(velocity, abs=0.01)
            wait_until(rig, lambda wanted=wanted: rig.commands[-1:] == [wanted])

    def test_a_stop_reaches_the_robot(self, rig: Rig) -> None:
        BridgeBench(rig).drive()
        before = rig.requests
        rig.link.write(StopMotion())
        wait_until(rig, lambda: rig.requests > before or rig.commands[-1] == (0.0, 0.0))

    def test_every_step_of_the_table_is_a_request_that_the_robot_receives(self, rig: Rig) -> None:
        table = robot_table(rig.config)
        assert not set(table.next_step) & table.ready_modes
        report_of(rig, lambda report: report.state)
        for step in sorted({*table.next_step.values(), table.recovery_step}) if self.STANDS else ():
            before = rig.requests
            rig.link.write(Stand(step))
            wait_until(rig, lambda before=before: rig.requests > before)

    def test_it_arms_drives_and_reports_ready_modes(self, rig: Rig) -> None:
        bench = BridgeBench(rig)
        bench.drive()
        states = [report.state for report in bench.reports if report.state is not None]
        assert states[-1].mode in robot_table(rig.config).armed_modes
        assert bench.core.status(rig.now_ns()).cause == "none"

    def test_a_robot_that_falls_silent_is_stopped_in_time(self, rig: Rig) -> None:
        bench = BridgeBench(rig)
        bench.drive()
        rig.reporting = False
        silent_ns = rig.now_ns()
        bench.until(lambda status: status.state == "stopped", 5.0, "a stop")
        late_ms = (rig.now_ns() - silent_ns) / MS - rig.config.bridge.state_timeout_ms
        assert late_ms < 300
        wait_until(rig, lambda: rig.commands[-1] == (0.0, 0.0))

    def test_malformed_input_is_counted_and_moves_nothing(self, rig: Rig) -> None:
        report_of(rig, lambda report: report.state)
        bench = BridgeBench(rig)
        bench.asking, rig.reporting = False, False
        moves, requests, counted = len(rig.commands), rig.requests, rig.link.dropped()[0]
        for _ in range(20):
            rig.send_garbage()
            assert bench.step().state == "disarmed"
        wait_until(rig, lambda: rig.link.dropped()[0] > counted)
        assert len(rig.commands) == moves and rig.requests == requests

    def test_malformed_input_while_driving_never_changes_the_velocity(self, rig: Rig) -> None:
        bench = BridgeBench(rig)
        bench.drive()
        first = len(rig.commands)
        for _ in range(10):
            rig.send_garbage()
            bench.step()
        assert set(rig.commands[first:]) <= {(0.0, 0.0), *rig.commands[first - 1 : first]}

    def test_requests_that_the_network_refuses_are_counted_and_reported(self, rig: Rig) -> None:
        report_of(rig, lambda report: report.state)
        before = rig.link.dropped()[2]
        rig.refuse()
        for _ in range(4):
            rig.link.write(Move(0.1, 0.0, 0.0))
        assert rig.link.dropped()[2] >= before + 4
        assert rig.link.read(rig.now_ns()).writes_fail

    def test_no_call_waits_for_a_silent_robot_or_a_network_that_refuses(self, rig: Rig) -> None:
        report_of(rig, lambda report: report.state)
        rig.reporting = False
        rig.refuse()
        durations_s = []
        for request in [Move(0.1, 0.0, 0.0), StopMotion(), Identify()] * 50:
            begin_s = time.perf_counter()
            rig.link.write(request)
            rig.link.read(rig.now_ns())
            durations_s.append(time.perf_counter() - begin_s)
        assert sorted(durations_s)[len(durations_s) // 2] < 0.005  # the median: a busy machine delays a few
        assert sum(durations_s) < 5.0

    def test_it_loads_only_its_own_packages(self, rig: Rig) -> None:
        done = subprocess.run(
            [sys.executable, "-c", _LOAD, str(self.FILE)], cwd=REPOSITORY, capture_output=True, text=True, check=True
        )
        loaded, own = set(done.stdout.split()), rig.config.protocol
        others = set().union(*_LIBRARIES.values()) - _LIBRARIES[own]
        assert _LIBRARIES[own] <= loaded
        assert not loaded & (others | {"numpy", "onnxruntime", "edge"})
        assert not {name for other in set(_LIBRARIES) - {own} for name in loaded if f"firmware_bridge.{other}" in name}
