"""Non-blocking buses, and the serial line between two processes of one machine."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import msgpack
import pytest
from can.interfaces.udp_multicast.utils import pack_message
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge.can.buses import BusAddress, BusError, open_bus
from firmware_bridge.can.frame import Frame
from firmware_bridge.can.multicast import unpacked
from firmware_bridge.can.serial_line import SerialFrames
from sim_hil.protocols.can.buses import BusLink
from sim_hil.protocols.can.pty_line import PtyLine

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


@pytest.mark.slow
@given(st.lists(st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8)), max_size=5), st.data())
def test_serial_frames_are_found_in_any_chunks_of_bytes(sent: list[tuple[int, bytes]], cuts: st.DataObject) -> None:
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
def test_frames_after_invalid_bytes_are_found(noise: bytes, identifier: int, data: bytes) -> None:
    parser = SerialFrames()
    # Invalid bytes may equal the beginning of a frame and take as much as one frame with it, but not a second one.
    parser.put(noise + serial_bytes(identifier, data) + serial_bytes(0x123, b"end") * 3)
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


def test_a_late_client_receives_no_old_frames(line: PtyLine) -> None:
    near = BusLink(open_bus(BusAddress("serial", line.near)))
    for _ in range(2000):
        near.send(FRAME)
    until(lambda: near.pending == 0)
    time.sleep(0.3)  # the last bytes are still on their way
    far = BusLink(open_bus(BusAddress("serial", str(line.far))))
    new = Frame(0x321, b"new")
    received: list[Frame] = []

    def arrives() -> bool:
        near.send(new)
        received.extend(frame for _, frame in far.receive())
        return new in received

    until(arrives)
    assert FRAME not in received
    far.close()
    near.close()


def test_invalid_bytes_on_the_line_are_counted_and_later_frames_arrive(line: PtyLine) -> None:
    near = BusLink(open_bus(BusAddress("serial", line.near)))
    device = os.open(line.far, os.O_RDWR | os.O_NOCTTY)
    far = BusLink(open_bus(BusAddress("serial", str(line.far))))
    os.write(device, b"\xaa\x00\x00\x00\x00\x63garbage\xaa\xaa\xaa")
    received: list[Frame] = []

    def arrives() -> bool:
        far.send(FRAME)
        received.extend(frame for _, frame in near.receive())
        return FRAME in received

    until(arrives)
    assert near.line_errors > 0
    os.close(device)
    far.close()
    near.close()


def test_sending_without_a_receiver_never_waits(line: PtyLine) -> None:
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


def test_a_lost_bus_is_reported(line: PtyLine) -> None:
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


@pytest.mark.parametrize(
    "address",
    ["serial:/no/such/device", "serial:/dev/null", "udp_multicast:example.invalid", "udp_multicast:127.0.0.1",
     "udp_multicast:ff02::1", "udp_multicast:239.74.163.2:5"],
)  # fmt: skip
def test_a_bus_that_cannot_be_opened_is_refused_in_one_line(address: str) -> None:
    with pytest.raises(BusError, match=rf"^CAN bus {address}: cannot be opened: .+$"):
        open_bus(BusAddress.parse(address))


_MULTICAST = """
import socket, time
import can
from can.interfaces.udp_multicast.utils import pack_message
from firmware_bridge.can.buses import BusAddress, open_bus
from sim_hil.protocols.can.buses import BusLink
from firmware_bridge.can.frame import Frame
GROUP = "239.74.163.2"
a, b = (BusLink(open_bus(BusAddress("udp_multicast", GROUP))) for _ in range(2))
def arrives(wanted, send):
    deadline, found = time.monotonic() + 10, []
    while wanted not in found and time.monotonic() < deadline:
        send()
        b.wait(100_000_000)
        found += [frame for _, frame in b.receive()]
    return wanted in found
{act}
a.close(); b.close()
"""


def in_a_namespace(act: str) -> None:
    """Run `act` with two links `a` and `b`, beside an interface `out0` whose other end `far0` is a network outside."""
    namespace = ["unshare", "--user", "--map-root-user", "--net"]
    if subprocess.run([*namespace, "true"], capture_output=True, check=False).returncode:
        pytest.skip("no right to make a network namespace")
    setup = (
        "ip link set lo up && ip link add out0 address 02:00:00:00:00:01 type veth peer name far0"
        " && ip addr add 10.0.0.1/24 dev out0 && ip link set out0 up && ip link set far0 up"
        ' && ip route add default dev out0 && exec "$0" -c "$1"'
    )
    program = _MULTICAST.replace("{act}", act)
    done = subprocess.run(
        [*namespace, "sh", "-c", setup, sys.executable, program],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_multicast_counts_invalid_datagrams_and_continues() -> None:
    act = """
stranger = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
stranger.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"lo")
for junk in (b"", b"junk", bytes([0x93, 1, 2, 3]), bytes([7]), bytes([0xC1])):
    stranger.sendto(junk, (GROUP, 43113))
assert arrives(Frame(0x123, b"abc"), lambda: a.send(Frame(0x123, b"abc")))
assert b.line_errors == 5, b.line_errors
"""
    in_a_namespace(act)


@given(st.binary(max_size=40))
def test_random_datagrams_are_no_frames(datagram: bytes) -> None:
    assert unpacked(datagram) is None


@pytest.mark.parametrize(
    "wrong",
    [{"data": 2**32}, {"data": "abc"}, {"data": bytes(9)}, {"arbitration_id": 1.5}, {"arbitration_id": 2**32},
     {"is_error_frame": "no"}],
)  # fmt: skip
def test_a_datagram_with_an_invalid_frame_is_refused(wrong: dict[str, object]) -> None:
    table = msgpack.unpackb(pack_message(can.Message(arbitration_id=0x123, data=b"abc", is_extended_id=False)))
    message = unpacked(msgpack.packb(table))
    assert message is not None and (message.arbitration_id, message.data) == (0x123, b"abc")
    assert unpacked(msgpack.packb({**table, **wrong})) is None


@pytest.mark.slow
def test_multicast_neither_receives_nor_sends_outside_the_machine() -> None:
    act = """
frame = pack_message(can.Message(arbitration_id=0x321, data=b"out", is_extended_id=False))
raw = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(3))
raw.bind(("far0", 3))
raw.settimeout(0.2)
payload = 28 + len(frame)
def packet(to):
    head = bytes([0x45, 0]) + payload.to_bytes(2, "big") + bytes([0, 1, 0, 0, 1, 17, 0, 0])
    head += socket.inet_aton("10.0.0.2") + socket.inet_aton(to)
    total = sum(int.from_bytes(head[i:i + 2], "big") for i in range(0, 20, 2))
    total = (total & 0xFFFF) + (total >> 16)
    head = head[:10] + (0xFFFF - total).to_bytes(2, "big") + head[12:]
    udp = (4000).to_bytes(2, "big") + (43113).to_bytes(2, "big") + (payload - 20).to_bytes(2, "big") + bytes(2)
    return head + udp + frame
other = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
other.bind(("", 43113))
other.setsockopt(0, socket.IP_ADD_MEMBERSHIP, socket.inet_aton(GROUP) + socket.inet_aton("10.0.0.1"))
other.settimeout(5)
raw.send(bytes.fromhex("01005e4aa302") + bytes(6) + bytes([8, 0]) + packet(GROUP))
assert other.recv(2000) == frame  # the packet is one that a bus on all interfaces would have taken
raw.send(bytes.fromhex("020000000001") + bytes(6) + bytes([8, 0]) + packet("10.0.0.1"))
assert arrives(Frame(0x123, b"abc"), lambda: a.send(Frame(0x123, b"abc")))
assert Frame(0x321, b"out") not in [frame for link in (a, b) for _, frame in link.receive()]
left = []
try:
    while True:
        left.append(raw.recv(2000))
except TimeoutError:
    pass
assert not any(b"arbitration_id" in each and b"abc" in each for each in left)
"""
    in_a_namespace(act)
