"""Sniffer: a process on the robot's side that stamps every motion request on arrival.

    python -m tools.faults.rig.sniffer unitree 7 --out received.jsonl
    python -m tools.faults.rig.sniffer ros2 7 --out received.jsonl
    python -m tools.faults.rig.sniffer can 239.74.163.2 --out received.jsonl

One JSON object a line: {"t_ns": monotonic, "source": writer's number, "velocity": [x, y, wz] of a motion request, or
null}. It shares only the bus and the parser of one message with the tested code.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import time
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

from edge.core.cli import command_line, open_stream
from firmware_bridge.can.multicast import LoopbackMulticastBus
from firmware_bridge.core.config import DdsConfig
from firmware_bridge.dds.bus import Bus, take_each
from firmware_bridge.ros2.messages.common import Twist_
from firmware_bridge.unitree.messages import ids
from firmware_bridge.unitree.messages.idl import Request_
from sim_hil.protocols.can import frames
from sim_hil.protocols.ros2.topics import COMMAND_TOPIC
from sim_hil.protocols.unitree.services.sport import parse_move

_WAIT_S = 0.05
_DEPTH = 256

Heard = tuple[int, object, "tuple[float, float, float] | None"]
"""Receive time, ns, sender, velocity."""


def _samples(domain: str, topic: str, kind: Any) -> Generator[tuple[int, Any] | None, None, None]:
    """Yield each sample with its receive time, ns; None when none waits."""
    bus = Bus(DdsConfig(int(domain), "lo", ("127.0.0.1",)))
    reader = bus.reader(topic, kind, depth=_DEPTH, reliable=True)
    waitset = bus.waitset(reader)
    try:
        yield None
        while True:
            waitset.wait(round(_WAIT_S * 1e9))
            for sample in take_each(reader, _DEPTH):
                t_ns = time.monotonic_ns()
                if sample is not None:
                    yield t_ns, sample
            yield None
    finally:
        bus.close()


def _unitree(domain: str) -> Generator[Heard | None, None, None]:
    for found in _samples(domain, ids.request_topic(ids.SPORT_SERVICE), Request_):
        if found is None:
            yield None
            continue
        t_ns, sample = found
        move = parse_move(sample.parameter) if sample.header.identity.api_id == ids.MOVE else None
        yield t_ns, sample.sample_info.publication_handle, move


def _ros2(domain: str) -> Generator[Heard | None, None, None]:
    for found in _samples(domain, COMMAND_TOPIC, Twist_):
        if found is None:
            yield None
            continue
        t_ns, sample = found
        yield t_ns, sample.sample_info.publication_handle, (sample.linear.x, sample.linear.y, sample.angular.z)


def _can(group: str) -> Generator[Heard | None, None, None]:
    command = frames.database().get_message_by_name("VelocityCommand")
    bus = LoopbackMulticastBus(group)
    try:
        yield None
        while True:
            message, port = bus.receive_from(_WAIT_S)
            t_ns = time.monotonic_ns()
            if message is None:
                yield None
            elif message.arbitration_id == command.frame_id and not message.is_error_frame:
                signals: Any = command.decode(bytes(message.data))
                yield t_ns, port, (float(signals["Vx"]), 0.0, float(signals["Wz"]))
    finally:
        bus.shutdown()


LISTENERS: dict[str, Callable[[str], Generator[Heard | None, None, None]]] = {
    "unitree": _unitree,
    "ros2": _ros2,
    "can": _can,
}


@command_line("sniffer")
def main(argv: list[str] | None = None) -> int:
    """Listen until SIGTERM or SIGINT."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("protocol", choices=tuple(LISTENERS))
    parser.add_argument("address", help="DDS domain, or multicast address of the CAN bus")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.jsonl")
    args = parser.parse_args(argv)
    ended: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _frame: ended.append(number))
    sources: dict[object, int] = {}
    with open_stream(args.out) as file:
        heard = LISTENERS[args.protocol](args.address)
        next(heard)
        sys.stderr.write("sniffer: ready\n")
        sys.stderr.flush()
        for one in heard:
            if one is not None:
                t_ns, sender, velocity = one
                source = sources.setdefault(sender, len(sources))
                file.write(json.dumps({"t_ns": t_ns, "source": source, "velocity": velocity}) + "\n")
            if one is None or args.protocol == "can":
                file.flush()
            if ended:
                break
        heard.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
