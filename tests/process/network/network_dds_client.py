"""Talks to an edge-hil over whatever network it is on, for test_network_shim.py: DOMAIN INTERFACE SECONDS -> JSON."""

from __future__ import annotations

import json
import sys
import time

from firmware_bridge.core.config import DdsConfig
from firmware_bridge.unitree.dds import Bus, take_each
from firmware_bridge.unitree.messages import ids
from firmware_bridge.unitree.messages.idl import SportModeState_
from firmware_bridge.unitree.rpc import RpcClient, RpcError


def main() -> None:
    domain, interface, seconds = int(sys.argv[1]), sys.argv[2], float(sys.argv[3])
    bus = Bus(DdsConfig(domain, interface))
    states = bus.reader(ids.SPORT_STATE_TOPIC, SportModeState_, depth=100)
    sport = RpcClient(bus, ids.SPORT_SERVICE)
    deadline = time.monotonic() + 40
    while not (sport.connected() and any(take_each(states))):
        if time.monotonic() > deadline:
            sys.exit("no robot")
        time.sleep(0.05)
    stamps, round_trips_ms, failed = [], [], 0
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        start = time.monotonic()
        try:
            sport.call(ids.STOP_MOVE, timeout_s=1.0)
            round_trips_ms.append((time.monotonic() - start) * 1e3)
        except RpcError:
            failed += 1
        stamps += [sample.stamp.sec + 1e-9 * sample.stamp.nanosec for sample in take_each(states, 500) if sample]
        time.sleep(0.05)
    span_s = stamps[-1] - stamps[0]
    round_trips_ms.sort()
    result = {
        "state_hz": (len(stamps) - 1) / span_s,
        "calls": len(round_trips_ms),
        "failed": failed,
        "rtt_ms": round_trips_ms[len(round_trips_ms) // 2],
        "rtt_min_ms": round_trips_ms[0],
    }
    sys.stdout.write(json.dumps(result) + "\n")


if __name__ == "__main__":
    main()
