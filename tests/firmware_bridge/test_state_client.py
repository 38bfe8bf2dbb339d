"""The robot's reports on their path from the bridge to the runner: the datagrams and the reader of the third socket."""

from __future__ import annotations

import math
import os
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge import peer as peer_module
from firmware_bridge.client_link import ClientLink
from firmware_bridge.core.config import OBSERVER_SUFFIX, RobotConfig, load_robot_config
from firmware_bridge.core.link import Arm, LinkError, Message, decode, encode
from firmware_bridge.core.robot_state import BatteryState, RobotState
from firmware_bridge.state_client import StateReader
from tests.support.processes import GO2_SIM

i32, i64 = st.integers(-(2**31), 2**31 - 1), st.integers(-(2**63), 2**63 - 1)
f64 = st.floats(allow_nan=False)
states = st.builds(
    RobotState, i64, st.tuples(f64, f64, f64), f64, f64, f64, i64, i64, i64, f64, f64, f64, f64,
    st.tuples(i32, i32, i32, i32),
)  # fmt: skip
batteries = st.builds(BatteryState, i64, i64, f64, f64)
reports = st.one_of(states, batteries)
STATE = RobotState(1, (1.0, 2.0, 0.5), 0.4, 0.0, 0.1, 3, 0, 7, 0.3, 0.0, 0.0, 0.1, (1, 2, 3, 4))
BATTERY = BatteryState(1, 80, 29.5, -3.0)


@given(reports)
def test_a_report_survives_encoding_and_decoding(report: Message) -> None:
    assert decode(encode(report)) == report


@given(reports, st.data())
def test_a_cut_or_extended_report_is_a_link_error(report: Message, data: st.DataObject) -> None:
    good = encode(report)
    with pytest.raises(LinkError):
        decode(good[: data.draw(st.integers(0, len(good) - 1))])
    with pytest.raises(LinkError):
        decode(good + data.draw(st.binary(min_size=1, max_size=64)))


@given(st.sampled_from([6, 7]), st.binary(max_size=400))
def test_a_body_of_another_length_is_a_link_error(kind: int, body: bytes) -> None:
    expected = len(encode(STATE if kind == 6 else BATTERY)) - 8
    if len(body) != expected:
        with pytest.raises(LinkError):
            decode(struct.pack("<4sBBH", b"TVEB", 3, kind, len(body)) + body)


@pytest.fixture
def robot(tmp_path: Path) -> RobotConfig:
    return load_robot_config(GO2_SIM, socket=tmp_path / "bridge.sock")


def observers(robot: RobotConfig) -> ClientLink:
    return ClientLink(Path(f"{robot.bridge.socket}{OBSERVER_SUFFIX}"), places=4)


@pytest.fixture
def link(robot: RobotConfig) -> Iterator[ClientLink]:
    with closing(observers(robot)) as link:
        yield link


@pytest.fixture
def reader(robot: RobotConfig) -> Iterator[StateReader]:
    with closing(StateReader(robot)) as reader:
        yield reader


def until(condition: Callable[[], object], link: ClientLink | None = None, limit_s: float = 5.0) -> None:
    deadline = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < deadline, "not within the time limit"
        if link is not None:
            link.receive()
        time.sleep(0.005)


def connect(link: ClientLink) -> None:
    until(lambda: link.connected, link)


def test_states_reach_the_listener_in_order_and_the_newest_is_kept(link: ClientLink, reader: StateReader) -> None:
    taken: list[int] = []
    reader.set_state_listener(lambda state: taken.append(state.received_ns))
    connect(link)
    for number in (1, 2, 3):
        link.send(replace(STATE, received_ns=number))
    until(lambda: len(taken) == 3)
    assert taken == [1, 2, 3] and reader.state() == replace(STATE, received_ns=3)


def test_the_newest_battery_is_kept(link: ClientLink, reader: StateReader) -> None:
    assert reader.battery() is None
    connect(link)
    link.send(BATTERY)
    until(reader.battery)
    assert reader.battery() == BATTERY


def test_a_state_that_is_not_newer_is_counted_and_dropped(link: ClientLink, reader: StateReader) -> None:
    connect(link)
    for number in (5, 5, 4, 6):
        link.send(replace(STATE, received_ns=number))
    until(lambda: (state := reader.state()) is not None and state.received_ns == 6)
    assert reader.reordered == 2


@pytest.mark.parametrize("bad", [{"vx_mps": math.nan}, {"T_odom_base": (0.0, math.inf, 0.0)}, {"pitch_rad": -1e300}])
def test_a_state_with_an_impossible_number_is_counted_and_dropped(
    link: ClientLink, reader: StateReader, bad: dict[str, float]
) -> None:
    connect(link)
    link.send(replace(STATE, **bad))  # type: ignore[arg-type]
    until(lambda: reader.malformed == 1)
    assert reader.state() is None


def test_an_impossible_battery_is_not_a_fault_of_the_odometry(link: ClientLink, reader: StateReader) -> None:
    connect(link)
    link.send(replace(BATTERY, voltage_v=math.nan))
    until(lambda: reader.malformed_battery == 1)
    assert reader.battery() is None and reader.malformed == 0


def test_messages_of_another_kind_are_counted_and_dropped(link: ClientLink, reader: StateReader) -> None:
    connect(link)
    link.send(Arm())
    until(lambda: reader.malformed == 1)


def test_a_bridge_that_restarts_is_found_again(robot: RobotConfig, reader: StateReader) -> None:
    for number in (1, 2):
        with closing(observers(robot)) as link:
            connect(link)
            link.send(replace(STATE, received_ns=number))
            until(lambda number=number: (state := reader.state()) is not None and state.received_ns == number)
        until(lambda: reader.link_error != "")


def test_without_a_bridge_the_reader_waits_and_says_why(robot: RobotConfig) -> None:
    deaths: list[str] = []
    with closing(StateReader(robot, on_death=deaths.append)) as reader:
        until(lambda: "no bridge listens" in reader.link_error)
        assert reader.state() is None
    assert deaths == []


def test_a_listener_of_another_user_is_not_believed(
    robot: RobotConfig, link: ClientLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(peer_module, "peer_uid", lambda _: os.getuid() + 1)
    with closing(StateReader(robot)) as reader:
        until(lambda: "not to a bridge of this user's" in reader.link_error, link)


def test_a_listener_function_that_raises_ends_the_thread_with_its_reason(robot: RobotConfig, link: ClientLink) -> None:
    deaths: list[str] = []

    def fail(_state: RobotState) -> None:
        raise RuntimeError("broken")

    with closing(StateReader(robot, on_death=deaths.append)) as reader:
        reader.set_state_listener(fail)
        connect(link)
        link.send(STATE)
        until(lambda: deaths)
    assert deaths == ["robot state thread died: RuntimeError: broken"]
