"""A service manager's end of NOTIFY_SOCKET, for tests: what it has been told, in order."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator
from pathlib import Path


class NotifySocket:
    """Receives sd_notify datagrams."""

    def __init__(self, listening: socket.socket, name: str) -> None:
        self._socket = listening
        self.name = name

    def environment(self, *, watchdog_us: int | None = None, pid: int | None = None) -> dict[str, str]:
        """The variables that systemd would set."""
        variables = {"NOTIFY_SOCKET": self.name}
        if watchdog_us is not None:
            variables["WATCHDOG_USEC"] = str(watchdog_us)
        if pid is not None:
            variables["WATCHDOG_PID"] = str(pid)
        return variables

    def messages(self) -> list[dict[str, str]]:
        """Messages that have arrived since the last call, each as its assignments."""
        found: list[dict[str, str]] = []
        with contextlib.suppress(BlockingIOError):
            while True:
                text = self._socket.recv(65536).decode("utf-8")
                found.append(dict(line.split("=", 1) for line in text.splitlines()))
        return found


@contextlib.contextmanager
def notify_socket(address: Path | str) -> Iterator[NotifySocket]:
    """Listen at a path, or at `@name` in the abstract namespace."""
    name = str(address)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as listening:
        listening.bind("\0" + name[1:] if name.startswith("@") else name)
        yield NotifySocket(listening, name)
