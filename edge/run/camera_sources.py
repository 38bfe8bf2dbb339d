"""Opens the camera that the robot file names in `camera.source`."""

from __future__ import annotations

from collections.abc import Callable

from edge.cameras.mjpeg import MjpegCamera
from edge.cameras.newest import CameraSource
from edge.cameras.video_capture import VideoCaptureCamera
from firmware_bridge.core.config import RobotConfig


class RobotCamera:
    """Camera of the robot's own protocol, which sends a picture on request and no capture stamp."""

    captured_ns = None

    def __init__(self, request_frame: Callable[[float], bytes]) -> None:
        self.request_frame = request_frame

    def close(self) -> None:
        """Do nothing: the robot's reader owns the link."""


def open_camera(robot: RobotConfig) -> CameraSource:
    """Open a camera that is not the robot's own; it connects in a thread of its own, so a missing one is no error yet.

    Raises LinkOpenError when the ROS 2 network cannot be joined, ValueError for source "robot".
    """
    latency_ns = round(robot.camera.latency_ms * 1e6)
    kind, _, address = robot.camera.source.partition(":")
    if kind == "http":
        return MjpegCamera(robot.camera.source, latency_ns=latency_ns)
    if kind in ("v4l2", "gstreamer"):
        return VideoCaptureCamera(kind, address, latency_ns=latency_ns)
    raise ValueError(f"camera.source {robot.camera.source}: expected http, v4l2, gstreamer, ros2 or ros2raw")
