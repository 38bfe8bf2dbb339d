"""Do something as another user, for tests that run as root: everything is imported before the rights are given up.

usage: python -m tests.support.robot.as_user UID GID,GID... bridge ARGUMENT...
       python -m tests.support.robot.as_user UID GID,GID... connect SOCKET
       python -m tests.support.robot.as_user UID GID,GID... listen SOCKET
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

from firmware_bridge import bridge
from firmware_bridge.client import BridgeClient, BridgeUnavailable
from firmware_bridge.client_link import ClientLink
from firmware_bridge.core.link import BridgeStatus
from firmware_bridge.unitree import robot_link  # noqa: F401 - what the bridge imports when it serves


def main() -> int:
    uid, groups, action, *arguments = sys.argv[1:]
    numbers = [int(number) for number in groups.split(",")]
    os.setgroups(numbers)
    os.setgid(numbers[0])
    os.setuid(int(uid))
    if action == "bridge":
        return bridge.main(arguments)
    if action == "listen":
        link, zero = ClientLink(Path(arguments[0])), (0.0, 0.0, 0.0)
        Path(arguments[0]).chmod(0o666)
        sys.stderr.write("ready\n")
        while True:
            link.receive()
            link.send_status(BridgeStatus(time.monotonic_ns(), "armed", "believe me", 0, 0, 0, zero, False))
            time.sleep(0.01)
    try:
        BridgeClient(arguments[0]).close()
    except BridgeUnavailable as error:
        sys.stdout.write(str(error))
        return 1
    sys.stdout.write("connected")
    return 0


if __name__ == "__main__":
    sys.exit(main())
