"""Datagram socket that switches faults of a running front end, and its client: one JSON object per datagram."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import time
from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Generic, TypeVar

CLEAR: Final = "clear"
MAX_BYTES: Final = 2000
_MAX_A_POLL: Final = 16
_LARGEST: Final = 1e9

P = TypeVar("P", bound=Any)  # a frozen dataclass of numbers


class FaultEndpoint:
    """Datagram socket for fault requests at a path that only this user can access. Raises OSError."""

    def __init__(self, path: Path) -> None:
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

    def injected(self) -> tuple[str, ...]:
        """Return the names of the faults that are switched on."""
        return ()

    def _received(self) -> Iterator[tuple[bytes, str]]:
        """Yield the requests that have arrived and their senders, a limited number per call."""
        for _ in range(_MAX_A_POLL):
            try:
                yield self._socket.recvfrom(MAX_BYTES + 1)
            except BlockingIOError:
                return

    def _answer(self, sender: str, answer: dict[str, object]) -> None:
        if sender:  # an unbound socket has no address to answer to
            with contextlib.suppress(OSError):  # the client ended or does not read
                self._socket.sendto(json.dumps(answer).encode(), sender)

    def close(self) -> None:
        """Close and remove the socket."""
        self._socket.close()
        self._path.unlink(missing_ok=True)


class PlanFaults(FaultEndpoint, Generic[P]):
    """Fault socket whose faults are the fields of a dataclass and switches; call `poll`. Raises OSError.

    A request is one JSON object per datagram: {"fault": NAME, "on": true|false, "value": NUMBER}; a field of the plan
    needs a value, a switch has none. {"fault": "clear"} ends all faults. The answer is {"fault", "on", "effect_ns"} or
    {"error"}.
    """

    def __init__(self, path: Path, plan: P, switches: tuple[str, ...]) -> None:
        """Bind the socket; `plan`: initial faults, restored by "clear" and by "on": false."""
        super().__init__(path)
        self._begin = self.plan = plan
        self._switches = switches
        self.active: set[str] = set()
        """Switches that are on."""

    def injected(self) -> tuple[str, ...]:
        """Return the switches that are on and the fields that differ from the initial faults."""
        changed = (
            name for name in plan_fields(type(self.plan)) if getattr(self.plan, name) != getattr(self._begin, name)
        )
        return (*sorted(self.active), *changed)

    def poll(self) -> None:
        """Handle the requests that have arrived, without waiting."""
        for data, sender in self._received():
            try:
                answer = self._switch(_table(data))
            except ValueError as error:
                answer = {"error": str(error)}
            self._answer(sender, answer)

    def _switch(self, table: dict[str, object]) -> dict[str, object]:
        name, on, value = table.pop("fault", None), table.pop("on", True), table.pop("value", None)
        if table or not isinstance(on, bool):
            raise ValueError(f"expected fault, on and value, found {', '.join(map(str, table)) or f'on {on!r}'}")
        names = plan_fields(type(self.plan))
        if name == CLEAR:
            self.plan, on = self._begin, False
            self.active.clear()
        elif name in self._switches and value is None:
            (self.active.add if on else self.active.discard)(str(name))
        elif name in names:
            number = _number(str(name), value) if on else getattr(self._begin, str(name))
            self.plan = replace(self.plan, **{str(name): number})
        else:
            known = ", ".join((*self._switches, *names, CLEAR))
            raise ValueError(f"expected one of {known}, found {name!r} with value {value!r}")
        return {"fault": name, "on": on, "effect_ns": time.monotonic_ns()}


def _number(name: str, value: object) -> float:
    # An integer may exceed the range of a float.
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= _LARGEST:
        raise ValueError(f"{name}: expected a number up to {_LARGEST:g} as value, found {str(value)[:60]}")
    return float(value)


def plan_fields(plan: type[P]) -> tuple[str, ...]:
    """Return the names of a plan's faults."""
    return tuple(field.name for field in fields(plan))


def parse_plan(plan: type[P], settings: Sequence[str]) -> P:
    """Read the settings `NAME=NUMBER` of a plan. Raises ValueError with one line."""
    values: dict[str, float] = {}
    for setting in settings:
        name, equals, number = setting.partition("=")
        if not equals or name not in plan_fields(plan):
            raise ValueError(f"expected NAME=NUMBER of {', '.join(plan_fields(plan))}, found {setting!r}")
        try:
            values[name] = float(number)
        except ValueError:
            raise ValueError(f"{name}: expected a number, found {number!r}") from None
    parsed: P = plan(**values)
    return parsed


def _table(data: bytes) -> dict[str, object]:
    try:
        table = json.loads(data) if len(data) <= MAX_BYTES else None
    except (ValueError, RecursionError):
        table = None
    if not isinstance(table, dict):
        raise ValueError(f"expected a JSON object of at most {MAX_BYTES} bytes, found {data[:60]!r}")
    return table


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
