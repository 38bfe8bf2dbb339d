"""Faults of the sport service: requests that are executed late, not answered, or lost."""

from __future__ import annotations

import time
from collections.abc import Callable

from firmware_bridge.unitree.messages import ids
from sim_hil.protocols.unitree.fault_commands import FaultCommand
from sim_hil.protocols.unitree.services.service import Answer, Received, ServiceServer
from sim_hil.protocols.unitree.services.sport import parse_move

Handle = Callable[[int, str], Answer]


class SportFaults:
    """Replacement of `ServiceServer.serve` for the sport service, with the active faults."""

    def __init__(self) -> None:
        self._on: dict[str, FaultCommand] = {}
        self._effects: list[tuple[str, int]] = []
        self._wants_move: float | None = None  # delay after the StopMove for the next Move, s; None: no late Move
        self._late_s = 0.0
        self._held: Received | None = None
        self._release_ns: int | None = None
        self._unanswered: list[tuple[int, Received, Answer]] = []

    def set(self, command: FaultCommand, now_ns: int) -> None:
        """Switch a fault on or off; a late Move takes effect when it reaches the robot."""
        if command.fault == "late-move":
            self._wants_move = command.number("delay_s") if command.on else None
            return
        if command.on:
            self._on[command.fault] = command
        else:
            self._on.pop(command.fault, None)
        self._effects.append((command.fault, now_ns))

    def clear(self) -> None:
        """Switch everything off."""
        self._on.clear()
        self._wants_move = self._held = self._release_ns = None

    def effects(self) -> list[tuple[str, int]]:
        """Return (fault, time ns) of the faults that have taken effect since the last call."""
        effects, self._effects = self._effects, []
        return effects

    def serve(self, server: ServiceServer, handle: Handle) -> list[Received]:
        """Handle the waiting requests; return all of them, obeyed or not."""
        arrived = []
        for request in server.requests():
            arrived.append(request)
            self._take(server, request, handle)
        self._overdue(server, handle)
        return arrived

    def _take(self, server: ServiceServer, request: Received, handle: Handle) -> None:
        if "deaf" in self._on:
            return
        if self._wants_move is not None and request.api_id == ids.MOVE and any(parse_move(request.parameter) or ()):
            self._held, self._late_s, self._wants_move = request, self._wants_move, None
            return
        now_ns = time.monotonic_ns()
        answer = server.answer(request, handle)
        slow = self._on.get("stop-unanswered") if request.api_id == ids.STOP_MOVE else None
        if slow is not None:
            self._unanswered.append((now_ns + round(slow.number("delay_s") * 1e9), request, answer))
        else:
            server.reply(request, *answer)
        if request.api_id == ids.STOP_MOVE and self._held is not None and self._release_ns is None:
            self._release_ns = now_ns + round(self._late_s * 1e9)

    def _overdue(self, server: ServiceServer, handle: Handle) -> None:
        now_ns = time.monotonic_ns()
        for entry in [entry for entry in self._unanswered if entry[0] <= now_ns]:
            self._unanswered.remove(entry)
            server.reply(entry[1], *entry[2])
        if self._held is not None and self._release_ns is not None and now_ns >= self._release_ns:
            handle(self._held.api_id, self._held.parameter)
            self._effects.append(("late-move", now_ns))
            self._held = self._release_ns = None
