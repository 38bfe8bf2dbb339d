"""Datagrams between runner and bridge."""

from __future__ import annotations

import contextlib
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge.core.link import (
    CAUSES,
    MAX_DATAGRAM_BYTES,
    MAX_REASON_BYTES,
    MOTIONS,
    PERMITS,
    STATES,
    VERSION,
    Arm,
    BridgeStatus,
    LinkError,
    Message,
    Release,
    Stop,
    Velocity,
    decode,
    encode,
)
from firmware_bridge.core.robot_state import BatteryState, RobotState

i64 = st.integers(-(2**63), 2**63 - 1)
u64 = st.integers(0, 2**64 - 1)
f64 = st.floats(allow_nan=False)
velocities = st.builds(Velocity, u64, i64, f64, f64, f64)
reasons = st.text(max_size=90)
statuses = st.builds(
    BridgeStatus, i64, st.sampled_from(STATES), reasons, u64, u64, u64, st.tuples(f64, f64, f64), st.booleans(),
    st.sampled_from(CAUSES), st.sampled_from(CAUSES), st.sampled_from(PERMITS), st.sampled_from(MOTIONS), f64, u64,
)  # fmt: skip
i32 = st.integers(-(2**31), 2**31 - 1)
states = st.builds(
    RobotState, i64, st.tuples(f64, f64, f64), f64, f64, f64, i64, i64, i64, f64, f64, f64, st.none() | f64,
    st.tuples(i32, i32, i32, i32),
)  # fmt: skip
messages = st.one_of(st.just(Arm()), st.just(Stop()), st.just(Release()), velocities, statuses, states)


@given(messages)
def test_decoding_is_the_inverse_of_encoding(message: Message) -> None:
    assert decode(encode(message)) == message


def test_a_status_without_a_robot_names_none() -> None:
    assert BridgeStatus(1, "armed", "", 0, 0, 0, (0.0, 0.0, 0.0), zero_after_stop=False).robot == 0


@given(statuses, st.text(min_size=300, max_size=600))
def test_a_long_reason_is_cut_and_still_decodes(status: BridgeStatus, reason: str) -> None:
    data = encode(BridgeStatus(**{**status.__dict__, "reason": reason}))
    decoded = decode(data)
    assert len(data) <= MAX_DATAGRAM_BYTES
    assert isinstance(decoded, BridgeStatus) and reason.startswith(decoded.reason)


@given(st.binary(max_size=600))
def test_foreign_bytes_raise_link_error_and_nothing_else(data: bytes) -> None:
    with contextlib.suppress(LinkError):
        decode(data)


@given(messages, st.data())
def test_a_changed_header_or_length_never_decodes_to_another_kind_of_message(message: Message, data) -> None:
    good = encode(message)
    cut = data.draw(st.integers(0, len(good) - 1))
    with pytest.raises(LinkError):
        decode(good[:cut])
    with pytest.raises(LinkError):
        decode(good + b"\0")
    with pytest.raises(LinkError):
        decode(b"XXXX" + good[4:])


@pytest.mark.parametrize("version", [0, 1, 2, 255])
def test_another_version_is_refused(version: int) -> None:
    with pytest.raises(LinkError, match="version"):
        decode(struct.pack("<4sBBH", b"TVEB", version, 1, 0))


@pytest.mark.parametrize("kind", [0, 6, 255])
def test_an_unknown_kind_is_refused(kind: int) -> None:
    with pytest.raises(LinkError, match="kind"):
        decode(struct.pack("<4sBBH", b"TVEB", VERSION, kind, 0))


@pytest.mark.parametrize("offset", [8, 9, 10, 11, 12, 13])
def test_a_status_with_an_unknown_state_flag_cause_permit_or_motion_is_refused(offset: int) -> None:
    good = bytearray(encode(BridgeStatus(1, "armed", "", 0, 0, 0, (0.0, 0.0, 0.0), False)))
    good[8 + offset] = 200  # header of 8 bytes, then the stamp
    with pytest.raises(LinkError, match="200"):
        decode(bytes(good))


@pytest.mark.parametrize(("offset", "count"), [(8, len(STATES)), (9, 2), (10, len(CAUSES)), (12, len(PERMITS))])
def test_the_first_value_behind_a_table_is_refused_and_the_last_one_in_it_is_not(offset: int, count: int) -> None:
    good = bytearray(encode(BridgeStatus(1, "armed", "", 0, 0, 0, (0.0, 0.0, 0.0), False)))
    for behind in (offset, offset + 1) if offset in (10, 12) else (offset,):  # the causes and the robot are pairs
        data = good.copy()
        data[8 + behind] = count - 1
        assert isinstance(decode(bytes(data)), BridgeStatus)
        data[8 + behind] = count
        with pytest.raises(LinkError):
            decode(bytes(data))


@given(st.integers(0, 9), st.sampled_from([0, 16, 40, 64, 86, 100, 152, 160, 300]), st.integers(-9, 9))
def test_any_kind_with_a_body_of_any_length_is_a_message_or_a_link_error(kind: int, length: int, more: int) -> None:
    body = bytes(max(length + more, 0))
    with contextlib.suppress(LinkError):
        assert encode(decode(struct.pack("<4sBBH", b"TVEB", VERSION, kind, len(body)) + body))[5] == kind


def test_kinds_layout_and_size_are_those_of_version_5() -> None:
    zero = (0.0, 0.0, 0.0)
    state = RobotState(1, zero, 0.0, 0.0, 0.0, 2, 3, 4, 0.0, 0.0, 0.0, 0.0, (5, 6, 7, 8))
    status = BridgeStatus(9, "stopped", "why", 1, 2, 3, zero, True, "client_stop", "estop", "given", "moving", 0.5)
    heads = [encode(message)[:8].hex() for message in (Arm(), Stop(), Velocity(1, 2, 0, 0, 0), status, Release())]
    heads += [encode(message)[:8].hex() for message in (state, BatteryState(1, 80, 29.0, 1.0))]
    assert heads == [
        *("5456454205010000", "5456454205020000", "5456454205032800", "5456454205045100"),
        *("5456454205050000", "5456454205068000", "5456454205072000"),
    ]
    assert encode(Velocity(1, 2, 0.5, 0.0, 0.0))[8:] == struct.pack("<Qq3d", 1, 2, 0.5, 0, 0)
    assert encode(status)[8:22] == struct.pack("<q6B", 9, 3, 1, 1, 6, 2, 2)
    assert (MAX_DATAGRAM_BYTES, MAX_REASON_BYTES) == (512, 400)


def test_a_stop_of_another_version_is_a_stop() -> None:
    stop = bytearray(encode(Stop()))
    for version in range(256):
        stop[4] = version
        assert decode(bytes(stop)) == Stop()


def test_a_cause_keeps_its_number_within_a_version() -> None:
    assert (
        *("none", "client_stop", "client_lost", "deadman", "shutdown", "suspended", "estop", "remote_takeover"),
        *("second_commander", "second_publisher", "link_down", "state_silent", "wrong_mode", "robot_error", "tipped"),
        *("robot_moving", "not_standing", "battery_low", "wrong_robot", "operator", "unsafe_robot"),
    ) == CAUSES
    assert STATES == ("disarmed", "arming", "armed", "stopped")
    assert (PERMITS, MOTIONS) == (("not needed", "needed", "given"), ("unknown", "still", "moving"))


def test_a_status_without_a_report_of_the_robot_says_so() -> None:
    status = BridgeStatus(1, "armed", "", 0, 0, 0, (0.0, 0.0, 0.0), False)
    assert (status.motion, status.speed_mps, status.blocked_by, status.cause) == ("unknown", -1.0, "none", "none")


@pytest.mark.parametrize("reason", [b"\xff", b"caf\xc3", b"\xed\xa0\x80"])
def test_a_reason_that_is_not_utf_8_is_refused(reason: bytes) -> None:
    good = encode(BridgeStatus(1, "armed", "", 0, 0, 0, (0.0, 0.0, 0.0), False))
    framed = struct.pack("<4sBBH", b"TVEB", VERSION, 4, len(good) - 8 + len(reason)) + good[8:] + reason
    with pytest.raises(LinkError, match="reason is not UTF-8"):
        decode(framed)


def test_numbers_that_are_not_finite_pass_the_codec_because_the_gate_judges_them() -> None:
    decoded = decode(encode(Velocity(1, 2, float("nan"), float("inf"), 0.0)))
    assert isinstance(decoded, Velocity) and decoded.vx_mps != decoded.vx_mps
