"""Unitree and ROS 2: samples as DDS hands them over before they are decoded.

The link is the real one with its participant; only the call that takes a sample's bytes from Cyclone DDS is replaced.
"""

from __future__ import annotations

import random
import struct
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any, Final
from unittest import mock

import numpy as np

from firmware_bridge.core.config import RobotConfig
from firmware_bridge.core.step_types import Backend
from firmware_bridge.dds import bus
from firmware_bridge.ros2.messages import common, navigation, sensors
from firmware_bridge.ros2.robot_link import RobotLink as Ros2Link
from firmware_bridge.unitree.messages import idl, ids
from firmware_bridge.unitree.requests import make_request
from firmware_bridge.unitree.robot_link import RobotLink as UnitreeLink
from sim_hil.protocols.unitree.odometry import OdometryFrame
from sim_hil.protocols.unitree.state import LowStateMessage, sport_mode_state
from sim_hil.robots.go2.body import RobotTruth
from tools.fuzz.harness import mutated

_STEP_NS: Final = 250_000_000  # the battery is read once a second
_STAMP: Final = struct.Struct("<iI")
_STAMPED: Final = (idl.SportModeState_, navigation.Odometry_)
"""Messages that begin with a stamp, after the 4 bytes of the CDR header."""
_MOST_WAITING: Final = 64
_INFO: Final = SimpleNamespace(valid_data=True, publication_handle=1)


class DdsTarget:
    """A link whose readers get mutated samples."""

    batch = 12

    def __init__(
        self, config: RobotConfig, link: Callable[[RobotConfig, Callable[[str], None]], Backend], samples: Sequence[Any]
    ) -> None:
        """`samples`: good messages to mutate, one or more of each type that the link reads."""
        self.config = config
        self.decoded = 0
        self._good = [(type(sample), sample.serialize()) for sample in samples]
        self._waiting: Mapping[Any, deque[bytes]] = {kind: deque(maxlen=_MOST_WAITING) for kind, _ in self._good}
        self._now_ns = time.monotonic_ns()
        self.link = link(config, lambda _: None)
        self._patch = mock.patch.object(bus, "take_undecoded", self._take)
        self._patch.start()

    def _take(self, reader: Any) -> list[tuple[bytes, Any]]:
        waiting = self._waiting.get(reader.topic.data_type)
        if not waiting:
            return []
        self.decoded += 1
        return [(waiting.popleft(), _INFO)]

    def now_ns(self) -> int:
        """Return the time of the next step: 250 ms later."""
        self._now_ns += _STEP_NS
        return self._now_ns

    def put(self, chance: random.Random) -> None:
        """Let one sample wait; the oldest of a type that is read rarely is dropped."""
        kind, good = chance.choice(self._good)
        if kind in _STAMPED and chance.random() < 0.9:
            good = good[:4] + _STAMP.pack(*divmod(time.monotonic_ns(), 1_000_000_000)) + good[12:]
        data = chance.randbytes(chance.randrange(len(good))) if chance.random() < 0.05 else mutated(good, chance)
        self._waiting[kind].append(data)

    def motion(self) -> str | None:
        """Return None: these links send only what the rules request."""
        return None

    def close(self) -> None:
        """Leave the network."""
        self._patch.stop()
        self.link.close()


def unitree_target(config: RobotConfig) -> DdsTarget:
    """Return the target of a Go2's link."""
    zeros = np.zeros
    truth = RobotTruth(
        time_s=1.0,
        position_m=zeros(3),
        quaternion_wxyz=np.array((1.0, 0.0, 0.0, 0.0)),
        rpy_rad=zeros(3),
        velocity_world_mps=zeros(3),
        gyro_radps=zeros(3),
        accel_mps2=zeros(3),
        joint_q_rad=zeros(12),
        joint_dq_radps=zeros(12),
        joint_tau_nm=zeros(12),
        foot_force_n=zeros(4),
        foot_position_body_m=zeros((4, 3)),
        foot_velocity_body_mps=zeros((4, 3)),
        mode=ids.MODE_BALANCE_STAND,
        gait_type=0,
        body_height_m=0.3,
        commanded=(0.0, 0.0, 0.0),
    )
    answer = idl.ResponseHeader_(idl.RequestIdentity_(1, ids.API_VERSION), idl.ResponseStatus_(0))
    samples = (
        sport_mode_state(truth, OdometryFrame((0.0, 0.0, 0.0))),
        LowStateMessage().message,
        idl.WirelessController_(0.0, 0.0, 0.0, 0.0, 0),
        make_request(1, ids.MOVE, '{"x": 0.5, "y": 0.0, "z": 0.0}', noreply=True),
        idl.Response_(answer, "1.0.0.1", b""),
    )
    return DdsTarget(config, UnitreeLink, samples)


def ros2_target(config: RobotConfig) -> DdsTarget:
    """Return the target of a ROS 2 base's link."""
    header = common.Header_(common.Time_(1, 0), "odom")
    upright, zero = common.Quaternion_(0.0, 0.0, 0.0, 1.0), common.Vector3_(0.0, 0.0, 0.0)
    pose = common.PoseWithCovariance_(common.Pose_(common.Point_(1.0, 2.0, 0.0), upright), [0.0] * 36)
    twist = common.Twist_(common.Vector3_(0.1, 0.0, 0.0), zero)
    samples = (
        navigation.Odometry_(header, "base_link", pose, common.TwistWithCovariance_(twist, [0.0] * 36)),
        sensors.Imu_(header, upright, [0.0] * 9, zero, [0.0] * 9, zero, [0.0] * 9),
        sensors.BatteryState_(header, 25.0, 20.0, -1.0, 1.0, 1.0, 1.0, 0.8, 0, 0, 0, True, [], [], "", ""),
        twist,
    )
    return DdsTarget(config, Ros2Link, samples)
