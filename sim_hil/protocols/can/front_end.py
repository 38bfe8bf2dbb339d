"""CAN front end of `edge-hil`: the Carter's node on a bus of python-can, with its camera over HTTP.

--link INTERFACE:CHANNEL[,camera=PORT][,FAULT=NUMBER...], for example
  serial:carter-can            a serial line; a path that does not exist becomes the client's end of a pty
  socketcan:can0,camera=8091   a real bus, the camera on another port
  serial:carter-can,drop=0.05,corrupt=0.01    a bus that loses and corrupts frames (sim_hil/protocols/can/shim.py)
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from firmware_bridge.can.buses import BusAddress, BusError, open_bus
from firmware_bridge.can.frame import Frame
from firmware_bridge.client_link import check_is_ours
from firmware_bridge.core.config import ConfigError, runtime_dir
from sim_hil.protocols.base import CameraFrontEnd, CommandLog, Vec3
from sim_hil.protocols.camera_stream import CameraStream
from sim_hil.protocols.can import frames
from sim_hil.protocols.can.buses import BusLink
from sim_hil.protocols.can.frames import Received
from sim_hil.protocols.can.node import CanNode
from sim_hil.protocols.can.pty_line import PtyLine
from sim_hil.protocols.can.shim import BABBLER_ID, FaultPlan, FaultShim
from sim_hil.protocols.fault_socket import PlanFaults, parse_plan
from sim_hil.protocols.front_end import FrontEndError, FrontEndOptions, ReceivedCommand
from sim_hil.robots.carter.body import Carter
from sim_hil.robots.carter.sensors import CarterSensors, Sensors
from sim_hil.simulation.physics import Simulation

CAMERA_PORT: Final = 8090
SWITCHES: Final = ("button", "bus_off", "deaf", "silent", "mute", "battery_empty")
_EVENT_S: Final = 0.1
_TRACED: Final = {"VelocityCommand": ("Vx", "Wz"), "ModeCommand": ("Request",), "EstopControl": ("Request",)}
_STOPS: Final = (("EstopControl", frames.ESTOP_STOP), ("ModeCommand", frames.MODE_DISARM))


@dataclass(frozen=True)
class LinkOptions:
    """Parsed value of `--link`."""

    address: BusAddress
    camera_port: int = CAMERA_PORT
    faults: FaultPlan = field(default_factory=FaultPlan)

    def __post_init__(self) -> None:
        if not 0 <= self.camera_port <= 65535:
            raise ValueError(f"camera: expected a port of 0..65535, found {self.camera_port}")

    @staticmethod
    def parse(text: str | None) -> LinkOptions:
        """Parse `--link`; None: a pty in the user's runtime directory. Raises FrontEndError."""
        if text is None:
            text = f"serial:{_own_folder() / 'carter-can'}"
        where, *settings = text.split(",")
        try:
            given: dict[str, Any] = {}
            camera = [setting for setting in settings if setting.startswith("camera=")]
            faults = [setting for setting in settings if not setting.startswith("camera=")]
            if camera:
                given["camera_port"] = _port(camera[-1].removeprefix("camera="))
            if faults:
                given["faults"] = parse_plan(FaultPlan, faults)
            return LinkOptions(BusAddress.parse(where), **given)
        except ValueError as error:
            raise FrontEndError(f"--link {text}: {error}") from error


def _own_folder() -> Path:
    """Return the user's runtime directory; create it if needed and check its owner (/tmp is open to all users)."""
    folder = runtime_dir()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        check_is_ours(folder, "--link")
    except OSError as error:
        raise FrontEndError(f"{folder}: cannot be used: {error.strerror}; give another --link") from error
    except ConfigError as error:
        raise FrontEndError(str(error)) from error
    return folder


def _port(text: str) -> int:
    if not (text.isascii() and text.isdecimal()):
        raise ValueError(f"camera: expected a port of 0..65535, found {text!r}")
    return int(text)


def _velocity(received: Received) -> Vec3 | None:
    """Return the requested velocity: zero for a stop, None for a frame that requests no motion."""
    if received.name == "VelocityCommand":
        return received.signals["Vx"], 0.0, received.signals["Wz"]
    return (0.0, 0.0, 0.0) if (received.name, received.signals["Request"]) in _STOPS else None


class CanFrontEnd(CameraFrontEnd):
    """CAN front end of a simulated Carter."""

    def __init__(self, robot: Carter, options: FrontEndOptions, link: LinkOptions, state_length: int) -> None:
        """Open bus and camera. Raises FrontEndError, BusError or OSError."""
        self._options, self._address = options, link.address
        self._node = CanNode(robot)
        self._sensors = CarterSensors(robot, odometry_noise=options.odometry_noise, seed=options.seed)
        self._faulty = link.faults != FaultPlan() or options.faults is not None
        self._faults: PlanFaults[FaultPlan] | None = None
        self._inwards = FaultShim(link.faults, options.seed, 0)
        self._outwards = FaultShim(link.faults, options.seed, 1)
        self._log = CommandLog()
        self._commands: list[ReceivedCommand] = []
        self._last_event: tuple[tuple[str, float], float] | None = None
        self._now_s = 0.0
        self._states = 0
        self._line: PtyLine | None = None
        self._link: BusLink | None = None
        self._camera: CameraStream | None = None
        try:
            if options.faults is not None:
                self._faults = PlanFaults(options.faults, link.faults, SWITCHES)
            self._link = BusLink(open_bus(self._bus_to_open(link.address)))
            if options.camera_size is not None:
                self._camera = CameraStream(options, link.camera_port, state_length)
        except BaseException:
            self.close()
            raise

    def _bus_to_open(self, address: BusAddress) -> BusAddress:
        """Return the bus to open: for a serial path that does not exist, our end of a new pty linked to that path."""
        path = Path(address.channel)
        if address.interface != "serial":
            return address
        if path.is_symlink() and not path.exists():
            path.unlink()  # left by a killed run; its pty no longer exists
        if path.is_symlink() and str(path.resolve()).startswith("/dev/pts/"):
            raise FrontEndError(
                f"--link {address}: expected a free path, found the line of another run; end it or remove the link"
            )
        if path.exists():
            return address
        try:
            self._line = PtyLine(path)
        except OSError as error:
            raise FrontEndError(f"--link {address}: expected a path for a pty, {error.strerror}") from error
        return BusAddress("serial", self._line.near)

    def where(self) -> str:
        """Return the addresses of bus and camera."""
        camera = "no camera" if self._camera is None else f"camera {self._camera.url}"
        return f"CAN {self._address}, {camera}"

    def wait(self, left_ns: int) -> None:
        """Wait until a frame arrives, at most `left_ns`."""
        assert self._link is not None
        self._link.wait(left_ns)

    def serve(self) -> list[ReceivedCommand]:
        """Execute the received commands and return them. Raises BusError if the bus was lost."""
        assert self._link is not None
        for received_ns, frame in self._link.receive():
            if frame.identifier in _OWN and not frame.error:
                continue  # a bus between processes also returns what we sent
            if self._is_on("deaf", "mute"):
                continue
            if self._faulty:
                self._inwards.put(frame, self._now_s)
            else:
                self._handle(frame, received_ns)
        self._handle_delayed()
        if self._camera is not None:
            self._camera.events()
        commands, self._commands = self._commands, []
        return commands

    def _handle_delayed(self) -> None:
        if self._faulty:
            for frame in self._inwards.take(self._now_s):
                self._handle(frame, time.monotonic_ns())

    def _handle(self, frame: Frame, received_ns: int) -> None:
        received = self._node.receive(frame, self._now_s)
        if received is None or received.name not in _TRACED:
            return
        stop = received.name == "EstopControl" and received.signals.get("Request") == frames.ESTOP_STOP
        if (received.good or stop) and not self._is_repeated(received):
            self._note(received)
            content = " ".join(f"{key}={received.signals[key]:g}" for key in _TRACED[received.name])
            velocity = _velocity(received)
            self._commands.append(
                ReceivedCommand(received_ns, "can", frame.identifier, received.name, content, velocity=velocity)
            )

    def _note(self, received: Received) -> None:
        """Count one obeyed frame."""
        self._log.last_command = received.name
        if received.name == "VelocityCommand":
            self._log.move(received.name, _velocity(received))
        elif _velocity(received) is not None:
            self._log.at_zero = True

    def _is_repeated(self, received: Received) -> bool:
        """Return whether this frame repeats an event, which is sent three times."""
        if received.name == "VelocityCommand":
            return False
        event, last = (received.name, received.signals["Request"]), self._last_event
        self._last_event = (event, self._now_s)
        return last is not None and last[0] == event and self._now_s - last[1] < _EVENT_S

    def publish(self, step: int, stamp_s: float) -> None:
        """Advance the node's clock and send the frames that are due."""
        assert self._link is not None
        self._now_s = stamp_s
        self._apply_faults()
        self._handle_delayed()
        self._node.step(stamp_s)
        due = self._node.due(stamp_s, self._read)
        if self._faulty:
            for frame in due:
                self._outwards.put(frame, stamp_s)
            # Each node detects the bus's error frames by itself.
            due = [frame for frame in self._outwards.take(stamp_s) if not frame.error]
        if self._is_on("silent", "mute"):
            return
        for frame in due:
            self._states += frame.identifier == _MOTION_ID
            self._link.send(frame)

    def _apply_faults(self) -> None:
        if self._faults is None:
            return
        self._faults.poll()
        self._node.button = "button" in self._faults.active
        self._sensors.is_empty = "battery_empty" in self._faults.active
        for shim in (self._inwards, self._outwards):
            shim.plan, shim.held_off = self._faults.plan, "bus_off" in self._faults.active

    def _is_on(self, *switches: str) -> bool:
        return self._faults is not None and not self._faults.active.isdisjoint(switches)

    @property
    def pending(self) -> int:
        """Number of frames that are not sent yet."""
        return 0 if self._link is None else self._link.pending

    def _read(self) -> Sensors:
        return self._sensors.read(self._now_s)

    def close(self) -> None:
        """End the camera process, close the bus, remove the pty and the fault socket."""
        if self._faults is not None:
            self._faults.close()
        if self._camera is not None:
            self._camera.close()
        if self._link is not None:
            self._link.close()
        if self._line is not None:
            self._line.close()

    def summary(self) -> dict[str, object]:
        """Return the counts of received and sent messages."""
        counts, link = self._node.counts, self._link
        line_errors, sent, unsent = (0, 0, 0) if link is None else (link.line_errors, link.sent, link.unsent)
        can = {
            "wrong_crc": counts.wrong_crc,
            "wrong_length": counts.wrong_length,
            "wrong_counter": counts.wrong_counter,
            "lost": counts.lost,
            "unknown": counts.unknown,
            "bus_offs": counts.bus_offs,
            "error_frames": counts.error_frames,
            "line_errors": line_errors,
            "sent": sent,
            "unsent": unsent,
        }
        return {
            "wire": {**self._log.summary(), "malformed": counts.malformed + line_errors, "can": can},
            "video_frames": 0 if self._camera is None else self._camera.pictures,
            "states": self._states,
        }


_MOTION_ID: Final = frames.database().get_message_by_name("OdometryMotion").frame_id
_OWN: Final = frozenset({BABBLER_ID, *(message.frame_id for message in frames.sent_by("Base"))})


def open_front_end(simulation: Simulation, options: FrontEndOptions) -> CanFrontEnd:
    """Open the front end of `--protocol can`. Raises FrontEndError or OSError."""
    robot = simulation.robot
    if not isinstance(robot, Carter):
        raise FrontEndError(f"--protocol can: expected the Carter, found a {type(robot).__name__}")
    try:
        return CanFrontEnd(robot, options, LinkOptions.parse(options.link), len(simulation.render_state()))
    except BusError as error:
        raise FrontEndError(str(error)) from error
