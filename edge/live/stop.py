"""Carries out the live view's STOP: as an operator of the bridge and, unless that is soon confirmed, by the runner."""

from __future__ import annotations

import asyncio
import enum
import functools
import socket
from pathlib import Path
from typing import Any, Final

from edge.core.cli import EXIT_DONE, EXIT_REFUSED
from edge.live import wire
from firmware_bridge.operate import operate

OPERATOR_FIRST_S: Final = 0.5
"""Time that the operator's stop has for itself, s; then the runner is requested to stop as well."""
ANSWER_S: Final = 3.0
"""Time for either of them to confirm the stop after that, s: the robot comes to rest within 2 s."""
LAST_S: Final = 4.0
"""Time for the stops under way when the runner has ended, s."""


class OperatorStop(enum.Enum):
    """Outcome of an operator's stop; the value tells the user what it means for the next arming."""

    STANDS = "Before it moves again: edge-bridge arm"
    IN_EFFECT = "The operator's stop is in effect. Before it moves again: edge-bridge arm"
    """The bridge refuses to arm because of it, and the robot did not report standstill in time."""
    UNKNOWN = "It is unknown whether the operator's stop is in effect: a new run may arm"
    IMPOSSIBLE = "No operator's stop was possible: a new run can arm"


class RobotStop:
    """Stops of one robot, each within OPERATOR_FIRST_S + ANSWER_S. `runner`: the socket to it."""

    def __init__(self, bridge: Path, runner: socket.socket) -> None:
        self._bridge, self._runner = bridge, runner
        self._stops: set[asyncio.Task[dict[str, Any]]] = set()
        self._answer: asyncio.Future[bool] | None = None

    async def stop(self) -> dict[str, Any]:
        """Stop the robot; return the answer for the page. A client that leaves does not end its stop."""
        stop = asyncio.create_task(self._stop())
        self._stops.add(stop)
        stop.add_done_callback(self._stops.discard)
        return await asyncio.shield(stop)

    def answered(self, confirmed: bool) -> None:
        """Take the runner's answer: whether its bridge has confirmed the stop."""
        if self._answer is not None and not self._answer.done():
            self._answer.set_result(confirmed)

    async def finish(self) -> None:
        """Wait until the stops under way are answered; the runner has ended."""
        self.answered(False)
        if self._stops:
            await asyncio.wait(self._stops, timeout=LAST_S)

    async def _stop(self) -> dict[str, Any]:
        operator = asyncio.create_task(_stop_as_operator(self._bridge))
        await asyncio.wait({operator}, timeout=OPERATOR_FIRST_S)
        by_runner = False
        if _outcome(operator) is not OperatorStop.STANDS:
            runner = asyncio.create_task(self._stop_by_runner())
            await asyncio.wait({operator}, timeout=ANSWER_S)
            by_runner = _outcome(operator) is not OperatorStop.STANDS and await runner
        found = _outcome(operator)
        if found is OperatorStop.STANDS:
            text = f"stopped: the robot reports that it stands. {found.value}"
        elif by_runner:
            text = f"stopped by the runner, whose bridge confirms it. {found.value}"
        else:
            text = "NOT CONFIRMED: use the robot's remote, or switch the robot off"
        latched = found in (OperatorStop.STANDS, OperatorStop.IN_EFFECT)
        return {"stopped": found is OperatorStop.STANDS or by_runner, "latched": latched, "text": text}

    async def _stop_by_runner(self) -> bool:
        """Request a stop of the runner; return whether its bridge has confirmed it."""
        if self._answer is None or self._answer.done():
            self._answer = asyncio.get_running_loop().create_future()
        answer = self._answer
        try:
            self._runner.send(wire.Datagram(wire.STOP).encode())  # every time: an earlier one may be lost
            return await asyncio.wait_for(asyncio.shield(answer), ANSWER_S)
        except (OSError, asyncio.TimeoutError):
            return False


async def _stop_as_operator(bridge: Path) -> OperatorStop:
    """Stop the robot by the operator's socket of its bridge; return the outcome."""
    quiet = functools.partial(operate, "stop", bridge, say=lambda line: None)  # a terminal may block or be gone
    try:
        code, status = await asyncio.get_running_loop().run_in_executor(None, quiet)
    except Exception:  # noqa: BLE001 - whatever it is, the runner still stops the robot
        return OperatorStop.UNKNOWN
    if code == EXIT_DONE:
        return OperatorStop.STANDS
    if status.get("blocked_by") == "estop":
        return OperatorStop.IN_EFFECT
    return OperatorStop.IMPOSSIBLE if code == EXIT_REFUSED else OperatorStop.UNKNOWN


def _outcome(stop: asyncio.Task[OperatorStop]) -> OperatorStop:
    """Return the outcome of an operator's stop so far."""
    return stop.result() if stop.done() else OperatorStop.UNKNOWN
