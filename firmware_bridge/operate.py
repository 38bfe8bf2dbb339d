"""`edge-bridge stop`, `arm`, `release` and `status`: an operator's connection to a running bridge.

Operators have a second socket, apart from the runner's. A newer operator replaces the oldest of several, so no idle
operator can block an emergency stop. Only the robot's own speed confirms a stop.
"""

from __future__ import annotations

import functools
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from firmware_bridge.client import BridgeClient, BridgeUnavailable
from firmware_bridge.core.config import (
    OPERATOR_SUFFIX,
    ROBOT_FILE_SOCKET,
    SERVICE_SOCKET,
    ConfigError,
    load_robot_config,
    runtime_dirs,
)
from firmware_bridge.core.link import BridgeStatus, Stop
from firmware_bridge.system.terminal import one_line, print_line

CONFIRM_S: Final = 1.0
_STAND_S: Final = 2.0  # for the robot to come to rest and report it: 0.8 m/s at 1 m/s2, and half as much again
_MOVES_ON_S: Final = 0.7  # time after a stop at which the operator is warned that the robot still moves
_POLL_S: Final = 0.005
_USE_REMOTE: Final = "press L2 and B on its remote, or switch it off"


@dataclass(frozen=True)
class Unconfirmed:
    """A bridge answered but did not confirm the command; `status` is its newest, None without one."""

    status: BridgeStatus | None


Answer = BridgeStatus | BridgeUnavailable | Unconfirmed
"""Result of one socket: the confirming status, the reason for no bridge, or a missing confirmation."""
Say = Callable[[str], None]
"""Takes a line for the operator; any thread may call it."""


def _write(text: str) -> None:
    """Write one line of `edge-bridge` to stderr."""
    print_line(f"edge-bridge: {text}")


def sockets_of(command: str, robot: str, socket: Path | None, say: Say = _write) -> tuple[Path, ...]:
    """Return the sockets at which `command` looks for a bridge: `socket` alone, or the service's and the robot file's.

    Where the robot file names no folder, also those that exist where another kind of shell of this user has them.
    Raises ConfigError for a robot file that cannot be used; a stop is sent to the usual places then.
    """
    try:
        own = load_robot_config(robot, socket=socket).bridge.socket
    except ConfigError as error:
        if command != "stop":
            raise
        say(one_line(error))
        own = socket or runtime_dirs()[0] / ROBOT_FILE_SOCKET
    if socket:
        return (own,)
    usual, *others = runtime_dirs()
    found = [place / own.name for place in others if own.parent == usual and os.path.lexists(place / own.name)]
    return (SERVICE_SOCKET, own, *found)


def operate(command: str, *sockets: Path, say: Say = _write) -> tuple[int, dict[str, object]]:
    """Send `command` to every bridge that listens at one of `sockets`; report their states to `say`, line by line.

    Returns the exit code (0 done, 1 not confirmed by all in time, 3 refused or no bridge) and a status as JSON values.
    `arm` needs a single bridge: where several answer, the operator has to choose one.
    """
    answers = _at_each("status" if command == "arm" else command, say, *sockets)
    reached = [socket for socket, answer in answers.items() if not isinstance(answer, BridgeUnavailable)]
    if command == "arm" and len(reached) > 1:
        return _refuse(say, f"bridges answer at {' and '.join(map(str, reached))}; choose one with --socket")
    if command == "arm":
        answers |= _at_each(command, say, *reached)
    missing = [answer for answer in answers.values() if isinstance(answer, BridgeUnavailable)]
    hidden = [answer for answer in missing if _is_hidden(answer) or (command == "stop" and _has_died(answer))]
    unconfirmed = [answer for answer in answers.values() if isinstance(answer, Unconfirmed)]
    statuses = [answer for answer in answers.values() if isinstance(answer, BridgeStatus)]
    if len(missing) == len(answers):
        advice = f"; the robot was NOT stopped: {_USE_REMOTE}" if command == "stop" and hidden else ""
        return _refuse(say, "; ".join(map(str, hidden or missing)) + advice)
    for status in (*statuses, *(answer.status for answer in unconfirmed if answer.status is not None)):
        blocked = "" if status.blocked_by == "none" else f"; arming is refused: {status.blocked_by}"
        say(f"{status.state}: {status.reason}{blocked}")
    if command == "arm" and any(status.permit == "not needed" for status in statuses):
        say("no permission is needed: the runner arms by itself")
    for socket, answer in answers.items():
        if answer in hidden:
            died = isinstance(answer, BridgeUnavailable) and _has_died(answer)
            advice = f"its robot is NOT stopped: {_USE_REMOTE}; then start that bridge again"
            say(f"the bridge of {socket} has died: {advice}" if died else one_line(answer))
    for answer in unconfirmed:
        say(_why_unconfirmed(command, answer.status))
    values = statuses[0] if statuses else next((answer.status for answer in unconfirmed if answer.status), None)
    result: dict[str, object] = {"error": "not confirmed"} if values is None else asdict(values)
    if command == "arm" and unconfirmed and unconfirmed[0].status is not None:
        return 3, result
    return int(bool(unconfirmed) or (command == "stop" and bool(hidden))), result


def _why_unconfirmed(command: str, status: BridgeStatus | None) -> str:
    if status is None:
        return f"the bridge did not confirm within {CONFIRM_S:g} s: {_USE_REMOTE}"
    if command == "stop" and status.motion == "moving":
        return f"STOPPED, BUT THE ROBOT STILL MOVES at {status.speed_mps:.2f} m/s: {_USE_REMOTE}"
    if command == "stop":
        return f"the bridge has stopped, but the robot does not report that it stands still: check it, or {_USE_REMOTE}"
    return f"{command} was not confirmed within {CONFIRM_S:g} s"


def _refuse(say: Say, why: str) -> tuple[int, dict[str, object]]:
    say(one_line(why))
    return 3, {"error": why}


def _is_hidden(error: BridgeUnavailable) -> bool:
    """Whether there may be a bridge that this user cannot reach."""
    return not isinstance(error.__cause__, (FileNotFoundError, ConnectionRefusedError))


def _has_died(error: BridgeUnavailable) -> bool:
    """Whether a bridge ended without removing its socket: its robot may still move."""
    return isinstance(error.__cause__, ConnectionRefusedError)


def _at_each(command: str, say: Say, *sockets: Path) -> dict[Path, Answer]:
    """Send to all sockets at the same time: a bridge that hangs must not delay another one's stop."""
    if not sockets:
        return {}
    different = list(dict.fromkeys(sockets))
    with ThreadPoolExecutor(len(different)) as pool:
        return dict(zip(different, pool.map(functools.partial(_operate, command, say), different), strict=True))


def _operate(command: str, say: Say, socket: Path) -> Answer:
    """Connect and send; a stop is repeated until CONFIRM_S has passed, whatever ends a connection."""
    deadline_ns, died = time.monotonic_ns() + round(CONFIRM_S * 1e9), None
    while True:
        try:
            # A bridge that does not run now reads the stop as soon as it runs again.
            client = BridgeClient(f"{socket}{OPERATOR_SUFFIX}", first=Stop() if command == "stop" else None)
            try:
                return _stop(client, say) if command == "stop" else _ask(command, client)
            finally:
                client.close()
        except BridgeUnavailable as error:
            died = error if _has_died(error) else died
            # A bridge that starts again removes the socket of the one that was killed before it makes its own.
            absent = isinstance(error.__cause__, (FileNotFoundError, PermissionError)) and died is None
            if command != "stop" or absent or time.monotonic_ns() >= deadline_ns:
                return died or error
            time.sleep(_POLL_S)


def _stop(client: BridgeClient, say: Say) -> BridgeStatus | Unconfirmed:
    """Stop, and poll until the robot reports standstill; warn as soon as it does not obey."""
    asked_ns = time.monotonic_ns()
    latched = _follow(client, asked_ns, CONFIRM_S, _is_latched, again=client.stop)
    if isinstance(latched, Unconfirmed):
        return latched
    answer = _follow(client, asked_ns, _MOVES_ON_S, lambda status: _is_latched(status) and status.motion == "still")
    if isinstance(answer, Unconfirmed):
        moves = answer.status is not None and answer.status.motion == "moving"
        state = "the robot still moves" if moves else "no report that the robot stands still yet"
        say(f"stop sent; {state}: be ready to {_USE_REMOTE}")
        answer = _follow(client, asked_ns, _STAND_S, lambda status: _is_latched(status) and status.motion == "still")
    return answer


def _ask(command: str, client: BridgeClient) -> BridgeStatus | Unconfirmed:
    """Return the status that confirms the command."""
    asked_ns = 0 if command == "status" else time.monotonic_ns()
    if command == "arm":
        client.arm()
    elif command == "release":
        client.release()
    return _follow(client, asked_ns, CONFIRM_S, functools.partial(_is_done, command))


def _follow(
    client: BridgeClient,
    since_ns: int,
    limit_s: float,
    done: Callable[[BridgeStatus], bool],
    again: Callable[[], object] = lambda: None,
) -> BridgeStatus | Unconfirmed:
    """Return the first status after `since_ns` for which `done` is true, within `limit_s` of `since_ns` or of now.

    `again` is called before every poll: repeating a stop is harmless, losing one is not.
    """
    deadline_ns = (since_ns or time.monotonic_ns()) + round(limit_s * 1e9)
    status = None
    while time.monotonic_ns() < deadline_ns:
        again()
        status = client.poll()
        if status is not None and status.stamp_ns >= since_ns and done(status):
            return status
        time.sleep(_POLL_S)
    return Unconfirmed(status)


def _is_latched(status: BridgeStatus) -> bool:
    """Return whether a stop is in effect: it is the reason not to arm, and the robot is stopped or was never driven."""
    return status.blocked_by == "estop" and status.state in ("stopped", "disarmed")


def _is_done(command: str, status: BridgeStatus) -> bool:
    """Return whether an arm or release is in effect: a permission was given, or the zeros have ended."""
    if command == "arm":
        return status.permit != "needed" or status.state in ("arming", "armed")
    return command != "release" or (status.state in ("stopped", "disarmed") and not status.zero_after_stop)
