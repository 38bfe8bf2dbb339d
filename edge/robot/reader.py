"""Opens what the runner and the doctor read of a robot: its reports by protocol, its camera by `camera.source`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from edge.robot.cameras.mjpeg import MjpegCamera
from edge.robot.cameras.newest import CameraSource
from edge.robot.cameras.video_capture import VideoCaptureCamera
from firmware_bridge.core.config import RobotConfig
from firmware_bridge.core.robot_state import BatteryState, RobotState
from firmware_bridge.dds.shared_bus import SharedBus
from firmware_bridge.state_client import StateReader


class RobotReader(Protocol):
    """Reports of one robot; no method but `close` waits."""

    malformed: int
    """States that were dropped because something in them cannot be."""

    def state(self) -> RobotState | None:
        """Return the newest state, None before the first."""

    def battery(self) -> BatteryState | None:
        """Return the newest battery report, None before the first."""

    def surplus_publishers(self) -> str | None:
        """Return which input of the robot has more publishers than it should have; None where none is known."""

    def set_state_listener(self, listener: Callable[[RobotState], None] | None) -> None:
        """Call `listener` with every state as it arrives, in the reading thread."""

    def close(self) -> None:
        """Stop reading."""


class RobotCamera:
    """Camera of the robot's own protocol, which sends a picture on request and no capture stamp."""

    captured_ns = None

    def __init__(self, request_frame: Callable[[float], bytes]) -> None:
        self.request_frame = request_frame

    def close(self) -> None:
        """Do nothing: the robot's reader owns the link."""


def open_reader(
    robot: RobotConfig, on_death: Callable[[str], None] = lambda why: None, bus: SharedBus | None = None
) -> tuple[RobotReader, CameraSource]:
    """Open the robot's reports and its camera; close the camera first.

    `bus`: participant that a camera on ROS 2 shares; None gives it one of its own. `on_death` takes why the thread of
    the reports has ended, in that thread. Raises LinkOpenError, and ModuleNotFoundError where the library of the
    protocol is missing.
    """
    if robot.protocol != "unitree":  # only the bridge reads its link
        camera = open_camera(robot, bus)
        return StateReader(robot, on_death=on_death), camera
    from firmware_bridge.unitree.client import Go2Reader  # needs the extra of its protocol

    reader = Go2Reader(robot, on_death=on_death)
    return reader, RobotCamera(reader.request_frame) if robot.camera.source == "robot" else open_camera(robot)


def open_camera(robot: RobotConfig, bus: SharedBus | None = None) -> CameraSource:
    """Open a camera that is not the robot's own; it connects in a thread of its own, so a missing one is no error yet.

    Raises LinkOpenError where a network cannot be joined.
    """
    latency_ns = round(robot.camera.latency_ms * 1e6)
    kind, _, address = robot.camera.source.partition(":")
    if kind == "http":
        return MjpegCamera(robot.camera.source, latency_ns=latency_ns)
    if kind in ("v4l2", "gstreamer"):
        return VideoCaptureCamera(kind, address, latency_ns=latency_ns)
    if kind in ("ros2", "ros2raw"):
        from edge.robot.cameras.ros2 import Ros2Camera  # needs the extra of its protocol

        reliable = robot.ros2 is not None and robot.ros2.reliable_inputs
        return Ros2Camera(
            bus or robot.network, address, raw=kind == "ros2raw", reliable=reliable, latency_ns=latency_ns
        )
    raise ValueError(f"camera.source {robot.camera.source}: expected http, v4l2, gstreamer, ros2 or ros2raw")
