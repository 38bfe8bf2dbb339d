"""The table [ros2] of a robot file."""

from __future__ import annotations

from dataclasses import dataclass

from firmware_bridge.core.sections import Section


@dataclass(frozen=True)
class Ros2Config(Section):
    """Topics of a base that takes a Twist: ROS names without the DDS prefix, relative to `namespace`."""

    namespace: str = "/"
    odometry: str = "odom"
    command: str = "cmd_vel"
    stamped: bool = False
