"""Sniffer: a process on the robot's side that stamps every request of the sport service on arrival.

    python -m tools.faults.sniffer --domain 7 --out received.jsonl

One JSON object a line: {"t_ns": monotonic, "source": writer's number, "velocity": [x, y, wz] of a Move, or null}.
It shares only the DDS reader and the parser of a Move with the tested code.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import time
from pathlib import Path

from edge.core.cli import command_line, open_stream
from firmware_bridge.core.config import DdsConfig
from firmware_bridge.dds.bus import Bus, take_each
from firmware_bridge.unitree.messages import ids
from firmware_bridge.unitree.messages.idl import Request_
from sim_hil.protocols.unitree.services.sport import parse_move

_WAIT_NS = 50_000_000
_DEPTH = 256


@command_line("sniffer")
def main(argv: list[str] | None = None) -> int:
    """Listen until SIGTERM or SIGINT."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--domain", type=int, required=True)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.jsonl")
    args = parser.parse_args(argv)
    ended: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _frame: ended.append(number))
    bus = Bus(DdsConfig(args.domain, "lo", ("127.0.0.1",)))
    reader = bus.reader(ids.request_topic(ids.SPORT_SERVICE), Request_, depth=_DEPTH, reliable=True)
    waitset = bus.waitset(reader)
    sources: dict[int, int] = {}
    with open_stream(args.out) as file:
        sys.stderr.write("sniffer: ready\n")
        sys.stderr.flush()
        while not ended:
            waitset.wait(_WAIT_NS)
            for sample in take_each(reader, _DEPTH):
                t_ns = time.monotonic_ns()
                if sample is None:
                    continue
                handle = sample.sample_info.publication_handle
                api_id = sample.header.identity.api_id
                line = {
                    "t_ns": t_ns,
                    "source": sources.setdefault(handle, len(sources)),
                    "velocity": parse_move(sample.parameter) if api_id == ids.MOVE else None,
                }
                file.write(json.dumps(line) + "\n")
            file.flush()
    bus.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
