"""Client of a fault socket, for `edge-hil --faults` and for the runner of the fault rig."""

from __future__ import annotations

import json
import socket
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Final

_POLL_S = 0.01


class FaultError(RuntimeError):
    """A fault that could not be injected; one line with its name and the cause."""


TIMEOUT_S: Final = 5.0
"""Default timeout until a fault takes effect, s."""


class FaultClient:
    """Client that requests faults and waits until they take effect; a context manager with its own socket path."""

    def __init__(self, server: Path, own: Path) -> None:
        """Bind the client. `server`: path of the fault socket; `own`: free path for answers. Raises OSError."""
        self._server = server
        self._own = own
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(own))

    def __enter__(self) -> FaultClient:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def ask(self, fault: str, *, on: bool = True, **values: float | str) -> None:
        """Request a fault without waiting for its effect. Raises FaultError if the server does not listen."""
        line = json.dumps({"fault": fault, **({} if fault == "clear" else {"on": on}), **values}).encode()
        try:
            self._socket.sendto(line, str(self._server))
        except OSError as error:
            raise FaultError(f"{fault}: no process accepts faults at {self._server.name}: {error.strerror}") from error

    def effect_ns(self, fault: str, timeout_s: float = TIMEOUT_S) -> int:
        """Wait for the requested fault and return the time of its effect, monotonic ns. Raises FaultError."""
        deadline_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        while True:
            left_s = (deadline_ns - time.monotonic_ns()) / 1e9
            if left_s <= 0:
                raise FaultError(f"{fault}: no effect within {timeout_s:g} s")
            self._socket.settimeout(left_s)
            try:
                answer = json.loads(self._socket.recv(4096))
            except TimeoutError:
                continue
            if "error" in answer:
                raise FaultError(f"{fault}: refused: {answer['error']}")
            if answer["fault"] == fault:
                return int(answer["effect_ns"])

    def inject(self, fault: str, *, on: bool = True, timeout_s: float = TIMEOUT_S, **values: float | str) -> int:
        """Request a fault and return the time of its effect, monotonic ns; discards older answers first."""
        self.answers()
        self.ask(fault, on=on, **values)
        return self.effect_ns(fault, timeout_s)

    def wait_for_server(self, timeout_s: float) -> None:
        """Wait until the server's socket exists. Raises FaultError."""
        deadline_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        while not self._server.exists():
            if time.monotonic_ns() > deadline_ns:
                raise FaultError(f"no fault socket {self._server.name} within {timeout_s:g} s")
            time.sleep(_POLL_S)

    def close(self) -> None:
        """Close and remove the own socket."""
        self._socket.close()
        self._own.unlink(missing_ok=True)

    def answers(self) -> list[dict[str, Any]]:
        """Return the answers since the last call, without waiting."""
        found: list[dict[str, Any]] = []
        self._socket.setblocking(False)
        try:
            while True:
                found.append(json.loads(self._socket.recv(4096)))
        except BlockingIOError:
            return found
