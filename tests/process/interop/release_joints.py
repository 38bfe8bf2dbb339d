"""Releases a simulated Go2's joints from its sport controller, for clients that only know low commands.

usage: release_joints.py DOMAIN INTERFACE
"""

from __future__ import annotations

import sys

from firmware_bridge.core.config import DdsConfig
from firmware_bridge.dds.bus import Bus
from firmware_bridge.unitree.messages import ids
from firmware_bridge.unitree.rpc import RpcClient


def main() -> None:
    bus = Bus(DdsConfig(int(sys.argv[1]), sys.argv[2]))
    RpcClient(bus, ids.MOTION_SWITCHER_SERVICE).call(1003, "{}", timeout_s=30)
    bus.close()


if __name__ == "__main__":
    main()
