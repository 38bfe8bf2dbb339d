"""`edge-bridge stop`, `arm` and `status`: an operator's connection to a running bridge, which may only stop or ask.

It is a second socket, so the runner need not let go of its own, and a newer operator replaces an older one, so nobody
can be in the way of an emergency stop.
"""

from __future__ import annotations

import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Final

from firmware_bridge.client import BridgeClient, BridgeUnavailable
from firmware_bridge.config import OPERATOR_SUFFIX
from firmware_bridge.link import BridgeStatus

CONFIRM_S: Final = 1.0
_POLL_S: Final = 0.005


def operate(command: str, socket: Path) -> tuple[int, dict[str, object]]:
    """Do `command` at the bridge that listens at `socket`, say on stderr what it is doing then.

    Returns the exit code (0 done, 1 not confirmed in time, 3 no bridge) and the status as JSON values.
    """
    try:
        client = BridgeClient(f"{socket}{OPERATOR_SUFFIX}")
        try:
            status = _ask(command, client)
        finally:
            client.close()
    except BridgeUnavailable as error:
        sys.stderr.write(f"edge-bridge: {error}\n")
        return 3, {"error": str(error)}
    if status is None:
        sys.stderr.write(f"edge-bridge: the bridge did not confirm within {CONFIRM_S:g} s; switch the robot off\n")
        return 1, {"error": "not confirmed"}
    blocked = "" if status.blocked_by == "none" else f"; arming is refused: {status.blocked_by}"
    sys.stderr.write(f"edge-bridge: {status.state}: {status.reason}{blocked}\n")
    return 0, asdict(status)


def _ask(command: str, client: BridgeClient) -> BridgeStatus | None:
    """The status that shows the command done; None when none has come in time."""
    asked_ns = 0 if command == "status" else time.monotonic_ns()
    if command == "stop":
        client.stop()
    elif command == "arm":
        client.arm()
    deadline_ns = time.monotonic_ns() + round(CONFIRM_S * 1e9)
    while time.monotonic_ns() < deadline_ns:
        status = client.poll()
        if status is not None and status.stamp_ns >= asked_ns and _is_done(command, status):
            return status
        time.sleep(_POLL_S)
    return None


def _is_done(command: str, status: BridgeStatus) -> bool:
    """A stop shows as the reason not to arm, with the robot stopped or never driven; an arm as that reason's end."""
    if command == "stop":
        return status.blocked_by == "estop" and status.state in ("stopped", "disarmed")
    return command != "arm" or status.blocked_by != "operator"
