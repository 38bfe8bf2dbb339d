"""The local socket that faults are asked for at, and who makes which. One object owns all of `edge-hil --faults`."""

from __future__ import annotations

import contextlib
import json
import os
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Final

from sim_hil.protocols.unitree.fault_commands import (
    CLEAR,
    KINDS,
    MAX_LINE_BYTES,
    FaultCommand,
    FaultCommandError,
    parse,
)
from sim_hil.protocols.unitree.remote import Remote
from sim_hil.protocols.unitree.request_faults import SportFaults
from sim_hil.protocols.unitree.state_faults import StateFaults

_MAX_COMMANDS_A_POLL: Final = 16


class FaultInjector:
    """Takes one JSON object a datagram; answers {"fault", "on", "effect_ns"} when it has taken effect, or {"error"}.

    Raises OSError when the socket cannot be made at `path`.
    """

    def __init__(self, path: Path, *, remote: Remote, camera: Callable[[bytes], None]) -> None:
        """`camera` sends a line to the camera process."""
        self.states = StateFaults()
        self.sport = SportFaults()
        self._remote = remote
        self._camera = camera
        self._path = path
        self._asked: dict[str, tuple[FaultCommand, str]] = {}  # who waits to hear of a fault's effect
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        umask = os.umask(0o177)
        try:
            self._socket.bind(str(path))
        except OSError as error:
            self._socket.close()
            raise OSError(f"--faults {path}: expected a free path for a socket, {error.strerror}") from error
        finally:
            os.umask(umask)
        self._socket.setblocking(False)

    def poll(self, now_ns: int) -> None:
        """Take the commands that have come and tell of the effects since the last poll; never waits."""
        for _ in range(_MAX_COMMANDS_A_POLL):
            try:
                data, sender = self._socket.recvfrom(MAX_LINE_BYTES + 1)
            except BlockingIOError:
                break
            try:
                self._switch(parse(data), sender, now_ns)
            except FaultCommandError as error:
                self._answer(sender, {"error": str(error)})
        for name, effect_ns in (*self.states.effects(), *self.sport.effects()):
            self.took_effect(name, effect_ns)

    def took_effect(self, fault: str, effect_ns: int) -> None:
        """Tell whoever asked for it."""
        asked = self._asked.pop(fault, None)
        if asked is not None:
            command, sender = asked
            self._answer(sender, {"fault": fault, "on": command.on, "effect_ns": effect_ns})

    def close(self) -> None:
        """Close and remove the socket."""
        self._socket.close()
        self._path.unlink(missing_ok=True)

    def _switch(self, command: FaultCommand, sender: str, now_ns: int) -> None:
        if command.fault == CLEAR:
            self._asked.clear()
            self.states.clear()
            self.sport.clear()
            self._remote.release()
            self._camera(command.line())
            self._answer(sender, {"fault": CLEAR, "on": False, "effect_ns": now_ns})
            return
        self._asked[command.fault] = (command, sender)
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

    def _answer(self, sender: str, answer: dict[str, object]) -> None:
        if sender:  # an unbound socket has no address to answer to
            with contextlib.suppress(OSError):  # it has gone or does not read
                self._socket.sendto(json.dumps(answer).encode(), sender)
