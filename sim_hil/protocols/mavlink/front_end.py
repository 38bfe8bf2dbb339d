"""MAVLink front end of `edge-hil`: the Carter as a rover on UDP, with its camera over HTTP.

--link udp:HOST:PORT[,to=HOST:PORT...][,camera=PORT][,system=NUMBER][,key=FILE][,autopilot=NAME][,IMPAIRMENT=NUMBER...]
  udp:127.0.0.1:14580,to=127.0.0.1:14540,to=127.0.0.1:14550    the default: heartbeats to the ports of MAVSDK and of
                                                                ground stations; a station that answers gets all reports
  udp:127.0.0.1:14580,autopilot=ardupilot    announces ArduPilot Rover instead of PX4: GUIDED and HOLD, its parameters
  udp:127.0.0.1:14580,key=signing.hex    unsigned packets are ignored, all sent packets are signed
  udp:127.0.0.1:14580,loss_percent=30,jitter_ms=200    a radio that loses and delays packets (`Impairment`)

`--faults PATH` accepts the impairment's fields, "button" (emergency stop button pressed), "pilot" (a person switches
the remote to MANUAL), "deaf" (nothing is received), "silent" (nothing is sent), "mute" (both), "battery_empty", and the
attacks of `forger.py`.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from pymavlink.dialects.v20 import common

from sim_hil.protocols.base import CameraFrontEnd, CommandLog
from sim_hil.protocols.camera_stream import CameraStream
from sim_hil.protocols.fault_socket import PlanFaults, parse_plan, plan_fields
from sim_hil.protocols.front_end import FrontEndError, FrontEndOptions, ReceivedCommand
from sim_hil.protocols.impairment import PERFECT, Impairment
from sim_hil.protocols.mavlink import forger
from sim_hil.protocols.mavlink.autopilots import BY_NAME
from sim_hil.protocols.mavlink.node import COMPONENT, Command, MavlinkNode
from sim_hil.protocols.mavlink.parameters import Parameters
from sim_hil.protocols.mavlink.setpoints import SetpointError, read_setpoint
from sim_hil.protocols.mavlink.udp import Address, UdpLink, parse_address
from sim_hil.protocols.mavlink.vehicle import Station
from sim_hil.protocols.mavlink.wire import TICKS_PER_S, Message, Reader, Verifier, Writer, now_ticks, read_key
from sim_hil.robots.carter.body import Carter
from sim_hil.robots.carter.sensors import CarterSensors, Sensors
from sim_hil.simulation.physics import Simulation

CAMERA_PORT: Final = 8090
SWITCHES: Final = ("button", "deaf", "silent", "mute", "pilot", "battery_empty", *forger.KINDS)
DEFAULT_LINK: Final = "udp:127.0.0.1:14580,to=127.0.0.1:14540,to=127.0.0.1:14550"

_NOT_TRACED: Final = ("mavpackettype", "target_system", "target_component", "time_boot_ms", "command", "confirmation")


@dataclass(frozen=True)
class LinkOptions:
    """Parsed value of `--link`."""

    bind: Address
    to: tuple[Address, ...] = ()
    camera_port: int = CAMERA_PORT
    system: int = 1
    key: bytes | None = None
    autopilot: str = "px4"
    impairment: Impairment = PERFECT

    def __post_init__(self) -> None:
        if not 0 <= self.camera_port <= 65535:
            raise ValueError(f"camera: expected a port of 0..65535, found {self.camera_port}")
        if not 1 <= self.system <= 254:
            raise ValueError(f"system: expected a number of 1..254, found {self.system}")
        if self.autopilot not in BY_NAME:
            raise ValueError(f"autopilot: expected {' or '.join(BY_NAME)}, found {self.autopilot!r}")

    @staticmethod
    def parse(text: str | None) -> LinkOptions:
        """Parse `--link`; None: DEFAULT_LINK. Raises FrontEndError."""
        text = DEFAULT_LINK if text is None else text
        where, *settings = text.split(",")
        given: dict[str, Any] = {}
        to: list[Address] = []
        faults: list[str] = []
        try:
            if not where.startswith("udp:"):
                raise ValueError(f"expected udp:HOST:PORT, found {where!r}")
            for setting in settings:
                name, _, value = setting.partition("=")
                if name == "to":
                    to.append(parse_address(value))
                elif name == "camera":
                    given["camera_port"] = _number(name, value)
                elif name == "system":
                    given["system"] = _number(name, value)
                elif name == "key":
                    given["key"] = read_key(Path(value))
                elif name == "autopilot":
                    given["autopilot"] = value
                elif name in plan_fields(Impairment):
                    faults.append(setting)
                else:
                    raise ValueError(
                        f"expected to=, camera=, system=, key=, autopilot= or an impairment, found {setting!r}"
                    )
            given["impairment"] = parse_plan(Impairment, faults)
            return LinkOptions(parse_address(where.removeprefix("udp:")), tuple(to), **given)
        except (ValueError, OSError) as error:
            raise FrontEndError(f"--link {text}: {error}") from error


def _number(name: str, text: str) -> int:
    if not (text.isascii() and text.isdecimal()):
        raise ValueError(f"{name}: expected a number, found {text!r}")
    return int(text)


class MavlinkFrontEnd(CameraFrontEnd):
    """MAVLink front end of a simulated Carter."""

    def __init__(self, robot: Carter, options: FrontEndOptions, link: LinkOptions, state_length: int) -> None:
        """Open port and camera. Raises FrontEndError or OSError."""
        self._ticks = ticks = 0 if link.key is None else now_ticks()
        self._reader = Reader(None if link.key is None else Verifier(link.key, ticks))
        self._writer = Writer(link.system, COMPONENT, link.key, ticks)
        self._forger = forger.Forger(link.system, link.key, ticks)
        self._sensors = CarterSensors(robot, odometry_noise=options.odometry_noise, seed=options.seed)
        parameters = Parameters(link.autopilot, MAV_SYS_ID=link.system)
        autopilot = BY_NAME[link.autopilot]
        self._node = MavlinkNode(robot, self._read, self._reader.counts, parameters, autopilot)
        self._log = CommandLog()
        self._now_s = 0.0
        self._states = 0
        self._camera: CameraStream | None = None
        self._faults: PlanFaults[Impairment] | None = None
        self._link = UdpLink(link.bind, link.to, link.impairment, options.seed)
        self._host = link.bind[0]
        try:
            if options.faults is not None:
                self._faults = PlanFaults(options.faults, link.impairment, SWITCHES)
            if options.camera_size is not None:
                self._camera = CameraStream(options, link.camera_port, state_length)
        except BaseException:
            self.close()
            raise

    @property
    def port(self) -> int:
        """UDP port of the front end."""
        return self._link.port

    def where(self) -> str:
        """Return the addresses of rover and camera."""
        camera = "no camera" if self._camera is None else f"camera {self._camera.url}"
        return f"MAVLink udp:{self._host}:{self._link.port}, system {self._node.system}, {camera}"

    def wait(self, left_ns: int) -> None:
        """Wait until a datagram arrives, at most `left_ns`."""
        self._link.wait(left_ns)

    def serve(self) -> list[ReceivedCommand]:
        """Execute and answer the received commands and return them."""
        commands: list[ReceivedCommand] = []
        for data, address in self._link.receive(self._now_s):
            if self._is_on("deaf", "mute"):
                continue
            received_ns = time.monotonic_ns()
            messages = self._reader.read(data)
            if messages and self._link.accept(address, self._now_s):
                for message in messages:
                    commands += self._handle(message, address, received_ns)
        self._flush(self._node.answers())
        if self._camera is not None:
            self._camera.events()
        return commands

    def _handle(self, message: Message, address: Address, received_ns: int) -> list[ReceivedCommand]:
        station = Station(message.get_srcSystem(), address)
        number, name = message.get_msgId(), message.get_type()
        requested = self._requested(message)
        obeyed = self._node.receive(message, station, self._now_s)
        if not obeyed and requested is None:
            return []
        moves = not name.startswith("COMMAND") and name != "SET_MODE"
        if name.startswith("COMMAND"):
            command = Command.of(message)
            number, name = command.number, common.enums["MAV_CMD"][command.number].name
        wanted = self._node.vehicle.wanted() if self._node.vehicle.armed else None
        if obeyed:
            self._log.last_command = name
            if moves and wanted is not None:
                self._log.move(name, (wanted[0], 0.0, wanted[1]))
            self._log.at_zero = wanted is None or not any(wanted)
        content = " ".join(
            f"{key}={value}"
            for key, value in message.to_dict().items()
            if key not in _NOT_TRACED and value and value == value  # MAVSDK fills unused fields with NaN
        )
        velocity = (0.0, 0.0, 0.0) if wanted is None else (wanted[0], 0.0, wanted[1]) if moves else None
        velocity = velocity if requested is None else requested
        text = f"station={station.system} {content}"
        return [ReceivedCommand(received_ns, "mavlink", number, name, text, velocity=velocity, source=station.system)]

    def _requested(self, message: Message) -> tuple[float, float, float] | None:
        """Return the velocity that a setpoint requests, also one that the rover does not obey; None without one."""
        if message.get_msgId() != common.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED:
            return None
        try:
            speed, rate = read_setpoint(message).command(self._node.vehicle.health.yaw_rad)
        except SetpointError:
            return None
        return speed, 0.0, rate

    def publish(self, step: int, stamp_s: float) -> None:
        """Advance the rover's clock and send the messages that are due."""
        self._now_s = stamp_s
        for sender in (self._writer, self._forger):
            sender.advance(self._ticks + round(stamp_s * TICKS_PER_S))
        if self._faults is not None:
            self._faults.poll()
            self._node.vehicle.button = "button" in self._faults.active
            self._node.vehicle.pilot = "pilot" in self._faults.active
            self._sensors.is_empty = "battery_empty" in self._faults.active
            self._link.impairment = self._faults.plan
        self._node.step(stamp_s)
        self._flush(self._node.due(stamp_s))

    def _flush(self, messages: list[Message]) -> None:
        for message in messages:
            number = message.get_msgId()
            self._states += number == common.MAVLINK_MSG_ID_ODOMETRY
            if self._is_on("silent", "mute"):
                continue
            call = number == common.MAVLINK_MSG_ID_HEARTBEAT
            packet = self._writer.pack(message)
            self._link.send(packet, self._now_s, call=call)
            for forged in self._forger.packets(packet, () if self._faults is None else self._faults.active):
                self._link.send(forged, self._now_s)

    def _is_on(self, *switches: str) -> bool:
        return self._faults is not None and not self._faults.active.isdisjoint(switches)

    def _read(self) -> Sensors:
        return self._sensors.read(self._now_s)

    def close(self) -> None:
        """End the camera process and close the sockets."""
        if self._faults is not None:
            self._faults.close()
        if self._camera is not None:
            self._camera.close()
        self._link.close()

    def summary(self) -> dict[str, object]:
        """Return the counts of received and sent messages."""
        counts, link = self._reader.counts, self._link
        mavlink = {
            "broken": counts.broken,
            "unsigned": counts.unsigned,
            "unusable": counts.unusable,
            "unknown": counts.unknown,
            "not_for_us": counts.not_for_us,
            "not_in_control": self._node.vehicle.refused_setpoints,
            "turned_away": link.turned_away,
            "sent": link.sent,
            "unsent": link.unsent,
        }
        return {
            "wire": {**self._log.summary(), "malformed": counts.malformed, "mavlink": mavlink},
            "video_frames": 0 if self._camera is None else self._camera.pictures,
            "states": self._states,
        }


def open_front_end(simulation: Simulation, options: FrontEndOptions) -> MavlinkFrontEnd:
    """Open the front end of `--protocol mavlink`. Raises FrontEndError or OSError."""
    robot = simulation.robot
    if not isinstance(robot, Carter):
        raise FrontEndError(f"--protocol mavlink: expected the Carter, found a {type(robot).__name__}")
    return MavlinkFrontEnd(robot, options, LinkOptions.parse(options.link), len(simulation.render_state()))
