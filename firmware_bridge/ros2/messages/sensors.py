"""ROS 2 messages of sensor_msgs: IMU, battery and camera. Same rules as `common.py`."""

# ruff: noqa: N801 - the names are the wire's type names
# cyclonedds reads these annotations at run time, so `from __future__ import annotations` must stay away from here.
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cyclonedds.idl.types as t
from cyclonedds.idl import IdlStruct

from firmware_bridge.dds.binding import Octet
from firmware_bridge.ros2.messages.common import Header_, Quaternion_, Vector3_

if TYPE_CHECKING:
    F32Sequence = Sequence[float]
    F64Sequence = Sequence[float]
    F64x9 = Sequence[float]
    F64x12 = Sequence[float]
    OctetSequence = Sequence[int]
else:
    F32Sequence = t.sequence[t.float32]
    F64Sequence = t.sequence[t.float64]
    F64x9 = t.array[t.float64, 9]
    F64x12 = t.array[t.float64, 12]
    OctetSequence = t.sequence[Octet]


@dataclass
class Imu_(IdlStruct, typename="sensor_msgs.msg.dds_.Imu_"):
    header: Header_
    orientation: Quaternion_
    orientation_covariance: F64x9
    angular_velocity: Vector3_
    angular_velocity_covariance: F64x9
    linear_acceleration: Vector3_
    linear_acceleration_covariance: F64x9


@dataclass
class BatteryState_(IdlStruct, typename="sensor_msgs.msg.dds_.BatteryState_"):
    header: Header_
    voltage: t.float32
    temperature: t.float32
    current: t.float32
    charge: t.float32
    capacity: t.float32
    design_capacity: t.float32
    percentage: t.float32
    power_supply_status: Octet
    power_supply_health: Octet
    power_supply_technology: Octet
    present: bool
    cell_voltage: F32Sequence
    cell_temperature: F32Sequence
    location: str
    serial_number: str


@dataclass
class CompressedImage_(IdlStruct, typename="sensor_msgs.msg.dds_.CompressedImage_"):
    header: Header_
    format: str
    data: OctetSequence


@dataclass
class Image_(IdlStruct, typename="sensor_msgs.msg.dds_.Image_"):
    header: Header_
    height: t.uint32
    width: t.uint32
    encoding: str
    is_bigendian: Octet
    step: t.uint32
    data: OctetSequence


@dataclass
class RegionOfInterest_(IdlStruct, typename="sensor_msgs.msg.dds_.RegionOfInterest_"):
    x_offset: t.uint32
    y_offset: t.uint32
    height: t.uint32
    width: t.uint32
    do_rectify: bool


@dataclass
class CameraInfo_(IdlStruct, typename="sensor_msgs.msg.dds_.CameraInfo_"):
    header: Header_
    height: t.uint32
    width: t.uint32
    distortion_model: str
    d: F64Sequence
    k: F64x9
    r: F64x9
    p: F64x12
    binning_x: t.uint32
    binning_y: t.uint32
    roi: RegionOfInterest_
