"""The bridge's end of its local sockets: datagrams in, status out, nothing waits."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from firmware_bridge.config import ConfigError
from firmware_bridge.link import MAX_DATAGRAM_BYTES, BridgeStatus, LinkError, Message, decode, encode

_STATUS_PERIOD_NS: Final = 100_000_000
_MAX_DATAGRAMS_A_STEP: Final = 64


class SocketTakenError(RuntimeError):
    """Another bridge listens at the socket's path."""


def listen(path: Path) -> socket.socket:
    """Listening socket of mode 0600; replaces a socket file nobody listens at.

    Raises SocketTakenError, or ConfigError when something else is in the way or the directory is not usable.
    """
    if path.exists() and not stat.S_ISSOCK(path.stat().st_mode):
        # Connecting to a plain file is "refused" too, and it must not be taken for a socket left behind.
        raise ConfigError(f"socket {path}: expected a free path, found a file; give another --socket")
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
            answer = probe.connect_ex(str(path))
        if answer == 0:
            raise SocketTakenError(f"another bridge listens at {path}; stop it first, one process commands a robot")
        if answer == errno.ECONNREFUSED:
            path.unlink(missing_ok=True)  # left behind by a bridge that was killed
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        umask = os.umask(0o177)
        try:
            listener.bind(str(path))
        finally:
            os.umask(umask)
    except OSError as error:
        listener.close()
        raise ConfigError(f"socket {path}: cannot be used: {error.strerror}; give another --socket") from error
    listener.listen(4)
    listener.setblocking(False)
    return listener


class ClientLink:
    """One socket with one client at a time."""

    def __init__(self, path: Path, *, newest_wins: bool = False) -> None:
        """`newest_wins`: a new client replaces the present one instead of being turned away."""
        self.malformed = 0
        self._path = path
        self._newest_wins = newest_wins
        self._listener = listen(path)
        self._client: socket.socket | None = None
        self._told_ns = 0
        self._told: tuple[str, ...] = ()

    @property
    def connected(self) -> bool:
        """Whether a runner is connected."""
        return self._client is not None

    def files(self) -> list[socket.socket]:
        """What to poll."""
        return [self._listener] if self._client is None else [self._listener, self._client]

    def receive(self) -> list[Message]:
        """Datagrams that have arrived; notices connections and disconnections. Malformed ones are counted, ignored."""
        messages: list[Message] = []
        if self._client is not None:
            for data in self._datagrams(self._client):
                try:
                    messages.append(decode(data))
                except LinkError:
                    self.malformed += 1
        with contextlib.suppress(BlockingIOError):
            fresh, _ = self._listener.accept()
            if self._newest_wins:
                self._drop_client()
            if self._client is None:
                fresh.setblocking(False)
                self._client, self._told = fresh, ()
            else:
                fresh.close()  # without a greeting: its BridgeClient knows what that means
        return messages

    def tell(self, status: BridgeStatus) -> None:
        """Send the status when it says something new, and at 10 Hz; dropped when the client does not read."""
        news = (status.state, status.cause, status.blocked_by)
        due = news != self._told or status.stamp_ns - self._told_ns >= _STATUS_PERIOD_NS
        if self._client is not None and due:
            self._told_ns, self._told = status.stamp_ns, news
            with contextlib.suppress(OSError):  # a closed connection is noticed by receive()
                self._client.send(encode(status))

    def close(self) -> None:
        """Disconnect the client and remove the socket file."""
        self._drop_client()
        self._listener.close()
        self._path.unlink(missing_ok=True)

    def _datagrams(self, client: socket.socket) -> Iterator[bytes]:
        for _ in range(_MAX_DATAGRAMS_A_STEP):
            try:
                data = client.recv(MAX_DATAGRAM_BYTES + 1)  # one more: a longer datagram fails the length check
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if not data:
                self._drop_client()
                return
            yield data

    def _drop_client(self) -> None:
        if self._client is not None:
            self._client.close()
            self._client = None
