"""Fault socket of the Unitree front end; it passes each fault to the component that causes it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from sim_hil.protocols.fault_socket import FaultEndpoint
from sim_hil.protocols.unitree.fault_commands import (
    CLEAR,
    KINDS,
    FaultCommand,
    FaultCommandError,
    parse,
)
from sim_hil.protocols.unitree.remote import Remote
from sim_hil.protocols.unitree.request_faults import SportFaults
from sim_hil.protocols.unitree.state_faults import StateFaults


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

    def poll(self, now_ns: int) -> None:
        """Handle the requests that have arrived and report effects since the last poll, without waiting."""
        for data, sender in self._received():
            try:
                self._switch(parse(data), sender, now_ns)
            except FaultCommandError as error:
                self._answer(sender, {"error": str(error)})
        for name, effect_ns in (*self.states.effects(), *self.sport.effects()):
            self.took_effect(name, effect_ns)

    def took_effect(self, fault: str, effect_ns: int) -> None:
        """Answer the request for a fault that has taken effect."""
        request = self._open_requests.pop(fault, None)
        if request is not None:
            command, sender = request
            self._answer(sender, {"fault": fault, "on": command.on, "effect_ns": effect_ns})

    def _switch(self, command: FaultCommand, sender: str, now_ns: int) -> None:
        if command.fault == CLEAR:
            self._open_requests.clear()
            self.states.clear()
            self.sport.clear()
            self._remote.release()
            self._camera(command.line())
            self._answer(sender, {"fault": CLEAR, "on": False, "effect_ns": now_ns})
            return
        self._open_requests[command.fault] = (command, sender)
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
