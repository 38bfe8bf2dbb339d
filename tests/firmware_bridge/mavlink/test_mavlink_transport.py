"""Byte links to an autopilot: a UDP socket and a serial line (a pty), with everything that can go wrong on them."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import sys
import time
import tty
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from firmware_bridge.core.config import RobotConfig
from firmware_bridge.core.robot_state import LinkOpenError
from firmware_bridge.mavlink.robot_link import RobotLink
from firmware_bridge.mavlink.table import missing_link
from firmware_bridge.mavlink.transport import SerialTransport, UdpTransport
from tests.support.robot.rover_bench import ROBOTS, robot_file

S = 1_000_000_000
BAUD = 921600


@pytest.fixture
def pty_pair(tmp_path: Path) -> Iterator[tuple[int, Path]]:
    """The autopilot's end of a serial line, and a link to the bridge's end."""
    ours, theirs = os.openpty()
    tty.setraw(ours)
    os.set_blocking(ours, False)
    path = tmp_path / "ttyACM0"
    path.symlink_to(os.ttyname(theirs))
    yield ours, path
    for end in (ours, theirs):
        os.close(end)


def read(file: int, count: int) -> bytes:
    """Read so many bytes, in as many pieces as they come."""
    data, until_s = b"", time.monotonic() + 5
    while len(data) < count and time.monotonic() < until_s:
        with contextlib.suppress(BlockingIOError):
            data += os.read(file, 100)
    return data


class TestSerial:
    def test_bytes_pass_unchanged_in_both_directions(self, pty_pair: tuple[int, Path]) -> None:
        ours, path = pty_pair
        line, every = SerialTransport(str(path), BAUD), bytes(range(256))
        os.write(ours, every)
        assert line.send(every) and b"".join(line.receive(0)) == every and os.read(ours, 1000) == every
        line.close()

    def test_a_packet_that_does_not_fit_is_never_sent_in_part(self, pty_pair: tuple[int, Path]) -> None:
        ours, path = pty_pair
        line, sent, received = SerialTransport(str(path), BAUD), [], b""
        for number in range(2000):
            packet = bytes([number % 256]) * 50
            if line.send(packet):
                sent.append(packet)
        assert len(sent) < 2000  # nobody has read: the line is full
        for _ in range(1000):
            try:
                received += os.read(ours, 4096)
            except BlockingIOError:
                break
            line.send(b"")
        assert received == b"".join(sent)[: len(received)] and len(received) >= 50 * (len(sent) - 1)
        line.close()

    @pytest.mark.parametrize(("waiting", "after_ms", "taken"), [(512, 60_000, True), (513, 39, True), (513, 40, False)])
    def test_a_line_that_is_too_slow_refuses_packets_so_that_none_comes_late(
        self, pty_pair: tuple[int, Path], monkeypatch: pytest.MonkeyPatch, waiting: int, after_ms: int, taken: bool
    ) -> None:
        ours, path = pty_pair
        line, now_ms = SerialTransport(str(path), BAUD), [0]
        clock = SimpleNamespace(monotonic_ns=lambda: now_ms[0] * 1_000_000)
        monkeypatch.setattr("firmware_bridge.mavlink.transport.time", clock)
        assert line.send(b"first")
        monkeypatch.setattr("fcntl.ioctl", lambda *_: waiting.to_bytes(4, sys.byteorder))
        now_ms[0] = after_ms
        assert line.send(b"packet") == taken
        expected = b"first" + b"packet" * taken
        assert read(ours, len(expected)) == expected
        line.close()

    def test_a_usb_line_takes_every_packet_of_a_burst(
        self, pty_pair: tuple[int, Path], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        ours, path = pty_pair
        line, now_ms = SerialTransport(str(path), BAUD), [0]
        clock = SimpleNamespace(monotonic_ns=lambda: now_ms[0] * 1_000_000)
        monkeypatch.setattr("firmware_bridge.mavlink.transport.time", clock)
        under_way = [0]
        monkeypatch.setattr("fcntl.ioctl", lambda *_: (1280 * under_way[0]).to_bytes(4, sys.byteorder))
        for _ in range(100):  # steps of the bridge: zero velocity, hold, disarm
            for packet in (b"zero", b"hold", b"disarm"):
                assert line.send(packet)
                under_way[0] += 1
            assert read(ours, 14) == b"zeroholddisarm"
            now_ms[0], under_way[0] = now_ms[0] + 20, 0
        line.close()

    def test_a_line_that_vanishes_is_opened_again_after_a_second(
        self, pty_pair: tuple[int, Path], tmp_path: Path
    ) -> None:
        _, path = pty_pair
        line = SerialTransport(str(path), BAUD)
        line._drop_line(5 * S)
        assert not line.send(b"x") and line.receive(5 * S) == []
        line.receive(7 * S)
        assert line.send(b"x")
        line.close()

    def test_two_bridges_cannot_share_a_line(self, pty_pair: tuple[int, Path]) -> None:
        line = SerialTransport(str(pty_pair[1]), BAUD)
        with pytest.raises(LinkOpenError, match="expected a serial line of our own"):
            SerialTransport(str(pty_pair[1]), BAUD)
        line.close()

    def test_a_file_is_no_serial_line(self, tmp_path: Path) -> None:
        path = tmp_path / "file"
        path.touch()
        with pytest.raises(LinkOpenError, match="expected a serial line"):
            SerialTransport(str(path), BAUD)


class TestUdp:
    def test_datagrams_of_other_addresses_are_dropped(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as rover, socket.socket(type=socket.SOCK_DGRAM) as other:
            rover.bind(("127.0.0.1", 0))
            link = UdpTransport("127.0.0.1", rover.getsockname()[1])
            link.send(b"hello")
            _, bridge = rover.recvfrom(100)
            other.sendto(b"forged", bridge)
            rover.sendto(b"genuine", bridge)
            assert link.receive(0) == [b"genuine"]
            link.close()

    def test_a_rover_that_is_not_there_raises_nothing(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        link = UdpTransport("127.0.0.1", port)
        for _ in range(4):
            link.send(b"hello")
            assert link.receive(0) == []
        link.close()

    def test_a_flood_is_read_in_bounded_portions(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as rover:
            rover.bind(("127.0.0.1", 0))
            link = UdpTransport("127.0.0.1", rover.getsockname()[1])
            link.send(b"hello")
            _, bridge = rover.recvfrom(100)
            for _ in range(150):
                rover.sendto(b"x", bridge)
            assert len(link.receive(0)) <= 64
            link.close()

    def test_a_taken_port_is_one_line(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
            taken.bind(("", 0))
            with pytest.raises(LinkOpenError, match="expected a free port"):
                UdpTransport("127.0.0.1", 1, taken.getsockname()[1])


class TestMissingLink:
    @pytest.mark.parametrize("error", [errno.ENETUNREACH, errno.EHOSTUNREACH, errno.ENETDOWN])
    def test_an_address_without_a_route_is_waited_for(self, monkeypatch: pytest.MonkeyPatch, error: int) -> None:
        with monkeypatch.context() as patch:
            patch.setattr(socket.socket, "connect_ex", lambda *_: error)
            missing = missing_link(robot_file(link="udp:10.0.0.7:14580"))
        assert missing == f"waiting for a route to 10.0.0.7: {os.strerror(error)}"

    def test_an_address_with_a_route_is_there_although_nothing_listens(self) -> None:
        assert missing_link(robot_file(link="udp:127.0.0.1:1")) is None

    def test_another_error_is_left_to_the_opening_which_reports_it(self, monkeypatch: pytest.MonkeyPatch) -> None:
        with monkeypatch.context() as patch:
            patch.setattr(socket.socket, "connect_ex", lambda *_: errno.EACCES)
            assert missing_link(robot_file(link="udp:10.0.0.7:14580")) is None

    def test_a_serial_device_is_waited_for(self, pty_pair: tuple[int, Path], tmp_path: Path) -> None:
        path = tmp_path / "none"
        assert missing_link(robot_file(link=f"serial:{path}:{BAUD}")) == f"serial device {path} does not exist"
        assert missing_link(robot_file(link=f"serial:{pty_pair[1]}:{BAUD}")) is None


def lines_at_start(config: RobotConfig) -> list[str]:
    lines: list[str] = []
    RobotLink(config, lines.append).close()
    return lines


class TestRobotLink:
    def test_a_px4_rover_gets_one_line_about_its_yaw_rate_and_another_none(self) -> None:
        link = "udp:127.0.0.1:9"
        (line,) = lines_at_start(robot_file(link=link))
        assert "PX4's rover modules ignore the yaw rate" in line and "\n" not in line
        assert lines_at_start(robot_file(ROBOTS / "rover_ardupilot.toml", link=link)) == []

    def test_the_robot_files_accepted_errors_reach_the_odometry(self) -> None:
        config = robot_file(link="udp:127.0.0.1:9")
        safety = replace(config.safety, accepted_error_codes=(0, 2))
        link = RobotLink(replace(config, safety=safety), lambda _: None)
        link.close()
        assert link._session.odometry._accepted == (0, 2)
