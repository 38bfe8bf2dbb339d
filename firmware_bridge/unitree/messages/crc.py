"""The checksum that ends LowState and LowCmd.

CRC-32/MPEG-2 (polynomial 0x04C11DB7, start 0xFFFFFFFF, nothing reflected or inverted) over the little-endian 32-bit
words, most significant bit first, of the robot's C struct without its last word (protocol facts, section 2).
"""

from __future__ import annotations

import struct
import zlib
from typing import Final

from firmware_bridge.unitree.messages.idl_low import LowState_

_REVERSED_BITS: Final = bytes(int(f"{value:08b}"[::-1], 2) for value in range(256))
_MOTORS: Final = 20
# Native alignment of the C struct written out, as utils/crc.py of the maker's SDK does; 1180 bytes with the CRC.
LOW_STATE_LAYOUT: Final = struct.Struct(
    "<4B4IH2x" + "13fB3x" + "B3x7fB3x3I" * _MOTORS + "4BiH4B15H" + "8hI41B3xf2B2x2f4HI"
)


def crc32_mpeg2(data: bytes) -> int:
    """CRC-32/MPEG-2 of `data`; 0x0376E6E7 for b"123456789".

    It is zlib's CRC-32 with the bits of every byte and of the result reversed, and without the final inversion, so C
    code does the work: 10 us for a LowState.
    """
    reflected = zlib.crc32(data.translate(_REVERSED_BITS)) ^ 0xFFFFFFFF
    return int.from_bytes(reflected.to_bytes(4, "little").translate(_REVERSED_BITS), "big")


def crc_of_words(data: bytes) -> int:
    """Checksum of little-endian 32-bit words fed most significant bit first; `data` is a multiple of 4 bytes."""
    count = len(data) // 4
    return crc32_mpeg2(struct.pack(f">{count}I", *struct.unpack(f"<{count}I", data)))


def low_state_crc(state: LowState_) -> int:
    """Value that belongs into `state.crc`."""
    return crc_of_words(LOW_STATE_LAYOUT.pack(*low_state_values(state)))


def low_state_values(state: LowState_) -> tuple[float, ...]:
    """The numbers of a LowState in the order of the wire, without the checksum."""
    imu, bms = state.imu_state, state.bms_state
    motors: list[float] = []
    for motor in state.motor_state:
        motors += (motor.mode, motor.q, motor.dq, motor.ddq, motor.tau_est, motor.q_raw, motor.dq_raw, motor.ddq_raw)
        motors += (motor.temperature, motor.lost, *motor.reserve)
    return (
        *(*state.head, state.level_flag, state.frame_reserve, *state.sn, *state.version, state.bandwidth),
        *(*imu.quaternion, *imu.gyroscope, *imu.accelerometer, *imu.rpy, imu.temperature),
        *motors,
        *(bms.version_high, bms.version_low, bms.status, bms.soc, bms.current, bms.cycle, *bms.bq_ntc, *bms.mcu_ntc),
        *(*bms.cell_vol, *state.foot_force, *state.foot_force_est, state.tick, *state.wireless_remote, state.bit_flag),
        *(state.adc_reel, state.temperature_ntc1, state.temperature_ntc2, state.power_v, state.power_a),
        *(*state.fan_frequency, state.reserve),
    )
