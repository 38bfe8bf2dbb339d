"""A robot's side for the DDS part: publishes states at a high rate.

    python -m tools.memory.publisher DOMAIN

A process of its own, because samples of the same process do not pass through the network's buffers.
"""

from __future__ import annotations

import sys
import time

from firmware_bridge.core.config import DdsConfig
from firmware_bridge.dds.bus import Bus
from firmware_bridge.unitree.messages.idl import SportModeState_
from firmware_bridge.unitree.messages.ids import SPORT_STATE_TOPIC
from tools.memory.samples import sport_state

RATE_HZ = 4000.0
"""States a second, some 80 times a Go2's."""


def main(domain: int) -> None:
    """Publish until this process is ended."""
    bus = Bus(DdsConfig(interface="lo", domain=domain, peers=("127.0.0.1",)))
    writer = bus.writer(SPORT_STATE_TOPIC, SportModeState_, reliable=False)
    number, due_ns = 0, time.monotonic_ns()
    while True:
        number += 1
        writer.write(sport_state(number))
        due_ns += round(1e9 / RATE_HZ)
        time.sleep(max(0.0, (due_ns - time.monotonic_ns()) / 1e9))


if __name__ == "__main__":
    main(int(sys.argv[1]))
