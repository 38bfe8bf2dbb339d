"""The contract of every backend, for a Go2 in another DDS participant."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import replace

import pytest
from cyclonedds.core import DDSException

from firmware_bridge.core.config import load_robot_config
from firmware_bridge.unitree.messages import ids
from firmware_bridge.unitree.messages.idl import WirelessController_
from firmware_bridge.unitree.robot_link import RobotLink
from sim_hil.protocols.unitree.odometry import OdometryFrame
from sim_hil.protocols.unitree.state import sport_mode_state
from tests.support.processes import GO2_SIM
from tests.support.robot.backend_contract import BackendContract
from tests.support.robot.fake_go2 import FakeGo2, standing
from tests.support.robot.fake_ros2_base import leave, second_bus


def refused(_: object) -> None:
    raise DDSException(DDSException.DDS_RETCODE_OUT_OF_RESOURCES)


class Go2Rig:
    """A link and a Go2 that stands up when asked and then stays where it is."""

    def __init__(self, domain: int) -> None:
        config = load_robot_config(GO2_SIM, domain=domain)
        self.config = replace(config, bridge=replace(config.bridge, state_timeout_ms=300))
        self.link = RobotLink(self.config, lambda _: None)
        self._bus = second_bus(domain)
        self._go2 = FakeGo2(domain, self._bus)
        self._reporting = True

    @property
    def reporting(self) -> bool:
        return self._go2.reporting

    @reporting.setter
    def reporting(self, value: bool) -> None:
        self._go2.reporting = value

    @property
    def commands(self) -> list[tuple[float, float]]:
        return [(move.velocity[0], move.velocity[2]) for move in self._go2.moves() if move.velocity is not None]

    @property
    def requests(self) -> int:
        return sum(command.api_id not in (ids.MOVE, ids.API_VERSION) for command in list(self._go2.received))

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def spin(self) -> None:
        time.sleep(0.02)

    def send_garbage(self) -> None:
        state = sport_mode_state(standing(time_s=time.monotonic()), OdometryFrame((0.0, 0.0, 0.0)))
        state.velocity = [math.nan, 0.0, 0.0]
        self._go2._state.write(state)
        self._go2._remote.write(WirelessController_(math.inf, 0.0, 0.0, 0.0, 0))

    def refuse(self) -> None:
        self.link._sport._writer.write = refused  # type: ignore[method-assign]

    def close(self) -> None:
        self._go2._closing.set()
        self._go2._thread.join()
        leave(self._bus)
        self.link.close()


class TestGo2Contract(BackendContract):
    FILE = GO2_SIM

    @pytest.fixture
    def rig(self, dds_domain: int) -> Iterator[Go2Rig]:
        rig = Go2Rig(dds_domain)
        yield rig
        rig.close()
