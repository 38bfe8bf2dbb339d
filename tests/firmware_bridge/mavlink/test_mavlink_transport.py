"""Byte links to an autopilot: a UDP socket and a serial line (a pty), with everything that can go wrong on them."""

from __future__ import annotations

import os
import socket
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest

from firmware_bridge.core.robot_state import LinkOpenError
from firmware_bridge.mavlink.transport import SerialTransport, UdpTransport

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
