"""The link on a real serial line: lost, reopened, disturbed, full."""

from __future__ import annotations

import contextlib
import os
import socket
import struct
import termios
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import can
import pytest

from firmware_bridge.can.buses import BusAddress, BusError, FrameBus, open_bus
from firmware_bridge.can.frame import Frame
from firmware_bridge.can.multicast import PORT
from firmware_bridge.can.robot_link import RobotLink
from firmware_bridge.can.serial_line import SerialLine
from firmware_bridge.can.table import missing_link
from firmware_bridge.core.config import RobotConfig, load_robot_config
from firmware_bridge.core.step_types import Move, Report
from sim_hil.protocols.can.pty_line import PtyLine
from tests.support.processes import wait_for
from tests.support.robot.dbc_base import CARTER, DbcBase


@pytest.fixture
def line(tmp_path: Path) -> Iterator[PtyLine]:
    line = PtyLine(tmp_path / "can")
    yield line
    line.close()


def settings_of(channel: Path) -> RobotConfig:
    config = load_robot_config(CARTER)
    assert config.can is not None
    return replace(config, can=replace(config.can, channel=str(channel)))


class Base:
    """A base at the near end of the line, in real time."""

    def __init__(self, config: RobotConfig, near: str) -> None:
        self._bus = SerialLine(near)
        self._base = DbcBase(config, time.monotonic_ns())

    def report(self) -> None:
        for identifier, data in self._base.due(time.monotonic_ns()):
            self._bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False), timeout=0.0)

    def close(self) -> None:
        self._bus.shutdown()


def read_until_state(link: RobotLink, base: Base) -> Report:
    found: list[Report] = []

    def state() -> bool:
        base.report()
        found.append(link.read(time.monotonic_ns()))
        return found[-1].state is not None

    wait_for(state, 5, "a state")
    return found[-1]


def test_a_lost_line_is_reported_and_opened_again_when_it_is_back(line: PtyLine, tmp_path: Path) -> None:
    config, lines = settings_of(line.far), list[str]()
    link, base = RobotLink(config, lines.append), Base(config, line.near)
    assert read_until_state(link, base).writes_fail is False
    base.close()
    line.close()
    wait_for(lambda: link.read(time.monotonic_ns()).writes_fail, 5, "the loss")
    assert "connection lost" in lines[-1]
    link.write(Move(0.1, 0.0, 0.0))
    assert link.dropped()[2] >= 1
    again = PtyLine(tmp_path / "can")
    base = Base(config, again.near)
    report = read_until_state(link, base)
    assert lines[-1] == f"CAN bus serial:{line.far} is open again" and report.writes_fail is False
    link.close()
    base.close()
    again.close()


def test_random_bytes_on_the_line_are_counted_and_the_next_frames_read(line: PtyLine) -> None:
    config = settings_of(line.far)
    link, base = RobotLink(config, lambda _: None), Base(config, line.near)
    read_until_state(link, base)
    before = link.dropped()[0]
    noise = os.open(line.near, os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK)
    os.write(noise, b"\xaa\xff\xaa" * 40)
    os.close(noise)
    time.sleep(0.1)
    assert read_until_state(link, base).state is not None
    assert link.dropped()[0] > before
    link.close()
    base.close()


def test_a_line_that_takes_no_bytes_refuses_frames_without_waiting(tmp_path: Path) -> None:
    near, far = os.openpty()
    link = RobotLink(settings_of(Path(os.ttyname(far))), lambda _: None)
    begin_s = time.perf_counter()
    for _ in range(2000):  # 20 bytes each: far above the kernel's buffer
        link.write(Move(0.1, 0.0, 0.1))
    assert time.perf_counter() - begin_s < 5.0
    assert link.dropped()[2] > 500 and link.read(time.monotonic_ns()).writes_fail
    link.close()
    os.close(near)
    os.close(far)


@pytest.mark.parametrize(("waiting", "after_ms", "taken"), [(512, 60_000, True), (1280, 39, True), (1280, 40, False)])
def test_a_line_that_is_behind_for_40_ms_takes_no_more_frames(
    line: PtyLine, monkeypatch: pytest.MonkeyPatch, waiting: int, after_ms: int, taken: bool
) -> None:
    now_ms, bus = [0], SerialLine(str(line.far))
    clock = SimpleNamespace(monotonic_ns=lambda: now_ms[0] * 1_000_000)
    monkeypatch.setattr("firmware_bridge.can.serial_line.time", clock)
    frame = can.Message(arbitration_id=1, data=b"12", is_extended_id=False)
    bus.send(frame)
    monkeypatch.setattr(type(bus._ser), "out_waiting", waiting)
    now_ms[0] = after_ms
    with contextlib.nullcontext() if taken else pytest.raises(can.CanOperationError, match="takes no bytes"):
        bus.send(frame)
    bus.shutdown()


def test_a_line_that_is_not_there_is_named_and_not_opened(tmp_path: Path) -> None:
    config = settings_of(tmp_path / "none")
    assert missing_link(config) == f"waiting for the serial line {tmp_path}/none"
    with pytest.raises(BusError, match="cannot be opened"):
        RobotLink(config, lambda _: None)


def test_an_interface_that_is_down_is_named() -> None:
    config = load_robot_config(CARTER)
    assert config.can is not None
    down = replace(config, can=replace(config.can, interface="socketcan", channel="can7"))
    assert "waiting for CAN interface 'can7' to be up (interfaces: " in str(missing_link(down))


class Echoing:
    """A bus that also receives what it sends."""

    channel_info = "echo"

    def __init__(self) -> None:
        self.waiting: list[can.Message] = []

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        self.waiting.append(message)

    def _recv_internal(self, timeout: float) -> tuple[can.Message | None, bool]:
        return (self.waiting.pop(0) if self.waiting else None), False


def test_invalid_datagrams_do_not_delay_the_frame_behind_them() -> None:
    address = BusAddress("udp_multicast", "239.74.163.77")
    ours, base = (FrameBus(open_bus(address), echoes=True) for _ in range(2))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        loopback = struct.pack("@4s4si", bytes(4), bytes(4), socket.if_nametoindex("lo"))
        other.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, loopback)
        for _ in range(20):
            other.sendto(b"x", (address.channel, PORT))
    base.send(Frame(0x1B1, b"\x90"))
    try:
        assert ours.receive(64) == [Frame(0x1B1, b"\x90")] and ours.line_errors == 20
    finally:
        ours.close()
        base.close()


def test_a_frame_that_comes_back_from_our_own_bus_is_not_another_controllers() -> None:
    echo = Echoing()
    bus = FrameBus(echo, echoes=True)  # type: ignore[arg-type]
    link_frame = can.Message(arbitration_id=272, data=b"abcdef", is_extended_id=False)
    assert bus.send(Frame(272, b"abcdef"))
    assert bus.receive(10) == []
    echo.waiting.append(link_frame)  # the same bytes once more: somebody else sent them
    assert bus.receive(10) == [Frame(272, b"abcdef")]


def test_reading_the_bus_does_not_depend_on_the_wall_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    bus = FrameBus(can.Bus(interface="virtual", channel="wall-clock"), echoes=False)
    sender = can.Bus(interface="virtual", channel="wall-clock")
    sender.send(can.Message(arbitration_id=272, data=b"abc", is_extended_id=False))
    monkeypatch.setattr("can.bus.time", lambda: pytest.fail("the wall clock was read"))
    assert bus.receive(10) == [Frame(272, b"abc")]
    bus.close()
    sender.shutdown()


def test_a_line_that_vanishes_while_it_is_opened_is_a_bus_error(monkeypatch: pytest.MonkeyPatch) -> None:
    def vanish(channel: str) -> can.BusABC:
        raise termios.error(5, "Input/output error")

    monkeypatch.setattr("firmware_bridge.can.serial_line.SerialLine", vanish)
    with pytest.raises(BusError, match="Input/output error"):
        open_bus(BusAddress("serial", "/dev/ttyACM0"))


@pytest.mark.parametrize("waiting", [300, 1000])
def test_a_step_reads_a_bounded_number_of_frames(waiting: int) -> None:
    echo = Echoing()
    echo.waiting = [can.Message(arbitration_id=1, data=b"", is_extended_id=False)] * waiting
    bus = FrameBus(echo, echoes=False)  # type: ignore[arg-type]
    assert len(bus.receive(256)) == 256 and len(echo.waiting) == waiting - 256
