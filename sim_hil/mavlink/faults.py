"""`edge-hil --protocol mavlink --faults PATH`: the base's red button and a dead radio, switched while it runs.

One JSON object a datagram: {"fault": "button"|"mute"|"clear", "on": true|false}. A held button stops the base; with
"mute" nothing is heard or sent. The answer is {"fault", "on", "effect_ns"} or {"error"}.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import time
from pathlib import Path
from typing import Final

CLEAR: Final = "clear"
SWITCHES: Final = ("button", "mute")
_MAX_BYTES: Final = 2000
_MAX_A_POLL: Final = 16


class MavlinkFaults:
    """`button` and `mute` are what is asked for now; `poll` takes in what has come. Raises OSError."""

    def __init__(self, path: Path) -> None:
        self.button = self.mute = False
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
        if not isinstance(table, dict) or set(table) - {"fault", "on"} or not isinstance(table.get("on", True), bool):
            raise ValueError(f"expected a JSON object with fault and on (true or false), found {data[:60]!r}")
        name, on = table.get("fault"), table.get("on", True)
        if name == CLEAR:
            self.button = self.mute = on = False
        elif name in SWITCHES:
            setattr(self, name, on)
        else:
            raise ValueError(f"expected one of {', '.join((*SWITCHES, CLEAR))}, found {name!r}")
        return {"fault": name, "on": on, "effect_ns": time.monotonic_ns()}

    def close(self) -> None:
        """Close and remove the socket."""
        self._socket.close()
        self._path.unlink(missing_ok=True)
