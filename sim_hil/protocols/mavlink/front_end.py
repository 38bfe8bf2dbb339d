"""MAVLink front end of `edge-hil`: the Carter as a rover on UDP, with its camera over HTTP.

--link udp:HOST:PORT[,to=HOST:PORT...][,camera=PORT][,system=NUMBER][,key=FILE], for example
  udp:127.0.0.1:14580,to=127.0.0.1:14540,to=127.0.0.1:14550    the default: heartbeats to the ports of MAVSDK and of
                                                                ground stations; a station that answers gets all reports
  udp:127.0.0.1:14580,key=signing.hex    unsigned packets are ignored, all sent packets are signed
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import common

from sim_hil.protocols.camera_stream import CameraStream
from sim_hil.protocols.front_end import FrontEndError, FrontEndOptions, ReceivedCommand
from sim_hil.protocols.mavlink.commands import Command
from sim_hil.protocols.mavlink.faults import MavlinkFaults
from sim_hil.protocols.mavlink.node import COMPONENT, MavlinkNode
from sim_hil.protocols.mavlink.parameters import Parameters
from sim_hil.protocols.mavlink.signing import Verifier, read_key
from sim_hil.protocols.mavlink.udp import Address, UdpLink, parse_address
from sim_hil.protocols.mavlink.vehicle import Station
from sim_hil.protocols.mavlink.wire import Message, Reader, Writer, now_ticks
from sim_hil.robots.carter.body import Carter
from sim_hil.robots.carter.sensors import CarterSensors, Sensors
from sim_hil.simulation.physics import Simulation

CAMERA_PORT: Final = 8090
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

    def __post_init__(self) -> None:
        if not 0 <= self.camera_port <= 65535:
            raise ValueError(f"camera: expected a port of 0..65535, found {self.camera_port}")
        if not 1 <= self.system <= 254:
            raise ValueError(f"system: expected a number of 1..254, found {self.system}")

    @staticmethod
    def parse(text: str | None) -> LinkOptions:
        """Parse `--link`; None: DEFAULT_LINK. Raises FrontEndError."""
        text = DEFAULT_LINK if text is None else text
        where, *settings = text.split(",")
        given: dict[str, Any] = {}
        to: list[Address] = []
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
                else:
                    raise ValueError(f"expected to=, camera=, system= or key=, found {setting!r}")
            return LinkOptions(parse_address(where.removeprefix("udp:")), tuple(to), **given)
        except (ValueError, OSError) as error:
            raise FrontEndError(f"--link {text}: {error}") from error


def _number(name: str, text: str) -> int:
    if not (text.isascii() and text.isdecimal()):
        raise ValueError(f"{name}: expected a number, found {text!r}")
    return int(text)


class CommandLog:
    """Summary of the obeyed commands in the base's axes, for the result."""

    def __init__(self) -> None:
        self._commands = 0
        self._last_move: tuple[float, float, float] | None = None
        self._last_command: str | None = None
        self._at_zero = True

    def note(self, name: str, wanted: tuple[float, float] | None, *, moves: bool) -> None:
        """Count one message; `wanted`: resulting command (vx m/s, wz rad/s), None: no command."""
        self._last_command = name
        if moves and wanted is not None:
            self._commands += 1
            self._last_move = (wanted[0], 0.0, wanted[1])
        self._at_zero = wanted is None or not any(wanted)

    def summary(self) -> dict[str, object]:
        """Return the `wire` part of the result, without `malformed`."""
        return {
            "commands": self._commands,
            "last_move": None if self._last_move is None else list(self._last_move),
            "last_command": self._last_command,
            "last_command_zero": self._at_zero,
        }


class MavlinkFrontEnd:
    """MAVLink front end of a simulated Carter."""

    def __init__(self, robot: Carter, options: FrontEndOptions, link: LinkOptions, state_length: int) -> None:
        """Open port and camera. Raises FrontEndError or OSError."""
        ticks = 0 if link.key is None else now_ticks()
        self._reader = Reader(None if link.key is None else Verifier(link.key, ticks))
        self._writer = Writer(link.system, COMPONENT, link.key, ticks)
        self._sensors = CarterSensors(robot, odometry_noise=options.odometry_noise, seed=options.seed)
        parameters = Parameters(MAV_SYS_ID=link.system)
        self._node = MavlinkNode(robot, self._read, self._reader.counts, parameters)
        self._log = CommandLog()
        self._now_s = 0.0
        self._states = 0
        self._camera: CameraStream | None = None
        self._faults: MavlinkFaults | None = None
        self._link = UdpLink(link.bind, link.to)
        self._host = link.bind[0]
        try:
            if options.faults is not None:
                self._faults = MavlinkFaults(options.faults)
            if options.camera_size is not None:
                self._camera = CameraStream(
                    options.scene_source,
                    robot=options.robot,
                    people=options.people,
                    seed=options.seed,
                    size=options.camera_size,
                    port=link.camera_port,
                    state_length=state_length,
                )
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

    def start(self, render_state: NDArray[np.float64], stop: Sequence[int]) -> bool:
        """Wait for the camera. Raises CameraProcessError."""
        if self._camera is None:
            return True
        self._camera.show(render_state)
        return self._camera.wait_ready(stop)

    def wait(self, left_ns: int) -> None:
        """Wait until a datagram arrives, at most `left_ns`."""
        self._link.wait(left_ns)

    def serve(self) -> list[ReceivedCommand]:
        """Execute and answer the received commands and return them."""
        commands: list[ReceivedCommand] = []
        for data, address in self._link.receive():
            if self._muted:
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
        if not self._node.receive(message, station, self._now_s):
            return []
        number, name = message.get_msgId(), message.get_type()
        moves = not name.startswith("COMMAND") and name != "SET_MODE"
        if name.startswith("COMMAND"):
            command = Command.of(message)
            number, name = command.number, common.enums["MAV_CMD"][command.number].name
        self._log.note(name, self._node.vehicle.wanted() if self._node.vehicle.armed else None, moves=moves)
        content = " ".join(
            f"{key}={value}"
            for key, value in message.to_dict().items()
            if key not in _NOT_TRACED and value and value == value  # MAVSDK fills unused fields with NaN
        )
        return [ReceivedCommand(received_ns, "mavlink", number, name, f"station={station.system} {content}")]

    def publish(self, step: int, stamp_s: float) -> None:
        """Advance the rover's clock and send the messages that are due."""
        self._now_s = stamp_s
        if self._faults is not None:
            self._faults.poll()
            self._node.vehicle.button = self._faults.button
        self._node.step(stamp_s)
        self._flush(self._node.due(stamp_s))

    def _flush(self, messages: list[Message]) -> None:
        for message in messages:
            number = message.get_msgId()
            self._states += number == common.MAVLINK_MSG_ID_ODOMETRY
            if self._muted:
                continue
            call = number == common.MAVLINK_MSG_ID_HEARTBEAT
            self._link.send(self._writer.pack(message), self._now_s, call=call)

    @property
    def _muted(self) -> bool:
        return self._faults is not None and self._faults.mute

    def _read(self) -> Sensors:
        return self._sensors.read(self._now_s)

    def show(self, render_state: NDArray[np.float64]) -> None:
        """Pass the state to render to the camera process."""
        if self._camera is not None:
            self._camera.show(render_state)

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
