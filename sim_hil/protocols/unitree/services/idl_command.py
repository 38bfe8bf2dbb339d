"""Low command message, for the simulated robot only: code that commands a real robot must not be able to decode it.

Type and member names are those of the wire; octets: see firmware_bridge/dds/binding.py.
"""

# ruff: noqa: N801 - the names are the wire's type names
# cyclonedds reads these annotations at run time, so `from __future__ import annotations` must stay away from here.
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cyclonedds.idl.types as t
from cyclonedds.idl import IdlStruct

from firmware_bridge.dds.binding import Octet

if TYPE_CHECKING:
    Octets2 = Sequence[int]
    Octets3 = Sequence[int]
    Octets12 = Sequence[int]
    Octets40 = Sequence[int]
    U32x2 = Sequence[int]
    U32x3 = Sequence[int]
else:
    Octets2 = t.array[Octet, 2]
    Octets3 = t.array[Octet, 3]
    Octets12 = t.array[Octet, 12]
    Octets40 = t.array[Octet, 40]
    U32x2 = t.array[t.uint32, 2]
    U32x3 = t.array[t.uint32, 3]


@dataclass
class MotorCmd_(IdlStruct, typename="unitree_go.msg.dds_.MotorCmd_"):
    mode: Octet
    q: t.float32
    dq: t.float32
    tau: t.float32
    kp: t.float32
    kd: t.float32
    reserve: U32x3


if TYPE_CHECKING:
    MotorCmds = Sequence[MotorCmd_]
else:
    MotorCmds = t.array[MotorCmd_, 20]


@dataclass
class BmsCmd_(IdlStruct, typename="unitree_go.msg.dds_.BmsCmd_"):
    off: Octet
    reserve: Octets3


@dataclass
class LowCmd_(IdlStruct, typename="unitree_go.msg.dds_.LowCmd_"):
    head: Octets2
    level_flag: Octet
    frame_reserve: Octet
    sn: U32x2
    version: U32x2
    bandwidth: t.uint16
    motor_cmd: MotorCmds
    bms_cmd: BmsCmd_
    wireless_remote: Octets40
    led: Octets12
    fan: Octets2
    gpio: Octet
    reserve: t.uint32
    crc: t.uint32
