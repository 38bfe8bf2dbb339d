"""The Unitree message types and the low-level checksum."""

from __future__ import annotations

import dataclasses

import cyclonedds.idl.types as t
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge.unitree.messages import idl, idl_low
from firmware_bridge.unitree.messages.crc import LOW_STATE_LAYOUT, crc32_mpeg2, crc_of_words, low_state_crc
from firmware_bridge.unitree.rpc import make_request
from sim_hil.protocols.unitree.odometry import OdometryFrame
from sim_hil.protocols.unitree.state import LowStateMessage, sport_mode_state
from tests.support.robot.fake_go2 import standing

TYPES = [
    kind
    for kind in {**vars(idl), **vars(idl_low)}.values()
    if isinstance(kind, type) and issubclass(kind, idl.IdlStruct) and kind is not idl.IdlStruct
]


def bitwise_crc(data: bytes) -> int:
    """CRC-32/MPEG-2 as its definition has it, bit by bit."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte << 24
        for _ in range(8):
            crc = (crc << 1 ^ 0x04C11DB7) & 0xFFFFFFFF if crc & 0x80000000 else crc << 1
    return crc


def test_there_are_types_to_check() -> None:
    assert len(TYPES) >= 14


@pytest.mark.parametrize("kind", TYPES, ids=lambda kind: kind.__name__)
def test_no_type_declares_an_octet_that_a_0_10_2_robot_dies_of(kind: type) -> None:
    """The announced XTypes object must not contain TK_UINT8 (0x0D), which only the binding 11.0 makes, of `uint8`."""
    with_uint8 = not hasattr(t, "byte")  # 0.10 has no other octet, and announces it as TK_BYTE
    for field in dataclasses.fields(kind):
        assert ("uint8" in str(field.type)) <= with_uint8, f"{kind.__name__}.{field.name}"


def test_a_request_has_the_bytes_of_the_makers_layout() -> None:
    request = make_request(0x0102030405060708, 1008, '{"x": 0.5}', noreply=True)
    expected = bytes.fromhex("00010000")  # CDR, little-endian
    expected += (0x0102030405060708).to_bytes(8, "little") + (1008).to_bytes(8, "little")  # identity
    expected += bytes(8) + bytes(4) + b"\x01"  # lease, priority, noreply
    expected += bytes(3) + (11).to_bytes(4, "little") + b'{"x": 0.5}\0'  # parameter
    expected += bytes(1) + bytes(4)  # empty binary, aligned
    assert request.serialize() == expected


def test_a_sport_state_has_the_size_of_the_makers_layout() -> None:
    # Header 4; stamp, error code 12; IMU 53 + mode 1 + padding 2; 4 + 1 + 3 + 4; then 432 bytes of 4-aligned fields.
    state = sport_mode_state(standing(), OdometryFrame((0.0, 0.0, 0.0)))
    assert len(state.serialize()) == 4 + 12 + 56 + 12 + 432


def test_a_state_survives_the_wire() -> None:
    state = sport_mode_state(
        standing(mode=3, foot_force_n=np.array((10.0, 20, 30, 40))), OdometryFrame((0.0, 0.0, 0.0))
    )
    again = idl.SportModeState_.deserialize(state.serialize())
    assert (again.mode, list(again.foot_force), again.stamp.sec, again.stamp.nanosec) == (
        3, [10, 20, 30, 40], 1, 250_000_000,
    )  # fmt: skip


def test_crc_check_value() -> None:
    assert crc32_mpeg2(b"123456789") == 0x0376E6E7


@given(st.binary(max_size=300))
def test_crc_is_the_bitwise_one(data: bytes) -> None:
    assert crc32_mpeg2(data) == bitwise_crc(data)


@given(st.lists(st.integers(0, 2**32 - 1), max_size=40))
def test_words_are_fed_most_significant_bit_first(words: list[int]) -> None:
    little = b"".join(word.to_bytes(4, "little") for word in words)
    big = b"".join(word.to_bytes(4, "big") for word in words)
    assert crc_of_words(little) == bitwise_crc(big)


def test_low_state_layout_is_the_c_struct_less_its_crc() -> None:
    assert LOW_STATE_LAYOUT.size == 1180 - 4


def test_low_state_crc_depends_on_every_motor_and_survives_the_wire() -> None:
    low = LowStateMessage()
    low.update(standing(joint_q_rad=np.linspace(-1, 1, 12)), OdometryFrame((0.0, 0.0, 0.0)))
    received = idl_low.LowState_.deserialize(low.encode())
    assert low_state_crc(received) == received.crc
    seen = {received.crc}
    for motor in received.motor_state:
        motor.q += 0.5
        seen.add(low_state_crc(received))
    assert len(seen) == 21
