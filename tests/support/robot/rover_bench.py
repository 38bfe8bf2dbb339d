"""The bridge's rules, its MAVLink session and the simulated rover, joined by packets, on one clock of the test.

`to_rover` and `to_bridge` change the packets of a direction: each takes a packet and returns those that arrive.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

from pymavlink.dialects.v20 import common

from edge.core.geometry import SE2
from firmware_bridge.core.config import MavlinkConfig, RobotConfig, load_robot_config
from firmware_bridge.core.link import Arm, BridgeStatus, Velocity
from firmware_bridge.core.rules import BridgeCore
from firmware_bridge.core.step_types import Inputs, Report
from firmware_bridge.mavlink.session import Session
from firmware_bridge.mavlink.signing import Signatures
from firmware_bridge.mavlink.table import robot_table
from sim_hil.protocols.mavlink.autopilots import BY_NAME
from sim_hil.protocols.mavlink.node import MavlinkNode
from sim_hil.protocols.mavlink.parameters import Parameters
from sim_hil.protocols.mavlink.vehicle import Mode, Station
from sim_hil.protocols.mavlink.wire import Message, Reader, Verifier, Writer
from sim_hil.robots.carter.sensors import Sensors
from tests.support.processes import REPOSITORY
from tests.support.robot.fake_base import FakeBase

ROBOTS = REPOSITORY / "firmware_bridge" / "robots"
CARTER = ROBOTS / "carter_mavlink_sim.toml"
MS = 1_000_000
STEP_NS = 20 * MS
BRIDGE, GROUND = Station(1, ("127.0.0.1", 1)), Station(255, ("127.0.0.1", 2))
TICKS = 10**12  # of signatures, at the start
Packets = Callable[[bytes], Iterable[bytes]]


def whole(packet: bytes) -> Iterable[bytes]:
    return (packet,)


def lost(packet: bytes) -> Iterable[bytes]:
    return ()


def robot_file(path: Path = CARTER, **changes: object) -> RobotConfig:
    """A robot file with other values in [mavlink]; its runner arms by itself."""
    config = load_robot_config(path)
    assert config.mavlink is not None
    safety = replace(config.safety, operator_arm=False)
    return replace(config, mavlink=replace(config.mavlink, **changes), safety=safety)


class RoverBench:
    """One rover, one bridge, and a runner that sends `speed` (m/s, rad/s) while it is not None."""

    def __init__(
        self, config: RobotConfig | None = None, *, key: bytes | None = None, rover_key: bytes | None = None
    ) -> None:
        self.config = config or robot_file()
        mavlink: MavlinkConfig = self.config.mavlink
        self.now_ns = 5_000_000_000
        self.lines: list[str] = []
        signatures = None if key is None else Signatures(key, TICKS, self.now_ns)
        rover_key = rover_key or key
        self.session = Session(mavlink, self.lines.append, signatures)
        self.core = BridgeCore(
            self.config.bridge, self.config.limits, self.config.safety, robot_table(self.config), self.now_ns
        )
        self.base = FakeBase()
        self.pose, self.charge, self.tilt_rad = SE2(0.0, 0.0, 0.0), 80.0, 0.0
        self.reader = Reader(None if rover_key is None else Verifier(rover_key, TICKS))
        autopilot = BY_NAME[mavlink.autopilot]
        given = {"SYSID_MYGCS": mavlink.station} if autopilot.name == "ardupilot" else {}
        self.node = MavlinkNode(
            self.base, self._sensors, self.reader.counts, Parameters(autopilot.name, **given), autopilot
        )
        self._writer = Writer(mavlink.system, 1, rover_key, TICKS)
        self._ground = Writer(255, 190, rover_key, TICKS)
        self.to_rover: Packets = whole
        self.to_bridge: Packets = whole
        self.sent: list[tuple[int, Message]] = []  # what the bridge has sent
        self._sniffer = Reader()
        self.reports: list[tuple[int, Report]] = []
        self.status: BridgeStatus | None = None
        self.speed: tuple[float, float] | None = None
        self.asking = self.client = True
        self.estop = False  # the local input
        self.operator: list[object] = []  # messages of the next step
        self._seq = 0

    @property
    def now_s(self) -> float:
        return self.now_ns / 1e9 - 4.0  # the rover was switched on 1 s ago

    def _sensors(self) -> Sensors:
        v_mps, _, w_radps = self.base.velocity
        gravity = 9.81
        accel = (0.0, gravity * math.sin(self.tilt_rad), gravity * math.cos(self.tilt_rad))
        return Sensors(
            T_odom_base=self.pose, v_mps=v_mps, w_radps=w_radps, wheel_radps=(0.0, 0.0), wheel_nm=(0.0, 0.0),
            wheel_counts=(0, 0), gyro_radps=(0.0, 0.0, w_radps), accel_mps2=accel, charge_percent=self.charge,
            voltage_v=40.0, current_a=2.0, bumpers=(False, False, False, False), overload=False,
        )  # fmt: skip

    def arrive(self, packet: bytes) -> None:
        """Deliver a packet of any sender to the bridge."""
        self.session.take(packet, self.now_ns)

    def pack(self, message: Message, system: int = 1, component: int = 1) -> bytes:
        """A packet of any sender, with that sender's next number if it is the rover."""
        if (system, component) == (1, 1):
            return self._writer.pack(message)
        return Writer(system, component).pack(message)

    def ground(self, *messages: Message) -> None:
        """A ground station sends messages to the rover."""
        for message in messages:
            for received in self.reader.read(self._ground.pack(message)):
                self.node.receive(received, GROUND, self.now_s)

    def step(self) -> BridgeStatus:
        """20 ms: the rover moves and reports, then the bridge steps once."""
        for _ in range(2):
            self.now_ns += STEP_NS // 2
            v_mps, _, w_radps = self.base.velocity
            self.pose = self.pose @ SE2(v_mps * 0.01, 0.0, w_radps * 0.01)
            self.node.step(self.now_s)
            for message in self.node.due(self.now_s):
                self._deliver(message)
        report = self.session.report(self.now_ns)
        self.reports.append((self.now_ns, report))
        messages: list[object] = []
        if self.asking and self.client and self.now_ns % 1_000_000_000 < STEP_NS:
            messages.append(Arm())
        if self.speed is not None and self.client:
            self._seq += 1
            armed = self.status is not None and self.status.state == "armed"
            messages.append(Velocity(self._seq, self.now_ns, self.speed[0] * armed, 0.0, self.speed[1] * armed))
        operator, self.operator = self.operator, []
        outputs = self.core.step(Inputs(messages, self.client, report, operator, self.estop), self.now_ns)
        for request in outputs.requests:
            self.session.write(request, self.now_ns)
        self.flush()
        self.status = outputs.status
        return outputs.status

    def flush(self) -> None:
        """The bridge's packets reach the rover, and its answers the bridge."""
        for packet in self.session.outgoing():
            self.sent += [(self.now_ns, message) for message in self._sniffer.read(packet)]
            for arrived in self.to_rover(packet):
                for message in self.reader.read(arrived):
                    self.node.receive(message, BRIDGE, self.now_s)
        for message in self.node.answers():
            self._deliver(message)

    def _deliver(self, message: Message) -> None:
        for arrived in self.to_bridge(self._writer.pack(message)):
            self.session.take(arrived, self.now_ns)

    def run(self, seconds: float) -> BridgeStatus:
        """Let time pass."""
        status = self.step()
        for _ in range(round(seconds * 1e9 / STEP_NS) - 1):
            status = self.step()
        return status

    def until(self, condition: Callable[[], bool], timeout_s: float, what: str) -> float:
        """Step until `condition()`; return the seconds it took."""
        start_ns = self.now_ns
        while not condition():
            assert self.now_ns - start_ns < timeout_s * 1e9, f"timed out: {what}; {self.status}; {self.lines}"
            self.step()
        return (self.now_ns - start_ns) / 1e9

    def drive(self, vx_mps: float = 0.5, timeout_s: float = 15.0) -> None:
        """Arm, and drive until the rover moves; afterwards the runner asks no more."""
        self.speed = (vx_mps, 0.0)
        self.until(lambda: self.base.velocity[0] == vx_mps, timeout_s, "a rover that drives")
        self.asking = False

    def commands(self, number: int, since_ns: int = 0) -> list[Message]:
        """Commands with this number that the bridge has sent."""
        return [
            message
            for at_ns, message in self.sent
            if at_ns >= since_ns and message.get_type() == "COMMAND_LONG" and message.command == number
        ]

    @property
    def mode(self) -> Mode:
        return self.node.vehicle.mode


def command(number: int, *params: float) -> Message:
    """A COMMAND_LONG to the rover."""
    return common.MAVLink_command_long_message(1, 1, number, 0, *params, *[0.0] * (7 - len(params)))
