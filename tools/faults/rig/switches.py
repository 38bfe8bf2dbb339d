"""Faults of a process, switched through a local socket, which answers with the time of the effect."""

from __future__ import annotations

import contextlib
import json
import socket
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any


class Switches:
    """Active faults and their parameters; a thread listens at `path` for the same lines as `edge-hil --faults`.

    The answer to switching a fault on comes when its code runs (`hit`) for the `after`-th time (default: the first);
    switching off takes effect at once.
    """

    def __init__(self, path: Path, names: Iterable[str]) -> None:
        self._names = frozenset(names)
        self._on: dict[str, dict[str, Any]] = {}
        self._pending: dict[str, tuple[str, int]] = {}  # sender of the request, and number of hits until the answer
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        threading.Thread(target=self._listen, name="fault-switches", daemon=True).start()

    def hit(self, name: str) -> dict[str, Any] | None:
        """Return the parameters of a fault that is on, None when it is off."""
        values = self._on.get(name)
        if values is not None and self._pending:
            pending = self._pending.pop(name, None)
            if pending is not None:
                sender, left = pending
                if left > 1:
                    self._pending[name] = (sender, left - 1)
                else:
                    self._answer(sender, {"fault": name, "on": True, "effect_ns": time.monotonic_ns()})
        return values

    def _listen(self) -> None:
        while True:
            data, sender = self._socket.recvfrom(4096)
            now_ns = time.monotonic_ns()
            try:
                table = json.loads(data)
                name, on = table.pop("fault"), table.pop("on", True)
            except (ValueError, KeyError, AttributeError, TypeError):
                self._answer(sender, {"error": f"expected a fault, found {data[:60]!r}"})
                continue
            if name == "clear":
                self._on = {}
            elif name not in self._names:
                self._answer(sender, {"error": f"expected one of {', '.join(sorted(self._names))}, found {name!r}"})
                continue
            elif on:
                self._pending[name] = (sender, int(table.pop("after", 1)))
                self._on = {**self._on, name: table}
                continue
            else:
                self._on = {key: value for key, value in self._on.items() if key != name}
            self._answer(sender, {"fault": name, "on": False, "effect_ns": now_ns})

    def _answer(self, address: str, answer: dict[str, object]) -> None:
        if address:
            with contextlib.suppress(OSError):  # the sender has ended
                self._socket.sendto(json.dumps(answer).encode(), address)
