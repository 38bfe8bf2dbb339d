"""The asking end of a fault socket: `edge-hil --faults` and the fault rig's runner speak the same lines."""

from __future__ import annotations

import json
import socket
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Final

_POLL_S = 0.01


class FaultError(RuntimeError):
    """A fault that could not be injected; one line that says which and why."""


TIMEOUT_S: Final = 5.0
"""For a fault to take effect."""


class FaultClient:
    """Asks for faults and waits until they have taken effect. A context manager, bound to a path of its own."""

    def __init__(self, server: Path, own: Path) -> None:
        """`server`: where the faults are made; `own`: a free path to be answered at. Raises OSError."""
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
        """Ask without waiting for the effect. Raises FaultError when nobody listens."""
        line = json.dumps({"fault": fault, **({} if fault == "clear" else {"on": on}), **values}).encode()
        try:
            self._socket.sendto(line, str(self._server))
        except OSError as error:
            raise FaultError(f"{fault}: nobody takes faults at {self._server.name}: {error.strerror}") from error

    def effect_ns(self, fault: str, timeout_s: float = TIMEOUT_S) -> int:
        """When what was asked for took effect, monotonic ns; waits for it. Raises FaultError."""
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
        """`ask` and `effect_ns` in one; older answers that nobody waited for are thrown away first."""
        self.answers()
        self.ask(fault, on=on, **values)
        return self.effect_ns(fault, timeout_s)

    def wait_for_server(self, timeout_s: float) -> None:
        """Wait until the socket is there. Raises FaultError."""
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
        """What has been answered since the last call, without waiting."""
        found: list[dict[str, Any]] = []
        self._socket.setblocking(False)
        try:
            while True:
                found.append(json.loads(self._socket.recv(4096)))
        except BlockingIOError:
            return found
