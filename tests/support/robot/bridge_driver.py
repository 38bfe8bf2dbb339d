"""The smallest runner there is: arms and drives through BridgeClient at 10 Hz until somebody ends it.

usage: python -m tests.support.robot.bridge_driver SOCKET VX_MPS
"""

from __future__ import annotations

import sys
import time

from firmware_bridge.client import BridgeClient


def main() -> None:
    client = BridgeClient(sys.argv[1])
    seq, driven = 0, False
    while True:
        if seq % 10 == 0 and not driven:  # as edge-run asks while it waits for an operator
            client.arm()
        status = client.poll()
        armed = status is not None and status.state == "armed"
        driven = driven or armed
        seq += 1
        client.send_velocity(seq, time.monotonic_ns(), float(sys.argv[2]) if armed else 0.0, 0.0, 0.0)
        if seq == 1:
            sys.stderr.write("driver: ready\n")
            sys.stderr.flush()
        time.sleep(0.1)


if __name__ == "__main__":
    main()
