"""Datagram socket that switches faults of a running front end: one JSON object per request and answer."""

from __future__ import annotations

import contextlib
import json
import os
import socket
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import Final

CLEAR: Final = "clear"
MAX_BYTES: Final = 2000
_MAX_A_POLL: Final = 16


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


class FaultSocket(FaultEndpoint, ABC):
    """Fault socket that answers every request at once; `poll` handles requests."""

    def poll(self) -> None:
        """Handle the requests that have arrived, without waiting."""
        for data, sender in self._received():
            try:
                answer = self._switch(_table(data))
            except ValueError as error:
                answer = {"error": str(error)}
            self._answer(sender, answer)

    @abstractmethod
    def _switch(self, table: dict[str, object]) -> dict[str, object]:
        """Execute one request and return the answer. Raises ValueError."""


def _table(data: bytes) -> dict[str, object]:
    try:
        table = json.loads(data) if len(data) <= MAX_BYTES else None
    except (ValueError, RecursionError):
        table = None
    if not isinstance(table, dict):
        raise ValueError(f"expected a JSON object of at most {MAX_BYTES} bytes, found {data[:60]!r}")
    return table
