"""Carries out the live view's STOP: as an operator of the bridge and, unless that is soon confirmed, by the runner."""

from __future__ import annotations

import asyncio
import functools
import socket
from pathlib import Path
from typing import Any, Final

from edge.live import wire
from firmware_bridge.operate import operate

OPERATOR_FIRST_S: Final = 0.5
"""Time that the operator's stop has for itself, s; then the runner is requested to stop as well."""
ANSWER_S: Final = 3.0
"""Time for either of them to confirm the stop after that, s: the robot comes to rest within 2 s."""
LAST_S: Final = 4.0
"""Time for the stops under way when the runner has ended, s."""


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
        if not _confirms(operator):
            runner = asyncio.create_task(self._stop_by_runner())
            await asyncio.wait({operator}, timeout=ANSWER_S)
            if not _confirms(operator) and await runner:
                text = "stopped by the runner, whose bridge confirms it. No operator's stop was possible: "
                return {"stopped": True, "latched": False, "text": f"{text}a new run can arm"}
        if _confirms(operator):
            text = "stopped: the robot reports that it stands. Before it moves again: edge-bridge arm"
            return {"stopped": True, "latched": True, "text": text}
        text = "NOT CONFIRMED: use the robot's remote, or switch the robot off"
        return {"stopped": False, "latched": False, "text": text}

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


async def _stop_as_operator(bridge: Path) -> bool:
    """Stop the robot by the operator's socket of its bridge; return whether the bridge reports standstill."""
    quiet = functools.partial(operate, "stop", bridge, say=lambda line: None)  # a terminal may block or be gone
    try:
        code, _ = await asyncio.get_running_loop().run_in_executor(None, quiet)
    except Exception:  # noqa: BLE001 - whatever it is, the runner still stops the robot
        return False
    return code == 0


def _confirms(stop: asyncio.Task[bool]) -> bool:
    return stop.done() and stop.result()
