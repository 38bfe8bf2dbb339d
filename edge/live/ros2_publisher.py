"""The process that publishes a run as a ROS 2 node, without a ROS installation.

`edge-run` starts it where the robot file has `ros2.publish = true`; it ends with the runner. It reads nothing from DDS
and commands nothing. A topic without a subscriber costs nothing.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import select
import signal
import socket
import sys
import time
from collections.abc import Sequence
from typing import Any, Final

from edge.live import wire
from edge.live.ros2_messages import KINDS, Published, Ros2Messages
from firmware_bridge.core.config_ros2 import dds_topic
from firmware_bridge.core.robot_state import DdsError
from firmware_bridge.core.sections import DdsConfig
from firmware_bridge.dds.binding import has_reader
from firmware_bridge.dds.bus import DDS_ERRORS, DECODE_ERRORS, Bus

DIAGNOSTICS_S: Final = 1.0
DEPTH: Final = 10
"""Messages kept for a reader that lags, as rclpy's default profile keeps."""
_NICENESS: Final = 10
_MAX_RECEIVED_BYTES: Final = 64 * 1024  # discovery alone: nothing is read


class Publisher:
    """Publishes one run; `bus` is its participant, in which every topic is announced at once."""

    def __init__(self, bus: Bus, robot: str, namespace: str) -> None:
        self._messages = Ros2Messages(robot)
        self._writers: dict[str, Any] = {
            # Reliable matches every subscriber; a slow one loses older messages and delays nothing.
            topic: bus.writer(dds_topic(topic, namespace), kind, depth=DEPTH, reliable=True)
            for topic, kind in KINDS.items()
        }
        self.failed = 0

    def take(self, datagram: wire.Datagram) -> None:
        """Publish the messages of one record of the runner."""
        record: dict[str, Any] | bytes = datagram.payload
        if datagram.kind == wire.RECORD:
            record = json.loads(datagram.payload)
            if not isinstance(record, dict):
                return
        elif datagram.kind != wire.PICTURE:
            return
        for published in self._messages.of(datagram.topic, datagram.stamp_ns, record, _clock_ns()):
            self._write(published)

    def diagnose(self) -> None:
        """Publish the diagnostics."""
        self._write(self._messages.diagnostics(time.monotonic_ns(), _clock_ns()))

    def _write(self, published: Published) -> None:
        writer = self._writers[published.topic]
        try:
            if has_reader(writer):
                writer.write(published.message)
        except (*DDS_ERRORS, *DECODE_ERRORS):
            self.failed += 1  # a network that is away for a moment, or a value outside its type, costs this message


def serve(runner: socket.socket) -> None:
    """Join the domain that the runner names and publish until its end closes the socket."""
    config = json.loads(wire.decode(runner.recv(wire.MOST_BYTES)).payload)
    dds = DdsConfig(**{**config["dds"], "peers": tuple(config["dds"]["peers"])})
    try:
        bus = Bus(dds, max_sample_bytes=_MAX_RECEIVED_BYTES)
    except DdsError as error:
        runner.send(wire.Datagram(wire.REFUSED, f"ros2.publish: {error}".encode()).encode())
        return
    publisher = Publisher(bus, config["robot"], config["namespace"])
    where = f"ROS 2: publishing in {config['namespace']}, domain {dds.domain} on {dds.interface}"
    runner.send(wire.Datagram(wire.LISTENING, where.encode()).encode())
    due_s = time.monotonic() + DIAGNOSTICS_S
    while True:
        ready, _, _ = select.select([runner], [], [], max(0.0, due_s - time.monotonic()))
        if ready:
            data = runner.recv(wire.MOST_BYTES)
            if not data:
                break
            with contextlib.suppress(ValueError):  # wire.WireError and malformed JSON
                publisher.take(wire.decode(data))
        if time.monotonic() >= due_s:
            publisher.diagnose()
            due_s = time.monotonic() + DIAGNOSTICS_S
    bus.close()


def _clock_ns() -> int:
    """Return the wall clock less the monotonic clock: ROS 2 stamps are of the wall clock."""
    return time.clock_gettime_ns(time.CLOCK_REALTIME) - time.monotonic_ns()


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point of the process that a runner starts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fd", type=int, required=True, help="the socket to the runner")
    args = parser.parse_args(argv)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the runner, whose end ends this process
    os.nice(_NICENESS)
    with contextlib.suppress(OSError), socket.socket(fileno=args.fd) as runner:
        serve(runner)
    return 0


if __name__ == "__main__":
    sys.exit(main())
