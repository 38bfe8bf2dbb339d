"""Hostile datagrams at the bridge's command socket."""

from __future__ import annotations

import functools
import math
import socket
import struct
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from random import Random

import pytest

from firmware_bridge.core.config import load_robot_config
from firmware_bridge.core.link import MAX_DATAGRAM_BYTES, VERSION, Arm, Velocity, decode, encode
from tests.support.processes import GO2_SIM, HostStall, Running, check_stop_latency, wait_for
from tests.support.robot.fake_go2 import FakeGo2

pytestmark = pytest.mark.process


def test_garbage_on_the_socket_is_ignored(robot: FakeGo2, bridge: Running, socket_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as client:
        client.connect(str(socket_path))
        for data in (b"\0", b"TVEB" + b"\xff" * 600, b"x" * 511, encode(Arm())):
            client.send(data)
        wait_for(lambda: decode(client.recv(MAX_DATAGRAM_BYTES)).state == "armed", 20, "armed")


@pytest.mark.slow
def test_ten_thousand_hostile_datagrams_neither_crash_it_nor_move_the_robot_too_fast_nor_make_it_late(
    robot: FakeGo2, bridge: Running, socket_path: Path
) -> None:
    limits = load_robot_config(GO2_SIM).limits
    client = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    client.connect(str(socket_path))
    client.send(encode(Arm()))
    wait_for(lambda: decode(client.recv(MAX_DATAGRAM_BYTES)).state == "armed", 20, "armed")
    client.setblocking(False)
    robot.received.clear()
    with HostStall() as host:
        since_ns = time.monotonic_ns()
        for seq, data in enumerate(hostile_datagrams(10_000)):
            wait_for(functools.partial(sent, client, data), 10, "room in the socket")
            if seq % 100 == 0:
                sent(client, encode(Velocity(seq, time.monotonic_ns(), 0.3, 0.0, 0.0)))
                time.sleep(0.01)
        moves = [command for command in robot.moves() if command.received_ns > since_ns]
        for earlier, later in pairwise(moves):
            gap_ns = later.received_ns - earlier.received_ns
            check_stop_latency(gap_ns, 40_000_000, earlier.received_ns, host)
    assert bridge.process.poll() is None
    assert len(moves) > 30
    for vx_mps, vy_mps, wz_radps in (command.velocity for command in moves):
        assert limits.vx_min_mps <= vx_mps <= limits.vx_max_mps
        assert abs(vy_mps) <= limits.vy_max_mps and abs(wz_radps) <= limits.wz_max_radps
    client.close()
    wait_for(lambda: not robot.is_driven(), 5, "zero velocity")


def hostile_datagrams(count: int) -> Iterator[bytes]:
    """Noise, valid datagrams with bytes changed, other versions and kinds, and too long ones; always the same."""
    random = Random(0)
    for number in range(count):
        valid = bytearray(encode(Velocity(number, time.monotonic_ns(), random.uniform(-9, 9), 0.2, math.nan)))
        kind = number % 5
        if kind == 0:
            yield random.randbytes(random.randrange(1, 80))
        elif kind == 1:
            for _ in range(random.randrange(1, 4)):
                valid[random.randrange(len(valid))] = random.randrange(256)
            yield bytes(valid)
        elif kind == 2:
            valid[4], valid[5] = random.randrange(256), random.choice((3, 4, 5, 255))
            yield bytes(valid)
        elif kind == 3:
            yield bytes(valid) + random.randbytes(random.randrange(1, 900))
        else:
            yield struct.pack("<4sBBHQq3d", b"TVEB", VERSION, 3, 40, number, 2**62, 3e38, -math.inf, 1e308)


def sent(client: socket.socket, data: bytes) -> bool:
    """Whether the socket took it."""
    try:
        client.send(data)
    except BlockingIOError:
        return False
    return True
