"""ROS 2 messages of time, text and geometry: builtin_interfaces, std_msgs, geometry_msgs.

Field lists: ros2/rcl_interfaces and ros2/common_interfaces (Apache-2.0), unchanged since Foxy. A ROS 2 type
`geometry_msgs/msg/Twist` is announced on DDS as `geometry_msgs::msg::dds_::Twist_`. Octets are declared `Octet`
(reason: `firmware_bridge/dds/binding.py`). Lengths are in m, angles in rad, quaternions in the order x, y, z, w.
"""

# ruff: noqa: N801 - the names are the wire's type names
# cyclonedds reads these annotations at run time, so `from __future__ import annotations` must stay away from here.
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cyclonedds.idl.types as t
from cyclonedds.idl import IdlStruct

# mypy cannot read `t.array[...]`: it sees plain sequences, the CDR code sees the lengths.
if TYPE_CHECKING:
    F64x36 = Sequence[float]
else:
    F64x36 = t.array[t.float64, 36]


@dataclass
class Time_(IdlStruct, typename="builtin_interfaces.msg.dds_.Time_"):
    sec: t.int32
    nanosec: t.uint32


@dataclass
class Header_(IdlStruct, typename="std_msgs.msg.dds_.Header_"):
    stamp: Time_
    frame_id: str


@dataclass
class String_(IdlStruct, typename="std_msgs.msg.dds_.String_"):
    data: str


@dataclass
class Float64_(IdlStruct, typename="std_msgs.msg.dds_.Float64_"):
    data: t.float64


@dataclass
class Vector3_(IdlStruct, typename="geometry_msgs.msg.dds_.Vector3_"):
    x: t.float64
    y: t.float64
    z: t.float64


@dataclass
class Point_(IdlStruct, typename="geometry_msgs.msg.dds_.Point_"):
    x: t.float64
    y: t.float64
    z: t.float64


@dataclass
class Quaternion_(IdlStruct, typename="geometry_msgs.msg.dds_.Quaternion_"):
    x: t.float64
    y: t.float64
    z: t.float64
    w: t.float64


@dataclass
class Pose_(IdlStruct, typename="geometry_msgs.msg.dds_.Pose_"):
    position: Point_
    orientation: Quaternion_


@dataclass
class PoseStamped_(IdlStruct, typename="geometry_msgs.msg.dds_.PoseStamped_"):
    header: Header_
    pose: Pose_


@dataclass
class PoseWithCovariance_(IdlStruct, typename="geometry_msgs.msg.dds_.PoseWithCovariance_"):
    pose: Pose_
    covariance: F64x36


@dataclass
class Twist_(IdlStruct, typename="geometry_msgs.msg.dds_.Twist_"):
    linear: Vector3_
    angular: Vector3_


@dataclass
class TwistStamped_(IdlStruct, typename="geometry_msgs.msg.dds_.TwistStamped_"):
    header: Header_
    twist: Twist_


@dataclass
class TwistWithCovariance_(IdlStruct, typename="geometry_msgs.msg.dds_.TwistWithCovariance_"):
    twist: Twist_
    covariance: F64x36


@dataclass
class Transform_(IdlStruct, typename="geometry_msgs.msg.dds_.Transform_"):
    translation: Vector3_
    rotation: Quaternion_


@dataclass
class TransformStamped_(IdlStruct, typename="geometry_msgs.msg.dds_.TransformStamped_"):
    header: Header_
    child_frame_id: str
    transform: Transform_
