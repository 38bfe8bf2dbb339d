"""A ROS 2 base for tests: a DDS participant of its own that publishes what a test says and keeps what it receives."""

from __future__ import annotations

import math
import threading
import time
from typing import Any

from cyclonedds.domain import DomainParticipant

from firmware_bridge.dds.bus import Bus, take_each
from firmware_bridge.ros2.messages.common import (
    Header_,
    Point_,
    Pose_,
    PoseWithCovariance_,
    Quaternion_,
    Time_,
    Twist_,
    TwistStamped_,
    TwistWithCovariance_,
    Vector3_,
)
from firmware_bridge.ros2.messages.navigation import Odometry_
from firmware_bridge.ros2.messages.sensors import BatteryState_, Imu_


def second_bus(domain: int) -> Bus:
    """Another participant in a domain that this process has already opened; end it with `leave`."""
    bus = object.__new__(Bus)
    bus.participant = DomainParticipant(domain)
    bus._topics, bus._topics_lock = {}, threading.Lock()
    return bus


def leave(bus: Bus) -> None:
    """End a participant of `second_bus`: its publishers and subscribers disappear for all others."""
    bus.participant._delete(bus.participant._ref)


def time_of(stamp_ns: int) -> Time_:
    return Time_(*divmod(stamp_ns, 1_000_000_000))


def odometry(stamp_ns: int = 1, *, x_m: float = 0.0, yaw_rad: float = 0.0, vx_mps: float = 0.0) -> Odometry_:
    pose = Pose_(Point_(x_m, 0.0, 0.0), Quaternion_(0.0, 0.0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2)))
    twist = Twist_(Vector3_(vx_mps, 0.0, 0.0), Vector3_(0.0, 0.0, 0.0))
    return Odometry_(
        Header_(time_of(stamp_ns), "odom"),
        "base_link",
        PoseWithCovariance_(pose, [0.0] * 36),
        TwistWithCovariance_(twist, [0.0] * 36),
    )


def imu(roll_rad: float = 0.0) -> Imu_:
    orientation = Quaternion_(math.sin(roll_rad / 2), 0.0, 0.0, math.cos(roll_rad / 2))
    zero, none = Vector3_(0.0, 0.0, 0.0), [0.0] * 9
    return Imu_(Header_(Time_(1, 0), "base_link"), orientation, none, zero, none, Vector3_(0.0, 0.0, 9.81), none)


def battery(share: float = 0.8) -> BatteryState_:
    header = Header_(Time_(1, 0), "")
    return BatteryState_(header, 25.0, 20.0, -1.0, 1.0, 1.0, 1.0, share, 0, 0, 0, True, [], [], "", "")


class FakeRos2Base:
    """Publishes on the topics of the shipped robot file and keeps the received commands."""

    def __init__(self, bus: Bus, *, stamped: bool = False, reliable: bool = True) -> None:
        self.bus = bus
        self.odometry = bus.writer("rt/odom", Odometry_, reliable=reliable)
        self.imu = bus.writer("rt/imu", Imu_, reliable=reliable)
        self.battery = bus.writer("rt/battery_state", BatteryState_, reliable=reliable)
        kind: Any = TwistStamped_ if stamped else Twist_
        self._commands = bus.reader("rt/cmd_vel", kind, depth=100, reliable=reliable)
        self._stamp_ns = time.monotonic_ns()

    def report(self, **values: float) -> None:
        """Publish one report of every kind, stamped later than the last one."""
        self._stamp_ns += 20_000_000
        self.odometry.write(odometry(self._stamp_ns, **values))
        self.imu.write(imu())
        self.battery.write(battery())

    def commands(self) -> list[Any]:
        """The commands received since the last call."""
        return list(take_each(self._commands))
