"""`edge-hil --protocol can --faults PATH`: faults of the bus, and the base's red button, switched while it runs.

One JSON object a datagram: {"fault": NAME, "on": true|false, "value": NUMBER}. The names are the fields of `FaultPlan`
with their values, "button" (held down) and "bus_off", which need none; {"fault": "clear"} ends all. The answer is
{"fault", "on", "effect_ns"} or {"error"}.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import time
from dataclasses import fields, replace
from pathlib import Path
from typing import Final

from sim_hil.can.shim import FaultPlan

CLEAR: Final = "clear"
SWITCHES: Final = ("button", "bus_off")
_FIELDS: Final = tuple(each.name for each in fields(FaultPlan))
_MAX_BYTES: Final = 2000
_MAX_A_POLL: Final = 16
_LARGEST: Final = 1e9


class CanFaults:
    """`plan`, `button` and `bus_off` are what is asked for now; `poll` takes in what has come. Raises OSError."""

    def __init__(self, path: Path, plan: FaultPlan) -> None:
        """`plan`: in force until it is changed, and what "clear" and "off" go back to."""
        self._begin = self.plan = plan
        self.button = self.bus_off = False
        self._path = path
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

    def poll(self) -> None:
        """Take in the commands that have come; never waits."""
        for _ in range(_MAX_A_POLL):
            try:
                data, sender = self._socket.recvfrom(_MAX_BYTES + 1)
            except BlockingIOError:
                return
            try:
                answer = self._switch(data)
            except ValueError as error:
                answer = {"error": str(error)}
            if sender:  # an unbound socket has no address to answer to
                with contextlib.suppress(OSError):  # it has gone or does not read
                    self._socket.sendto(json.dumps(answer).encode(), sender)

    def _switch(self, data: bytes) -> dict[str, object]:
        try:
            table = json.loads(data) if len(data) <= _MAX_BYTES else None
        except (ValueError, RecursionError):
            table = None
        if not isinstance(table, dict):
            raise ValueError(f"expected a JSON object of at most {_MAX_BYTES} bytes, found {data[:60]!r}")
        name, on, value = table.pop("fault", None), table.pop("on", True), table.pop("value", None)
        if table or not isinstance(on, bool):
            raise ValueError(f"expected fault, on and value, found {', '.join(map(str, table)) or f'on {on!r}'}")
        if name == CLEAR:
            self.plan, self.button, self.bus_off, on = self._begin, False, False, False
        elif name in SWITCHES and value is None:
            setattr(self, name, on)
        elif name in _FIELDS:
            self.plan = replace(self.plan, **{name: self._value(name, on, value)})
        else:
            known = ", ".join((*SWITCHES, *_FIELDS, CLEAR))
            raise ValueError(f"expected one of {known}, found {name!r} with value {value!r}")
        return {"fault": name, "on": on, "effect_ns": time.monotonic_ns()}

    def _value(self, name: str, on: bool, value: object) -> float:
        if not on:
            return float(getattr(self._begin, name))
        # An integer may be longer than any float.
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= _LARGEST:
            raise ValueError(f"{name}: expected a number up to {_LARGEST:g} as value, found {str(value)[:60]}")
        return float(value)

    def close(self) -> None:
        """Close and remove the socket."""
        self._socket.close()
        self._path.unlink(missing_ok=True)
