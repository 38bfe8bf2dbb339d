"""Second commander: sends Moves to the robot beside the bridge, like another program or the manufacturer's app.

    python -m tools.faults.rogue --domain 7 --duration 1

Finds the robot, waits for SIGUSR1, prints the monotonic ns of its first Move, and sends until the time is over.
"""

from __future__ import annotations

import argparse
import signal
import sys
import time

from firmware_bridge.core.config import DdsConfig
from firmware_bridge.dds.bus import Bus
from firmware_bridge.unitree.messages import ids
from firmware_bridge.unitree.rpc import RpcClient, move_parameter

_FIND_TIMEOUT_S = 10.0
_SPEED_MPS = 0.2
_RATE_HZ = 10.0


def main(argv: list[str] | None = None) -> int:
    """Send Moves for the duration, then exit."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--domain", type=int, required=True)
    parser.add_argument("--duration", type=float, default=1.0, help="s (default: 1)")
    args = parser.parse_args(argv)
    signal.pthread_sigmask(
        signal.SIG_BLOCK, {signal.SIGUSR1}
    )  # DDS's threads inherit the mask, so only sigwait receives the signal
    bus = Bus(DdsConfig(args.domain, "lo", ("127.0.0.1",)))
    sport = RpcClient(bus, ids.SPORT_SERVICE)
    deadline_ns = time.monotonic_ns() + round(_FIND_TIMEOUT_S * 1e9)
    while not sport.connected():
        if time.monotonic_ns() > deadline_ns:
            sys.stderr.write(f"rogue: no robot within {_FIND_TIMEOUT_S:g} s in domain {args.domain}\n")
            return 1
        time.sleep(0.01)
    print("rogue: ready", flush=True)
    signal.sigwait({signal.SIGUSR1})
    print(f"rogue: first {time.monotonic_ns()}", flush=True)
    for _ in range(max(1, round(args.duration * _RATE_HZ))):
        sport.send(ids.MOVE, move_parameter(_SPEED_MPS, 0.0, 0.0), noreply=True)
        time.sleep(1.0 / _RATE_HZ)
    bus.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
