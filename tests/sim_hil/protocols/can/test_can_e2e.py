"""Counter and CRC of the base's frames: valid frames pass, invalid ones get their verdict."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge.can.frame import Frame
from firmware_bridge.can.protection import Checker, Verdict
from sim_hil.protocols.can import frames
from sim_hil.protocols.can.frames import COUNTER_PERIOD, MAX_AHEAD, PROTECTION, Decoder, Encoder

MESSAGES = frames.database().messages
names = st.sampled_from([message.name for message in MESSAGES])


@st.composite
def messages_with_values(draw: st.DrawFn) -> tuple[str, dict[str, float]]:
    """A message of the file with values that its signals can hold exactly."""
    message = draw(st.sampled_from(MESSAGES))
    values = {}
    for signal in message.signals:
        if signal.name not in ("Crc", "Counter"):
            scale = float(signal.scale)
            low, high = round(float(signal.minimum) / scale), round(float(signal.maximum) / scale)
            values[signal.name] = draw(st.integers(low, high)) * scale
    return message.name, values


def velocity(counter: int, vx: int = 500) -> Frame:
    """A VelocityCommand as its sender makes it."""
    data = bytes((0, 0)) + vx.to_bytes(2, "little", signed=True) + bytes(2)
    return Frame(272, PROTECTION.protect(272, data, counter))


def test_the_crc_of_the_standard_text_is_the_published_one() -> None:
    assert PROTECTION.crc.of(b"123456789") == 0x4B


def plain_crc(data: bytes) -> int:
    """CRC-8 SAE J1850, bit by bit: an independent computation."""
    crc = 0xFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x1D) & 0xFF if crc & 0x80 else crc << 1
    return crc ^ 0xFF


@given(st.integers(0, 0x7FF), st.binary(min_size=2, max_size=8), st.integers(0, COUNTER_PERIOD - 1))
def test_protected_frames_have_the_crc_that_the_dbc_file_describes(identifier: int, data: bytes, counter: int) -> None:
    found = PROTECTION.protect(identifier, data, counter)
    assert found[1] & 0x0F == counter and found[1] & 0xF0 == data[1] & 0xF0 and found[2:] == data[2:]
    assert found[0] == plain_crc(bytes((identifier & 0xFF, identifier >> 8)) + found[1:])


def test_a_velocity_command_has_these_bytes_on_the_bus() -> None:
    # 0.5 m/s is 500 mm/s, 0x01F4, lowest byte first; -0.25 rad/s is -250, 0xFF06. The CRC was computed bit by bit.
    frame = Encoder().encode("VelocityCommand", Vx=0.5, Wz=-0.25)
    assert frame == Frame(0x110, bytes.fromhex("8b00f40106ff"))


@given(messages_with_values())
def test_decoding_is_the_inverse_of_encoding(message: tuple[str, dict[str, float]]) -> None:
    name, values = message
    node = frames.database().get_message_by_name(name).senders[0]
    encoder, decoder = Encoder(), Decoder(node)
    decoder.decode(encoder.encode(name, **values))
    received = decoder.decode(encoder.encode(name, **values))
    assert received is not None and received.good and received.name == name
    assert {key: received.signals[key] for key in values} == pytest.approx(values, abs=1e-9)


@given(messages_with_values(), st.data())
def test_one_or_two_flipped_bits_never_pass(message: tuple[str, dict[str, float]], choice: st.DataObject) -> None:
    # Three can: this polynomial has a Hamming distance of 3 at these lengths.
    name, values = message
    frame = Encoder().encode(name, **values)
    data = bytearray(frame.data)
    for bit in choice.draw(st.sets(st.integers(0, 8 * len(data) - 1), min_size=1, max_size=2)):
        data[bit // 8] ^= 1 << bit % 8
    checker = Checker(len(data), PROTECTION)
    assert checker.check(Frame(frame.identifier, bytes(data))) is Verdict.WRONG_CRC


@given(names, names)
def test_a_frame_under_another_identifier_is_wrong(name: str, other: str) -> None:
    data = PROTECTION.protect(frames.database().get_message_by_name(name).frame_id, bytes(8), 3)
    identifier = frames.database().get_message_by_name(other).frame_id
    assert (Checker(8, PROTECTION).check(Frame(identifier, data)) is Verdict.WRONG_CRC) == (name != other)


def test_a_frame_of_another_length_is_wrong() -> None:
    data = bytes((0, 5, 1, 2, 3))
    data = bytes((PROTECTION.crc_of(272, data),)) + data[1:]
    assert Checker(6, PROTECTION).check(Frame(272, data)) is Verdict.WRONG_LENGTH


def test_a_repeated_frame_is_distinguished_from_a_new_one() -> None:
    checker = Checker(6, PROTECTION)
    assert [checker.check(velocity(n)) for n in (0, 1, 1, 1, 2)] == [
        Verdict.FIRST, Verdict.GOOD, Verdict.REPEATED, Verdict.REPEATED, Verdict.GOOD,
    ]  # fmt: skip


@given(st.integers(0, COUNTER_PERIOD - 1), st.integers(0, MAX_AHEAD - 1))
def test_lost_frames_are_counted_by_the_gap_in_the_counter(start: int, lost: int) -> None:
    checker = Checker(6, PROTECTION)
    checker.check(velocity(start))
    checker.check(velocity((start + 1) % COUNTER_PERIOD))
    assert checker.check(velocity((start + 2 + lost) % COUNTER_PERIOD)) is Verdict.GOOD
    assert checker.newly_lost == lost


@given(st.integers(0, COUNTER_PERIOD - 1), st.integers(1, COUNTER_PERIOD - MAX_AHEAD - 1))
def test_a_late_old_frame_is_not_obeyed_and_the_stream_continues(start: int, back: int) -> None:
    checker = Checker(6, PROTECTION)
    for step in range(3):
        checker.check(velocity((start + step) % COUNTER_PERIOD))
    assert checker.check(velocity((start + 2 - back) % COUNTER_PERIOD)) is Verdict.OUT_OF_ORDER
    following = [checker.check(velocity((start + 3 + step) % COUNTER_PERIOD)) for step in range(3)]
    assert following[-1] is Verdict.GOOD


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_a_velocity_beyond_the_range_is_sent_as_the_end_of_the_range(vx: float) -> None:
    encoder, decoder = Encoder(), Decoder("Controller")
    for _ in range(2):
        received = decoder.decode(encoder.encode("VelocityCommand", Vx=vx, Wz=0.0))
    assert received is not None
    assert received.signals["Vx"] == pytest.approx(max(-32.768, min(32.767, vx)), abs=0.00051)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_velocity_that_is_no_number_is_not_sent(value: float) -> None:
    with pytest.raises(ValueError, match="finite"):
        Encoder().encode("VelocityCommand", Vx=value, Wz=0.0)


def test_a_missing_or_unknown_signal_is_refused() -> None:
    with pytest.raises(ValueError, match="expected signals"):
        Encoder().encode("VelocityCommand", Vx=0.0)
    with pytest.raises(ValueError, match="expected signals"):
        Encoder().encode("ModeCommand", Request=1, Speed=2)


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
def test_any_frame_at_all_is_judged_without_an_error(identifier: int, data: bytes) -> None:
    received = Decoder("Controller").decode(Frame(identifier, data))
    assert received is None or not received.good


def test_every_message_has_its_crc_and_counter_where_the_protection_expects_them() -> None:
    for message in MESSAGES:
        crc, counter = message.get_signal_by_name("Crc"), message.get_signal_by_name("Counter")
        assert (crc.start, crc.length) == (0, 8)
        assert (counter.start, counter.length) == (8, 4)
        assert 2 <= message.length <= 8 and not message.is_extended_frame


def test_the_emergency_stop_has_the_highest_priority() -> None:
    assert min(MESSAGES, key=lambda message: message.frame_id).name == "EstopControl"
