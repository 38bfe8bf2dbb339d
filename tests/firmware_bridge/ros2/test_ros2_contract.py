"""The contract of every backend, for a ROS 2 base in another DDS participant."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from typing import Any

import pytest
from cyclonedds.core import DDSException

from firmware_bridge.core.config import load_robot_config
from firmware_bridge.ros2.robot_link import RobotLink
from tests.support.processes import GO2_SIM
from tests.support.robot.backend_contract import BackendContract
from tests.support.robot.fake_ros2_base import FakeRos2Base, battery, imu, leave, odometry, second_bus

FILE = GO2_SIM.with_name("carter_ros2_sim.toml")


def refused(_: object) -> None:
    raise DDSException(DDSException.DDS_RETCODE_OUT_OF_RESOURCES)


class Ros2Rig:
    """A link and a base that stands still."""

    def __init__(self, domain: int) -> None:
        self.config = load_robot_config(FILE, domain=domain)
        self.link = RobotLink(self.config, lambda _: None)
        self._base = FakeRos2Base(second_bus(domain))
        self.reporting, self.commands, self.requests = True, list[tuple[float, float]](), 0

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def spin(self) -> None:
        time.sleep(0.02)
        if self.reporting:
            self._base.report()
        self.commands += [(twist.linear.x, twist.angular.z) for twist in self._base.commands()]

    def send_garbage(self) -> None:
        stamp_ns = time.monotonic_ns()
        messages: list[tuple[Any, Any]] = [
            (self._base.odometry, odometry(stamp_ns, vx_mps=math.nan)),
            (self._base.odometry, odometry(stamp_ns, x_m=math.inf)),
            (self._base.imu, imu(math.nan)),
            (self._base.battery, battery(math.nan)),
        ]
        for writer, message in messages:
            writer.write(message)

    def refuse(self) -> None:
        self.link._writer.write = refused  # type: ignore[method-assign]

    def close(self) -> None:
        leave(self._base.bus)
        self.link.close()


class TestRos2Contract(BackendContract):
    FILE = FILE
    STANDS = False

    @pytest.fixture
    def rig(self, dds_domain: int) -> Iterator[Ros2Rig]:
        rig = Ros2Rig(dds_domain)
        yield rig
        rig.close()
