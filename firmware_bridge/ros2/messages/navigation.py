"""ROS 2 messages of nav_msgs, tf2_msgs and diagnostic_msgs. Same rules as `common.py`."""

# ruff: noqa: N801 - the names are the wire's type names
# cyclonedds reads these annotations at run time, so `from __future__ import annotations` must stay away from here.
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cyclonedds.idl.types as t
from cyclonedds.idl import IdlStruct

from firmware_bridge.dds.binding import Octet
from firmware_bridge.ros2.messages.common import (
    Header_,
    PoseStamped_,
    PoseWithCovariance_,
    TransformStamped_,
    TwistWithCovariance_,
)

if TYPE_CHECKING:
    PoseSequence = Sequence[PoseStamped_]
    TransformSequence = Sequence[TransformStamped_]
else:
    PoseSequence = t.sequence[PoseStamped_]
    TransformSequence = t.sequence[TransformStamped_]


@dataclass
class Odometry_(IdlStruct, typename="nav_msgs.msg.dds_.Odometry_"):
    header: Header_
    child_frame_id: str
    pose: PoseWithCovariance_
    twist: TwistWithCovariance_


@dataclass
class Path_(IdlStruct, typename="nav_msgs.msg.dds_.Path_"):
    header: Header_
    poses: PoseSequence


@dataclass
class TFMessage_(IdlStruct, typename="tf2_msgs.msg.dds_.TFMessage_"):
    transforms: TransformSequence


@dataclass
class KeyValue_(IdlStruct, typename="diagnostic_msgs.msg.dds_.KeyValue_"):
    key: str
    value: str


if TYPE_CHECKING:
    KeyValueSequence = Sequence[KeyValue_]
else:
    KeyValueSequence = t.sequence[KeyValue_]


@dataclass
class DiagnosticStatus_(IdlStruct, typename="diagnostic_msgs.msg.dds_.DiagnosticStatus_"):
    level: Octet
    name: str
    message: str
    hardware_id: str
    values: KeyValueSequence


if TYPE_CHECKING:
    DiagnosticStatusSequence = Sequence[DiagnosticStatus_]
else:
    DiagnosticStatusSequence = t.sequence[DiagnosticStatus_]


@dataclass
class DiagnosticArray_(IdlStruct, typename="diagnostic_msgs.msg.dds_.DiagnosticArray_"):
    header: Header_
    status: DiagnosticStatusSequence
