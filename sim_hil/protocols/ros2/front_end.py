"""ROS 2 front end of `edge-hil`: the Carter as a base that follows a Twist on /cmd_vel and stops without one.

`--faults PATH` accepts an impairment's fields, "button" (emergency stop button pressed), "odometry_off" (no odometry is
sent), "deaf" (nothing is received), "silent" (nothing is sent), "mute" (both) and "battery_empty".
"""

from __future__ import annotations

import json
import math
import time
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.core.config import DdsConfig
from firmware_bridge.dds.bus import Bus, take_each
from firmware_bridge.ros2.messages.common import Twist_
from sim_hil.protocols.base import CameraFrontEnd, CommandLog, Vec3
from sim_hil.protocols.fault_socket import PlanFaults
from sim_hil.protocols.front_end import FrontEndError, FrontEndOptions, ReceivedCommand
from sim_hil.protocols.impairment import PERFECT, ImpairedDirection, Impairment
from sim_hil.protocols.render_process import RenderProcess
from sim_hil.protocols.ros2.topics import COMMAND_TOPIC, IMAGE_TOPIC, ODOMETRY_TOPIC, Reports
from sim_hil.robots.carter.body import Carter
from sim_hil.robots.carter.sensors import CarterSensors
from sim_hil.simulation.physics import Simulation

BASE_TIMEOUT_S: Final = 0.5
"""Time without a command after which the base stops by itself, s: the default of ros2_controllers' diff_drive."""
SWITCHES: Final = ("button", "odometry_off", "deaf", "silent", "mute", "battery_empty")
_MAX_BYTES: Final = 4096
_MAX_COMMAND: Final = 100.0  # m/s or rad/s: far beyond the base, which clips to its own limits


class Ros2FrontEnd(CameraFrontEnd):
    """ROS 2 front end of a simulated Carter. Raises DdsError, OSError or ValueError if it cannot be opened."""

    def __init__(self, simulation: Simulation, robot: Carter, options: FrontEndOptions, dds: DdsConfig) -> None:
        self._simulation, self._robot, self._dds = simulation, robot, dds
        self._sensors = CarterSensors(robot, odometry_noise=options.odometry_noise, seed=options.seed)
        self._log = CommandLog()
        self._malformed = self._pictures = 0
        self._now_s = 0.0
        self._commanded_s: float | None = None  # of the command in force
        self._faults: PlanFaults[Impairment] | None = None
        self._inwards = ImpairedDirection[tuple[Vec3, int]](options.seed, 0)
        self._outwards = ImpairedDirection[tuple[str, Any]](options.seed, 1)
        self._senders: dict[object, int] = {}  # publication handle -> number in order of appearance
        self._pressed = self._closed = False
        self.bus = Bus(dds)
        """DDS participant; a process may have one per domain."""
        try:
            if options.faults is not None:
                self._faults = PlanFaults(options.faults, PERFECT, SWITCHES)
            if options.camera_size is not None:
                more = ["--domain", str(dds.domain), "--interface", dds.interface]
                more += [argument for peer in dds.peers for argument in ("--peer", peer)]
                # The last element of what is rendered is the robot's clock, for the picture's header.
                length = len(simulation.render_state()) + 1
                self._camera = RenderProcess("sim_hil.protocols.ros2.camera", options, more, length)
            self._commands = self.bus.reader(COMMAND_TOPIC, Twist_, depth=64, reliable=True)
            self._waitset = self.bus.waitset(self._commands)
            self._reports = Reports(self.bus, simulation.rate_hz)
        except BaseException:
            self.close()
            raise
        robot.stand()  # such a base is powered from the start

    def where(self) -> str:
        """Return DDS domain, interface and the camera's topic."""
        camera = "no camera" if self._camera is None else f"camera {IMAGE_TOPIC}"
        return f"ROS 2 domain {self._dds.domain} on {self._dds.interface}, {camera}"

    def wait(self, left_ns: int) -> None:
        """Wait until a command arrives, at most `left_ns`."""
        self._waitset.wait(left_ns)

    def serve(self) -> list[ReceivedCommand]:
        """Obey the received commands and return them."""
        commands = []
        for sample in take_each(self._commands, max_bytes=_MAX_BYTES):
            velocity = None if sample is None else _velocity(sample)
            if not self._active.isdisjoint(("deaf", "mute")):
                continue
            if velocity is None:
                self._malformed += 1
                continue
            sender = self._senders.setdefault(sample.sample_info.publication_handle, len(self._senders))
            self._inwards.put((velocity, sender), self._impairment, self._now_s)
        for velocity, sender in self._inwards.take(self._now_s):
            self._robot.command(*velocity)
            self._commanded_s = self._now_s
            self._log.move("Twist", velocity)
            content = json.dumps(dict(zip("xyz", velocity, strict=True)))
            received = ReceivedCommand(
                time.monotonic_ns(), "cmd_vel", 0, "Twist", content, velocity=velocity, source=sender
            )
            commands.append(received)
        if self._camera is not None:
            self._pictures += sum(event["event"] == "picture" for event in self._camera.events())
        return commands

    def publish(self, step: int, stamp_s: float) -> None:
        """Stop the base if its command is too old, and write the topics that are due."""
        self._now_s = stamp_s
        self._apply_faults()
        if self._commanded_s is not None and stamp_s - self._commanded_s >= BASE_TIMEOUT_S:
            self._robot.command(0.0, 0.0, 0.0)
            self._commanded_s = None
        due = [] if not self._active.isdisjoint(("silent", "mute")) else self._reports.due(step)
        if "odometry_off" in self._active:
            due = [topic for topic in due if topic != ODOMETRY_TOPIC]
        if due:
            self._sensors.is_empty = "battery_empty" in self._active
            messages = self._reports.messages(due, self._sensors.read(stamp_s), self._robot.truth(stamp_s), stamp_s)
            for message in messages:
                self._outwards.put(message, self._impairment, stamp_s)
        for topic, message in self._outwards.take(stamp_s):
            self._reports.write(topic, message)

    def _apply_faults(self) -> None:
        if self._faults is None:
            return
        self._faults.poll()
        pressed = "button" in self._active
        if pressed and not self._pressed:
            self._robot.press_estop()
        elif self._pressed and not pressed:
            self._robot.release_estop()
            self._robot.stand()
        self._pressed = pressed

    @property
    def _impairment(self) -> Impairment:
        return PERFECT if self._faults is None else self._faults.plan

    @property
    def _active(self) -> set[str]:
        return set() if self._faults is None else self._faults.active

    def show(self, render_state: NDArray[np.float64]) -> None:
        """Pass the state to render and the robot's clock to the camera process."""
        super().show(np.append(render_state, self._now_s))

    def close(self) -> None:
        """End the camera process, remove the fault socket, close the DDS participant."""
        if self._closed:
            return
        self._closed = True
        if self._faults is not None:
            self._faults.close()
        if self._camera is not None:
            self._camera.close()
        self.bus.close()

    def summary(self) -> dict[str, object]:
        """Return the counts of received and sent messages."""
        return {
            "wire": {**self._log.summary(), "malformed": self._malformed},
            "video_frames": self._pictures,
            "states": self._reports.states,
        }


def _velocity(twist: Twist_) -> tuple[float, float, float] | None:
    """Return vx m/s, vy m/s and wz rad/s; None when one of the six numbers cannot be a command."""
    linear, angular = twist.linear, twist.angular
    numbers = (linear.x, linear.y, linear.z, angular.x, angular.y, angular.z)
    if not all(math.isfinite(number) and abs(number) <= _MAX_COMMAND for number in numbers):
        return None
    return linear.x, linear.y, angular.z


def open_front_end(simulation: Simulation, options: FrontEndOptions) -> Ros2FrontEnd:
    """Open the front end of `--protocol ros2`. Raises FrontEndError, ConfigError, DdsError or OSError."""
    robot = simulation.robot
    if not isinstance(robot, Carter):
        raise FrontEndError(f"--protocol ros2: expected the Carter, found a {type(robot).__name__}")
    peers = ("127.0.0.1",) if options.interface == "lo" else ()
    return Ros2FrontEnd(simulation, robot, options, DdsConfig(options.domain, options.interface, peers))
