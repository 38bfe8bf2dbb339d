"""The Unitree DDS types that a Go2 speaks.

Every octet is declared `Octet` (reason: `binding.py`). The structs are final with sequential member ids, which are
this library's defaults. Field lists: unitreerobotics/unitree_ros2 (BSD-3).
Low-level types, which the bridge does not need, are in `idl_low.py`.
"""

# ruff: noqa: N801 - the names are the wire's type names
# cyclonedds reads these annotations at run time, so `from __future__ import annotations` must stay away from here.
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cyclonedds.idl.types as t
from cyclonedds.idl import IdlStruct

from firmware_bridge.dds.binding import Octet

# mypy cannot read `t.array[...]`: it sees plain sequences, the CDR code sees the lengths.
if TYPE_CHECKING:
    OctetSequence = Sequence[int]
    F32x12 = Sequence[float]
    F32x3 = Sequence[float]
    F32x4 = Sequence[float]
    I16x4 = Sequence[int]
else:
    OctetSequence = t.sequence[Octet]
    F32x12 = t.array[t.float32, 12]
    F32x3 = t.array[t.float32, 3]
    F32x4 = t.array[t.float32, 4]
    I16x4 = t.array[t.int16, 4]


@dataclass
class RequestIdentity_(IdlStruct, typename="unitree_api.msg.dds_.RequestIdentity_"):
    id: t.int64
    api_id: t.int64


@dataclass
class RequestLease_(IdlStruct, typename="unitree_api.msg.dds_.RequestLease_"):
    id: t.int64


@dataclass
class RequestPolicy_(IdlStruct, typename="unitree_api.msg.dds_.RequestPolicy_"):
    priority: t.int32
    noreply: bool


@dataclass
class RequestHeader_(IdlStruct, typename="unitree_api.msg.dds_.RequestHeader_"):
    identity: RequestIdentity_
    lease: RequestLease_
    policy: RequestPolicy_


@dataclass
class Request_(IdlStruct, typename="unitree_api.msg.dds_.Request_"):
    header: RequestHeader_
    parameter: str
    binary: OctetSequence


@dataclass
class ResponseStatus_(IdlStruct, typename="unitree_api.msg.dds_.ResponseStatus_"):
    code: t.int32


@dataclass
class ResponseHeader_(IdlStruct, typename="unitree_api.msg.dds_.ResponseHeader_"):
    identity: RequestIdentity_
    status: ResponseStatus_


@dataclass
class Response_(IdlStruct, typename="unitree_api.msg.dds_.Response_"):
    header: ResponseHeader_
    data: str
    binary: OctetSequence


@dataclass
class TimeSpec_(IdlStruct, typename="unitree_go.msg.dds_.TimeSpec_"):
    sec: t.int32
    nanosec: t.uint32


@dataclass
class IMUState_(IdlStruct, typename="unitree_go.msg.dds_.IMUState_"):
    quaternion: F32x4
    gyroscope: F32x3
    accelerometer: F32x3
    rpy: F32x3
    temperature: Octet


@dataclass
class PathPoint_(IdlStruct, typename="unitree_go.msg.dds_.PathPoint_"):
    t_from_start: t.float32
    x: t.float32
    y: t.float32
    yaw: t.float32
    vx: t.float32
    vy: t.float32
    vyaw: t.float32


if TYPE_CHECKING:
    PathPoints = Sequence[PathPoint_]
else:
    PathPoints = t.array[PathPoint_, 10]


@dataclass
class SportModeState_(IdlStruct, typename="unitree_go.msg.dds_.SportModeState_"):
    stamp: TimeSpec_
    error_code: t.uint32
    imu_state: IMUState_
    mode: Octet
    progress: t.float32
    gait_type: Octet
    foot_raise_height: t.float32
    position: F32x3
    body_height: t.float32
    velocity: F32x3
    yaw_speed: t.float32
    range_obstacle: F32x4
    foot_force: I16x4
    foot_position_body: F32x12
    foot_speed_body: F32x12
    path_point: PathPoints


@dataclass
class WirelessController_(IdlStruct, typename="unitree_go.msg.dds_.WirelessController_"):
    lx: t.float32
    ly: t.float32
    rx: t.float32
    ry: t.float32
    keys: t.uint16
