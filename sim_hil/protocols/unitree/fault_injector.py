"""Fault socket of the Unitree front end, and the faults of the sport service: requests executed late or lost."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from firmware_bridge.unitree.messages import ids
from sim_hil.protocols.fault_socket import FaultEndpoint
from sim_hil.protocols.unitree.fault_commands import (
    CLEAR,
    KINDS,
    FaultCommand,
    FaultCommandError,
    parse,
)
from sim_hil.protocols.unitree.services.service import Answer, Received, ServiceServer
from sim_hil.protocols.unitree.services.sport import parse_move
from sim_hil.protocols.unitree.state import Remote
from sim_hil.protocols.unitree.state_faults import StateFaults

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


class FaultInjector(FaultEndpoint):
    """Owner of all faults of `edge-hil --faults`: accepts requests and passes each to the component that causes it.

    A request is one JSON object per datagram. The answer is {"fault", "on", "effect_ns"} once the fault has taken
    effect, or {"error"}. Raises OSError if the socket cannot be created at `path`.
    """

    def __init__(self, path: Path, *, remote: Remote, camera: Callable[[bytes], None]) -> None:
        """Create the socket; `camera` sends a line to the camera process."""
        super().__init__(path)
        self.states = StateFaults()
        self.sport = SportFaults()
        self._remote = remote
        self._camera = camera
        self._open_requests: dict[str, tuple[FaultCommand, str]] = {}  # by fault: command and sender
        self._injected: set[str] = set()

    def poll(self, now_ns: int) -> None:
        """Handle the requests that have arrived and report effects since the last poll, without waiting."""
        for data, sender in self._received():
            try:
                self._switch(parse(data), sender, now_ns)
            except FaultCommandError as error:
                self._answer(sender, {"error": str(error)})
        for name, effect_ns in (*self.states.effects(), *self.sport.effects()):
            self.took_effect(name, effect_ns)

    def injected(self) -> tuple[str, ...]:
        """Return the faults that are switched on; one that happens once is on until it is switched off."""
        return tuple(sorted(self._injected))

    def took_effect(self, fault: str, effect_ns: int) -> None:
        """Answer the request for a fault that has taken effect."""
        request = self._open_requests.pop(fault, None)
        if request is not None:
            command, sender = request
            self._answer(sender, {"fault": fault, "on": command.on, "effect_ns": effect_ns})

    def _switch(self, command: FaultCommand, sender: str, now_ns: int) -> None:
        if command.fault == CLEAR:
            self._open_requests.clear()
            self._injected.clear()
            self.states.clear()
            self.sport.clear()
            self._remote.release()
            self._camera(command.line())
            self._answer(sender, {"fault": CLEAR, "on": False, "effect_ns": now_ns})
            return
        self._open_requests[command.fault] = (command, sender)
        (self._injected.add if command.on else self._injected.discard)(command.fault)
        where = KINDS[command.fault].where
        if where == "camera":
            self._camera(command.line())
        elif where == "sport":
            self.sport.set(command, now_ns)
        elif where == "state":
            self.states.set(command, now_ns)
        else:
            self._press(command)
            self.took_effect(command.fault, now_ns)

    def _press(self, command: FaultCommand) -> None:
        if not command.on:
            self._remote.release()
        elif command.fault == "remote-keys":
            self._remote.keys = round(command.number("keys"))
        else:
            self._remote.ly = command.number("ly")
