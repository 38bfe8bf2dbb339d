"""MAVLink packets, signatures, setpoints and parameters: what is taken and what is counted and left out."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from sim_hil.protocols.mavlink.parameters import NAMES, TABLE, Parameters, decode_value
from sim_hil.protocols.mavlink.setpoints import SetpointError, override_sticks, read_setpoint
from sim_hil.protocols.mavlink.wire import TICKS_PER_S, Reader, Verifier, Writer

KEY = bytes(range(32))
NOW = 10**13
BODY = common.MAV_FRAME_BODY_NED
RATE_MASK, YAW_MASK, NEITHER_MASK = 1479, 2503, 3527


def ping(number: int = 1) -> common.MAVLink_message:
    return common.MAVLink_ping_message(12345, number, 1, 1)


def setpoint(frame: int = BODY, mask: int = RATE_MASK, **values: float) -> common.MAVLink_message:
    numbers = {"vx": 0.5, "vy": 0.25, "yaw": 1.0, "yaw_rate": 0.5, **values}
    return common.MAVLink_set_position_target_local_ned_message(
        0, 1, 1, frame, mask, 0, 0, 0, numbers["vx"], numbers["vy"], 0, 0, 0, 0, numbers["yaw"], numbers["yaw_rate"]
    )


@given(st.lists(st.integers(0, 2**32 - 1), min_size=1, max_size=4))
def test_every_message_of_a_datagram_is_read(numbers: list[int]) -> None:
    writer, reader = Writer(255, 190), Reader()
    data = b"".join(writer.pack(ping(number)) for number in numbers)
    assert [message.seq for message in reader.read(data)] == numbers
    assert reader.counts.malformed == 0


@pytest.mark.slow
@settings(max_examples=200)
@given(st.binary(min_size=1, max_size=300))
def test_any_bytes_are_harmless(data: bytes) -> None:
    reader = Reader()
    assert reader.read(data) == [] or reader.counts.broken == 0
    assert reader.counts.broken + reader.counts.unknown >= (data[0] not in (0xFE, 0xFD))


@given(st.data())
def test_a_packet_that_is_cut_off_or_has_a_wrong_bit_is_counted_and_left_out(data: st.DataObject) -> None:
    packet = bytearray(Writer(255, 190).pack(ping()))
    if data.draw(st.booleans()):
        packet = packet[: data.draw(st.integers(1, len(packet) - 1))]
    else:
        # A flag of "compatible" features may be set, but the checksum covers it too.
        packet[data.draw(st.integers(0, len(packet) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    reader = Reader()
    assert reader.read(bytes(packet)) == []
    assert reader.counts.broken + reader.counts.unknown >= 1


def test_a_packet_of_version_1_is_understood() -> None:
    packer = common.MAVLink(None, srcSystem=9, srcComponent=1)
    (message,) = Reader().read(ping(7).pack(packer, force_mavlink1=True))
    assert message.seq == 7 and message.get_srcSystem() == 9


def test_a_message_of_another_dialect_is_no_error() -> None:
    reader, payload = Reader(), b"\x01\x02\x03"
    assert reader.read(bytes((0xFD, 3, 0, 0, 0, 255, 190, 0xFF, 0xFF, 0x7F)) + payload + b"\0\0") == []
    assert reader.counts.unknown == 1 and reader.counts.malformed == 0


def signed(number: int, ticks: int, key: bytes = KEY) -> bytes:
    return Writer(255, 190, key, ticks).pack(ping(number))


def test_with_a_key_only_packets_that_carry_its_signature_are_read() -> None:
    reader = Reader(Verifier(KEY, NOW))
    assert [message.seq for message in reader.read(signed(1, NOW))] == [1]
    assert reader.read(Writer(255, 190).pack(ping(2))) == []
    assert reader.read(signed(3, NOW + 5, bytes(32))) == []
    assert reader.counts.unsigned == 2


def test_a_packet_that_is_sent_once_more_is_not_read_again() -> None:
    reader, packet = Reader(Verifier(KEY, NOW)), signed(1, NOW)
    assert len(reader.read(packet)) == 1 and reader.read(packet) == []


def test_a_forged_packet_from_the_future_does_not_make_genuine_ones_old() -> None:
    reader = Reader(Verifier(KEY, NOW))
    assert reader.read(signed(1, NOW + 10**10, bytes(32))) == []
    assert len(reader.read(signed(2, NOW))) == 1


def test_a_new_stream_may_be_a_minute_behind_and_not_more() -> None:
    assert len(Reader(Verifier(KEY, NOW)).read(signed(1, NOW - 59 * TICKS_PER_S))) == 1
    assert Reader(Verifier(KEY, NOW)).read(signed(1, NOW - 61 * TICKS_PER_S)) == []


def test_a_body_velocity_turns_to_the_right_for_a_positive_rate() -> None:
    assert read_setpoint(setpoint()).command(0.0) == (0.5, -0.5)


def test_a_local_velocity_with_a_yaw_turns_towards_it() -> None:
    ahead, left = read_setpoint(setpoint(1, YAW_MASK, vy=0.0, yaw=-1.0)).command(0.0)
    assert ahead == pytest.approx(0.5) and left > 0.5


def test_a_local_velocity_alone_turns_to_where_it_points() -> None:
    _, left = read_setpoint(setpoint(1, NEITHER_MASK, vx=0.0, vy=-0.5)).command(0.0)
    assert left > 1.0


@pytest.mark.parametrize(
    ("frame", "mask"),
    [(0, RATE_MASK), (BODY, RATE_MASK | 8), (BODY, RATE_MASK & ~1), (BODY, RATE_MASK & ~64), (BODY, RATE_MASK | 512)],
)
def test_anything_but_a_velocity_is_refused(frame: int, mask: int) -> None:
    with pytest.raises(SetpointError):
        read_setpoint(setpoint(frame, mask))


@pytest.mark.parametrize("field", ["vx", "vy", "yaw_rate"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_not_finite_is_refused(field: str, value: float) -> None:
    with pytest.raises(SetpointError):
        read_setpoint(setpoint(**{field: value}))


@given(st.integers(0, 65535), st.integers(0, 65535))
def test_sticks_stay_within_their_range_for_all_channel_values(steering: int, throttle: int) -> None:
    sticks = override_sticks(common.MAVLink_rc_channels_override_message(1, 1, steering, 0, throttle, 0, 0, 0, 0, 0))
    assert sticks is None or (-1 <= sticks.ahead <= 1 and -1 <= sticks.right <= 1)


@pytest.mark.parametrize("name", NAMES)
def test_decoding_a_parameter_is_the_inverse_of_encoding(name: str) -> None:
    message = Parameters().message(name)
    assert decode_value(message.param_value, message.param_type) == pytest.approx(TABLE[name].default)
    assert message.param_count == len(NAMES) and NAMES[message.param_index] == message.param_id == name


def param_set(name: str, value: float, kind: int = common.MAV_PARAM_TYPE_REAL32) -> common.MAVLink_message:
    return common.MAVLink_param_set_message(1, 1, name.encode(), value, kind)


def test_an_integer_is_set_bytewise() -> None:
    parameters = Parameters()
    (value,) = struct.unpack("<f", struct.pack("<i", 254))
    assert parameters.set(param_set("MAV_GCS_SYSID", value, common.MAV_PARAM_TYPE_INT32)) == "MAV_GCS_SYSID"
    assert parameters["MAV_GCS_SYSID"] == 254


@pytest.mark.parametrize(
    ("name", "value"),
    [("COM_OF_LOSS_T", 5.0), ("COM_OF_LOSS_T", math.nan), ("MAV_SYS_ID", 7.0), ("MAV_GCS_SYSID", 3.0)],
)
def test_a_value_out_of_range_or_of_another_type_changes_nothing(name: str, value: float) -> None:
    parameters = Parameters()
    assert parameters.set(param_set(name, value)) == name
    assert parameters[name] == TABLE[name].default
    assert parameters.set(param_set("NO_SUCH_ONE", 1.0)) is None


def test_a_reader_that_starts_an_hour_later_accepts_a_writer_whose_clock_was_advanced() -> None:
    key, hour_ticks = bytes(range(32)), 3600 * 100_000
    writer, late = Writer(1, 1, key, 10**12), Reader(Verifier(key, 10**12 + hour_ticks))
    heartbeat = common.MAVLink_heartbeat_message(10, 12, 0, 0, 4, 3)
    assert late.read(writer.pack(heartbeat)) == []
    writer.advance(10**12 + hour_ticks)
    assert len(late.read(writer.pack(heartbeat))) == 1
