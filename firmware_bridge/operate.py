"""`edge-bridge stop`, `arm` and `status`: an operator's connection to a running bridge, which may only stop or ask.

It is a second socket, so the runner need not let go of its own, and a newer operator replaces the oldest of several, so
nobody can be in the way of an emergency stop.
"""

from __future__ import annotations

import functools
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Final

from firmware_bridge.client import BridgeClient, BridgeUnavailable
from firmware_bridge.config import OPERATOR_SUFFIX
from firmware_bridge.link import BridgeStatus

CONFIRM_S: Final = 1.0
_POLL_S: Final = 0.005

Answer = BridgeStatus | BridgeUnavailable | None
"""Of one socket: the status that shows the command done, why there is no bridge, or None: not confirmed in time."""


def operate(command: str, *sockets: Path) -> tuple[int, dict[str, object]]:
    """Do `command` at every bridge that listens at one of `sockets`, say on stderr what they are doing then.

    Returns the exit code (0 done, 1 not confirmed by all in time, 3 no bridge) and a status as JSON values. `arm` is
    done at one bridge only: where several answer, the operator has to say which.
    """
    answers = _at_each("status" if command == "arm" else command, *sockets)
    reached = [socket for socket, answer in answers.items() if not isinstance(answer, BridgeUnavailable)]
    if command == "arm" and len(reached) > 1:
        return _refuse(f"bridges answer at {' and '.join(map(str, reached))}; say which with --socket")
    if command == "arm":
        answers |= _at_each(command, *reached)
    missing = {socket: answer for socket, answer in answers.items() if isinstance(answer, BridgeUnavailable)}
    hidden = [answer for answer in missing.values() if _is_hidden(answer)]
    statuses = [answer for answer in answers.values() if isinstance(answer, BridgeStatus)]
    if len(missing) == len(answers):
        return _refuse("; ".join(map(str, hidden or missing.values())))
    for status in statuses:
        blocked = "" if status.blocked_by == "none" else f"; arming is refused: {status.blocked_by}"
        sys.stderr.write(f"edge-bridge: {status.state}: {status.reason}{blocked}\n")
    for error in hidden:
        sys.stderr.write(f"edge-bridge: {error}\n")
    unconfirmed = len(statuses) < len(answers) - len(missing)
    if unconfirmed:
        sys.stderr.write(f"edge-bridge: the bridge did not confirm within {CONFIRM_S:g} s; switch the robot off\n")
    failed = unconfirmed or (command == "stop" and len(hidden) > 0)
    return int(failed), asdict(statuses[0]) if statuses else {"error": "not confirmed"}


def _refuse(why: str) -> tuple[int, dict[str, object]]:
    sys.stderr.write(f"edge-bridge: {why}\n")
    return 3, {"error": why}


def _is_hidden(error: BridgeUnavailable) -> bool:
    """Whether there may be a bridge that this user cannot reach."""
    return not isinstance(error.__cause__, (FileNotFoundError, ConnectionRefusedError))


def _at_each(command: str, *sockets: Path) -> dict[Path, Answer]:
    """At the same time: a bridge that hangs must not make another one wait for its stop."""
    if not sockets:
        return {}
    different = list(dict.fromkeys(sockets))
    with ThreadPoolExecutor(len(different)) as pool:
        return dict(zip(different, pool.map(functools.partial(_operate, command), different), strict=True))


def _operate(command: str, socket: Path) -> Answer:
    """Connect and ask; a stop is tried until CONFIRM_S has passed, whatever ends a connection."""
    deadline_ns = time.monotonic_ns() + round(CONFIRM_S * 1e9)
    while True:
        try:
            client = BridgeClient(f"{socket}{OPERATOR_SUFFIX}")
            try:
                return _ask(command, client)
            finally:
                client.close()
        except BridgeUnavailable as error:
            absent = isinstance(error.__cause__, (FileNotFoundError, ConnectionRefusedError, PermissionError))
            if command != "stop" or absent or time.monotonic_ns() >= deadline_ns:
                return error
            time.sleep(_POLL_S)


def _ask(command: str, client: BridgeClient) -> BridgeStatus | None:
    """The status that shows the command done; None when none has come in time."""
    asked_ns = 0 if command == "status" else time.monotonic_ns()
    if command == "arm":
        client.arm()
    deadline_ns = time.monotonic_ns() + round(CONFIRM_S * 1e9)
    while time.monotonic_ns() < deadline_ns:
        if command == "stop":
            client.stop()  # again and again: once more changes nothing, a lost one would
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
