"""The low-level state of a Go2: motors, battery, remote. Same rules as `idl.py`."""

# ruff: noqa: N801 - the names are the wire's type names
# cyclonedds reads these annotations at run time, so `from __future__ import annotations` must stay away from here.
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cyclonedds.idl.types as t
from cyclonedds.idl import IdlStruct

from firmware_bridge.dds.binding import Octet
from firmware_bridge.unitree.messages.idl import I16x4, IMUState_

if TYPE_CHECKING:
    Octets2 = Sequence[int]
    Octets40 = Sequence[int]
    U16x15 = Sequence[int]
    U16x4 = Sequence[int]
    U32x2 = Sequence[int]
else:
    Octets2 = t.array[Octet, 2]
    Octets40 = t.array[Octet, 40]
    U16x15 = t.array[t.uint16, 15]
    U16x4 = t.array[t.uint16, 4]
    U32x2 = t.array[t.uint32, 2]


@dataclass
class MotorState_(IdlStruct, typename="unitree_go.msg.dds_.MotorState_"):
    mode: Octet
    q: t.float32
    dq: t.float32
    ddq: t.float32
    tau_est: t.float32
    q_raw: t.float32
    dq_raw: t.float32
    ddq_raw: t.float32
    temperature: Octet
    lost: t.uint32
    reserve: U32x2


if TYPE_CHECKING:
    MotorStates = Sequence[MotorState_]
else:
    MotorStates = t.array[MotorState_, 20]


@dataclass
class BmsState_(IdlStruct, typename="unitree_go.msg.dds_.BmsState_"):
    version_high: Octet
    version_low: Octet
    status: Octet
    soc: Octet
    current: t.int32
    cycle: t.uint16
    bq_ntc: Octets2
    mcu_ntc: Octets2
    cell_vol: U16x15


@dataclass
class LowState_(IdlStruct, typename="unitree_go.msg.dds_.LowState_"):
    head: Octets2
    level_flag: Octet
    frame_reserve: Octet
    sn: U32x2
    version: U32x2
    bandwidth: t.uint16
    imu_state: IMUState_
    motor_state: MotorStates
    bms_state: BmsState_
    foot_force: I16x4
    foot_force_est: I16x4
    tick: t.uint32
    wireless_remote: Octets40
    bit_flag: Octet
    adc_reel: t.float32
    temperature_ntc1: Octet
    temperature_ntc2: Octet
    power_v: t.float32
    power_a: t.float32
    fan_frequency: U16x4
    reserve: t.uint32
    crc: t.uint32
