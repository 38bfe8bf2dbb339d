"""Second commander: drives the robot beside the bridge, like another program or the manufacturer's app.

    python -m tools.faults.rig.rogue unitree 7 --duration 1
    python -m tools.faults.rig.rogue can 239.74.163.2
    python -m tools.faults.rig.rogue ros2 7
    python -m tools.faults.rig.rogue mavlink 14580,/tmp/mavlink.key

Finds the robot, waits for SIGUSR1, prints the monotonic ns at which it begins, and sends until the time is over.
"""

from __future__ import annotations

import argparse
import contextlib
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
from can.interfaces.udp_multicast.utils import pack_message
from pymavlink.dialects.v20 import common

from firmware_bridge.can.multicast import PORT
from firmware_bridge.core.config import DdsConfig
from firmware_bridge.dds.binding import has_reader
from firmware_bridge.dds.bus import Bus
from firmware_bridge.ros2.messages.common import Twist_, Vector3_
from firmware_bridge.unitree.messages import ids
from firmware_bridge.unitree.rpc import RpcClient, move_parameter
from sim_hil.protocols.can.frames import Encoder
from sim_hil.protocols.mavlink.wire import Writer, now_ticks, read_key
from sim_hil.protocols.ros2.topics import COMMAND_TOPIC

_FIND_TIMEOUT_S = 10.0
_SPEED_MPS = 0.2
_RATE_HZ = 10.0
_POLL_S = 0.001


class NoRobotError(RuntimeError):
    """No robot was found in time; one line."""


def _wait(found: Callable[[], bool]) -> None:
    deadline_ns = time.monotonic_ns() + round(_FIND_TIMEOUT_S * 1e9)
    while not found():
        if time.monotonic_ns() > deadline_ns:
            raise NoRobotError(f"no robot within {_FIND_TIMEOUT_S:g} s")
        time.sleep(0.01)


@contextlib.contextmanager
def _unitree(domain: str) -> Iterator[Callable[[], None]]:
    with contextlib.closing(Bus(DdsConfig(int(domain), "lo", ("127.0.0.1",)))) as bus:
        sport = RpcClient(bus, ids.SPORT_SERVICE)
        _wait(sport.connected)
        yield lambda: _ignore(sport.send(ids.MOVE, move_parameter(_SPEED_MPS, 0.0, 0.0), noreply=True))


@contextlib.contextmanager
def _ros2(domain: str) -> Iterator[Callable[[], None]]:
    """The bridge stops at the appearance of a second publisher: it appears only with the first command."""
    with contextlib.closing(Bus(DdsConfig(int(domain), "lo", ("127.0.0.1",)))) as bus:
        twist = Twist_(Vector3_(_SPEED_MPS, 0.0, 0.0), Vector3_(0.0, 0.0, 0.0))
        writers: list[Any] = []

        def send() -> None:
            if not writers:
                writers.append(bus.writer(COMMAND_TOPIC, Twist_))
                _wait(lambda: has_reader(writers[0]))
            writers[0].write(twist)

        yield send


@contextlib.contextmanager
def _can(group: str) -> Iterator[Callable[[], None]]:
    """A socket of its own, whose port tells the sniffer the two controllers apart."""
    encoder = Encoder()
    encoder.encode("VelocityCommand", Vx=_SPEED_MPS, Wz=0.0)  # reads the DBC file now, not at the first command
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
        sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)

        def send() -> None:
            frame = encoder.encode("VelocityCommand", Vx=_SPEED_MPS, Wz=0.0)
            message = can.Message(arbitration_id=frame.identifier, data=frame.data, is_extended_id=False)
            sender.sendto(pack_message(message), (group, PORT))

        yield send


@contextlib.contextmanager
def _mavlink(place: str) -> Iterator[Callable[[], None]]:
    """A ground station with the link's key, whose setpoints the rover refuses; it requests the setpoint mode."""
    port, _, key = place.partition(",")
    writer = Writer(255, 190, read_key(Path(key)), now_ticks())
    heartbeat = common.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
    setpoint = common.MAVLink_set_position_target_local_ned_message(
        0, 1, 1, 8, 1479, 0, 0, 0, _SPEED_MPS, 0, 0, 0, 0, 0, 0, 0
    )
    mode = common.MAVLink_command_long_message(1, 1, 176, 0, 1, 6, 0, 0, 0, 0, 0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.connect(("127.0.0.1", int(port)))
        station.settimeout(_FIND_TIMEOUT_S)
        station.send(writer.pack(heartbeat))
        try:
            station.recv(2048)
        except OSError as error:
            raise NoRobotError(f"no answer of a rover: {error}") from error

        def send() -> None:
            for message in (heartbeat, setpoint, mode):
                writer.advance(now_ticks())
                station.send(writer.pack(message))

        yield send


def _ignore(_: object) -> None:
    """Discard a result."""


COMMANDERS = {"unitree": _unitree, "ros2": _ros2, "can": _can, "mavlink": _mavlink}


def main(argv: list[str] | None = None) -> int:
    """Command the robot for the duration, then exit."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("protocol", choices=tuple(COMMANDERS))
    parser.add_argument("address", help="DDS domain, multicast address of the CAN bus, or UDP port,KEY FILE")
    parser.add_argument("--duration", type=float, default=1.0, help="s (default: 1)")
    args = parser.parse_args(argv)
    begun: list[int] = []
    # A handler, not sigwait: a library's thread, started before a mask could be set, would die of the signal.
    signal.signal(signal.SIGUSR1, lambda number, _frame: begun.append(number))
    try:
        with COMMANDERS[args.protocol](args.address) as send:
            print("rogue: ready", flush=True)
            while not begun:
                time.sleep(_POLL_S)
            print(f"rogue: first {time.monotonic_ns()}", flush=True)
            for _ in range(max(1, round(args.duration * _RATE_HZ))):
                send()
                time.sleep(1.0 / _RATE_HZ)
    except NoRobotError as error:
        sys.stderr.write(f"rogue: {error} at {args.protocol} {args.address}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
