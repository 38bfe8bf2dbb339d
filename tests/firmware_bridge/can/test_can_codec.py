"""Signals, CRC and sent frames of the CAN backend, against cantools and CRCs computed bit by bit."""

from __future__ import annotations

import functools
import itertools
import math
import operator

import cantools
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_bridge.can.database import load_database
from firmware_bridge.can.protection import Crc
from firmware_bridge.can.sender import FrameSender
from firmware_bridge.core.config import load_robot_config
from tests.support.robot.dbc_base import CARTER, EXAMPLE, DbcBase, crc_bit_by_bit

CONFIGS = {path.stem: load_robot_config(path) for path in (CARTER, EXAMPLE)}
DATABASES = {name: load_database(config) for name, config in CONFIGS.items()}
FILES = {name: cantools.database.load_file(config.can.dbc_path) for name, config in CONFIGS.items() if config.can}
SIGNALS = [(name, place) for name, database in DATABASES.items() for place in database.signals]
each_signal = pytest.mark.parametrize(("robot", "place"), SIGNALS, ids=map("-".join, SIGNALS))
a_signal = st.sampled_from(SIGNALS)


@pytest.mark.slow
@each_signal
@given(data=st.binary(min_size=8, max_size=8))
def test_the_bits_of_a_signal_are_those_that_cantools_finds(robot: str, place: str, data: bytes) -> None:
    signal = DATABASES[robot].signals[place]
    message, data = FILES[robot].get_message_by_name(signal.message), data[: signal.length]
    raw = message.decode(data, decode_choices=False, scaling=False)[signal.name]
    assert signal.raw(data) == raw


@pytest.mark.slow
@settings(max_examples=400)
@given(chosen=a_signal, share=st.floats(0, 1))
def test_an_encoded_value_is_the_one_that_cantools_decodes(chosen: tuple[str, str], share: float) -> None:
    robot, place = chosen
    signal = DATABASES[robot].signals[place]
    value = signal.low + share * (signal.high - signal.low)
    order = "big" if signal.order == "big" else "little"
    data = signal.encode(value).to_bytes(signal.length, order)
    assert signal.decode(data) == pytest.approx(value, abs=abs(signal.scale) * 0.51)
    dbc = FILES[robot].get_message_by_name(signal.message).get_signal_by_name(signal.name)
    found = FILES[robot].get_message_by_name(signal.message).decode(data, decode_choices=False)[signal.name]
    factor = signal.scale / float(dbc.scale)  # of our unit to the file's
    assert found * factor == pytest.approx(value, abs=abs(signal.scale) * 0.51)


@pytest.mark.slow
@settings(max_examples=400)
@given(chosen=a_signal, value=st.floats(-1e6, 1e6))
def test_a_value_beyond_the_range_is_sent_as_its_end(chosen: tuple[str, str], value: float) -> None:
    robot, place = chosen
    signal = DATABASES[robot].signals[place]
    order = "big" if signal.order == "big" else "little"
    found = signal.decode(signal.encode(value).to_bytes(signal.length, order))
    assert found is not None and signal.low - 1e-9 <= found <= signal.high + 1e-9


@pytest.mark.parametrize(
    ("crc", "check"),
    [
        (Crc(8, 0x1D, 0xFF, 0xFF), 0x4B),  # SAE J1850
        (Crc(8, 0x2F, 0xFF, 0xFF), 0xDF),  # AUTOSAR 8H2F
        (Crc(8, 0x07, 0x00, 0x00), 0xF4),  # SMBus
        (Crc(8, 0x31, 0x00, 0x00, reflected=True), 0xA1),  # Maxim
        (Crc(16, 0x1021, 0xFFFF, 0x0000), 0x29B1),  # CCITT-FALSE, AUTOSAR
        (Crc(16, 0x8005, 0x0000, 0x0000, reflected=True), 0xBB3D),  # ARC
    ],
)
def test_a_crc_has_its_published_check_value(crc: Crc, check: int) -> None:
    assert crc.of(b"123456789") == check


@given(st.binary(max_size=12), st.integers(0, 255), st.integers(0, 255), st.integers(0, 255))
def test_a_crc_is_the_one_computed_bit_by_bit(data: bytes, polynomial: int, initial: int, final_xor: int) -> None:
    assert Crc(8, polynomial, initial, final_xor).of(data) == crc_bit_by_bit(data, polynomial, initial, final_xor)


@pytest.mark.parametrize(("polynomial", "flips"), [(0x1D, 2), (0x2F, 3)])
def test_every_error_of_so_few_flipped_bits_in_8_bytes_changes_the_crc(polynomial: int, flips: int) -> None:
    crc = Crc(8, polynomial, 0xFF, 0xFF)
    # Bits 0 to 55 are data; a flip of a bit of the CRC itself, 56 to 63, changes only that bit.
    changes = [crc.of((1 << bit).to_bytes(7, "little")) ^ crc.of(bytes(7)) for bit in range(56)]
    changes += [1 << bit for bit in range(8)]
    for count in range(1, flips + 1):
        assert all(functools.reduce(operator.xor, chosen) for chosen in itertools.combinations(changes, count))


@pytest.mark.slow
@pytest.mark.parametrize("robot", CONFIGS)
@given(commands=st.lists(st.tuples(st.floats(-0.4, 0.8), st.floats(-1, 1)), min_size=1, max_size=40))
def test_the_base_accepts_counter_and_crc_of_every_velocity(robot: str, commands: list[tuple[float, float]]) -> None:
    database, base = DATABASES[robot], DbcBase(CONFIGS[robot], 0)
    sender, name = FrameSender(database), database.signals["can.command.vx"].message
    for vx, wz in commands:
        frame = sender.make(name, {"can.command.vx": vx, "can.command.wz": wz})
        base.receive(frame.identifier, frame.data, 0)
    assert not base.wrong
    assert [pytest.approx(found, abs=0.001) for found in base.commands] == commands


def test_constants_of_the_robot_file_are_in_every_command() -> None:
    database = DATABASES["example_can"]
    frame = FrameSender(database).make("DriveCommand", {"can.command.vx": 0.5, "can.command.wz": math.pi / 180})
    found = FILES["example_can"].decode_message("DriveCommand", frame.data, decode_choices=False)
    assert (found["Gear"], found["Speed"], found["YawRate"], found["Alive"]) == (2, 500, pytest.approx(1.0), 0)
