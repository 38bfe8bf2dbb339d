"""Buses that nobody waits for, and the serial line between two processes of one machine."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_hil.can.buses import BusAddress, BusError, BusLink, SerialFrames, open_bus
from sim_hil.can.e2e import Frame
from sim_hil.can.pty_line import PtyLine

FRAME = Frame(0x123, b"\x01\xaa\xbb\x04")


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 10.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.002)


@pytest.fixture
def line(tmp_path: Path) -> Iterator[PtyLine]:
    line = PtyLine(tmp_path / "far")
    yield line
    line.close()


@pytest.fixture
def ends(line: PtyLine) -> Iterator[tuple[BusLink, BusLink]]:
    links = tuple(BusLink(open_bus(BusAddress("serial", channel))) for channel in (line.near, str(line.far)))
    yield links  # type: ignore[misc]
    for link in links:
        link.close()


def serial_bytes(identifier: int, data: bytes) -> bytes:
    return b"\xaa\0\0\0\0" + bytes((len(data),)) + identifier.to_bytes(4, "little") + data + b"\xbb"


@given(st.lists(st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8)), max_size=5), st.data())
def test_serial_frames_are_found_however_the_bytes_are_cut(sent: list[tuple[int, bytes]], cuts: st.DataObject) -> None:
    stream = b"".join(serial_bytes(*frame) for frame in sent)
    parser, found = SerialFrames(), []
    while stream:
        size = cuts.draw(st.integers(1, len(stream)))
        parser.put(stream[:size])
        stream = stream[size:]
        while (message := parser.take()) is not None:
            found.append((message.arbitration_id, bytes(message.data)))
    assert found == sent and parser.errors == 0


@given(st.binary(max_size=64), st.integers(0, 0x7FF), st.binary(max_size=8))
def test_after_any_rubbish_the_frames_that_follow_are_found(rubbish: bytes, identifier: int, data: bytes) -> None:
    parser = SerialFrames()
    # Rubbish may look like the beginning of a frame and take as much as one frame with it, but not a second one.
    parser.put(rubbish + serial_bytes(identifier, data) + serial_bytes(0x123, b"end") * 3)
    found = []
    while (message := parser.take()) is not None:
        found.append((message.arbitration_id, bytes(message.data)))
    assert found[-1] == (0x123, b"end")


def test_frames_cross_a_serial_line_both_ways(ends: tuple[BusLink, BusLink]) -> None:
    for sender, receiver in (ends, ends[::-1]):
        received: list[Frame] = []
        sender.send(FRAME)
        until(lambda: received.extend(frame for _, frame in receiver.receive()) or bool(received))  # type: ignore[func-returns-value]  # noqa: B023
        assert received == [FRAME]


def test_waiting_ends_when_a_frame_arrives(ends: tuple[BusLink, BusLink]) -> None:
    ends[0].send(FRAME)
    ends[1].wait(10_000_000_000)
    assert [frame for _, frame in ends[1].receive()] == [FRAME]


def test_whoever_plugs_in_late_hears_nothing_old(line: PtyLine) -> None:
    near = BusLink(open_bus(BusAddress("serial", line.near)))
    for _ in range(2000):
        near.send(FRAME)
    until(lambda: near.pending == 0)
    time.sleep(0.3)  # the last bytes are still on their way
    far = BusLink(open_bus(BusAddress("serial", str(line.far))))
    new = Frame(0x321, b"new")
    received: list[Frame] = []

    def heard() -> bool:
        near.send(new)
        received.extend(frame for _, frame in far.receive())
        return new in received

    until(heard)
    assert FRAME not in received
    far.close()
    near.close()


def test_rubbish_on_the_line_is_counted_and_frames_after_it_arrive(line: PtyLine) -> None:
    near = BusLink(open_bus(BusAddress("serial", line.near)))
    device = os.open(line.far, os.O_RDWR | os.O_NOCTTY)
    far = BusLink(open_bus(BusAddress("serial", str(line.far))))
    os.write(device, b"\xaa\x00\x00\x00\x00\x63garbage\xaa\xaa\xaa")
    received: list[Frame] = []

    def heard() -> bool:
        far.send(FRAME)
        received.extend(frame for _, frame in near.receive())
        return FRAME in received

    until(heard)
    assert near.line_errors > 0
    os.close(device)
    far.close()
    near.close()


def test_sending_to_nobody_never_waits(line: PtyLine) -> None:
    near = BusLink(open_bus(BusAddress("serial", line.near)))
    began = time.monotonic()
    for _ in range(5000):
        near.send(FRAME)
    assert time.monotonic() - began < 5.0, "the queue is filled and then overflows"
    near.close()


def test_a_line_removes_its_path_and_needs_a_free_one(tmp_path: Path) -> None:
    path = tmp_path / "far"
    line = PtyLine(path)
    with pytest.raises(FileExistsError):
        PtyLine(path)
    line.close()
    line.close()
    assert not path.is_symlink()


def test_a_bus_that_has_gone_is_reported(line: PtyLine) -> None:
    far = BusLink(open_bus(BusAddress("serial", str(line.far))))
    line.close()

    def gone() -> bool:
        try:
            far.receive()
        except BusError:
            return True
        return False

    until(gone)
    far.close()


@pytest.mark.parametrize("channel", ["/no/such/device", "/dev/null"])
def test_a_serial_line_that_is_none_is_refused_in_one_line(channel: str) -> None:
    with pytest.raises(BusError, match=r"^CAN bus serial:.+: cannot be opened: .+$"):
        open_bus(BusAddress("serial", channel))


_MULTICAST = """
import time
from sim_hil.can.buses import BusAddress, BusLink, open_bus
from sim_hil.can.e2e import Frame
a, b = (BusLink(open_bus(BusAddress("udp_multicast", "239.74.163.2"))) for _ in range(2))
deadline, heard = time.monotonic() + 10, []
while not heard and time.monotonic() < deadline:
    a.send(Frame(0x123, b"abc"))
    b.wait(100_000_000)
    heard += [frame for _, frame in b.receive()]
a.close(); b.close()
raise SystemExit(0 if Frame(0x123, b"abc") in heard else 1)
"""


def test_multicast_carries_frames_inside_a_network_namespace_of_its_own() -> None:
    namespace = ["unshare", "--user", "--map-root-user", "--net"]
    if subprocess.run([*namespace, "true"], capture_output=True, check=False).returncode:
        pytest.skip("no right to make a network namespace")
    setup = 'ip link set lo up && ip link set lo multicast on && ip route add 239.0.0.0/8 dev lo && exec "$0" -c "$1"'
    done = subprocess.run(
        [*namespace, "sh", "-c", setup, sys.executable, _MULTICAST],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
