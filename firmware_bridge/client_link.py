"""The bridge's end of its local sockets: receives datagrams and sends the status without waiting."""

from __future__ import annotations

import contextlib
import errno
import grp
import os
import socket
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from firmware_bridge.core.config import ConfigError, runtime_dir
from firmware_bridge.core.link import MAX_DATAGRAM_BYTES, BridgeStatus, LinkError, Message, decode, encode

_STATUS_PERIOD_NS: Final = 100_000_000
_MAX_DATAGRAMS_A_STEP: Final = 64


class SocketTakenError(RuntimeError):
    """Another bridge listens at the socket's path."""


@dataclass(frozen=True)
class SocketGroups:
    """Groups of other users that may connect; None: only the bridge's own user and root."""

    runner: str | None = None
    """May command."""
    operator: str | None = None
    """Group that may stop, arm and read the status. Without the runner, which could end an emergency stop."""

    def __post_init__(self) -> None:
        if self.runner is not None and self.runner == self.operator:
            raise ConfigError(
                f"--runner-group and --operator-group: expected two groups, found {self.runner!r} twice: the runner"
                " could take back an emergency stop"
            )


USER_ONLY: Final = SocketGroups()
"""Sockets of mode 0600."""


def listen(path: Path, group: str | None = None) -> socket.socket:
    """Open a listening socket of mode 0600, or 0660 for a group; replace a socket file without a listener.

    Raises SocketTakenError, or ConfigError for another kind of file at the path or an unusable directory.
    """
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        if path.exists() and not stat.S_ISSOCK(path.stat().st_mode):
            # Connecting to a plain file is "refused" too, but it is not a stale socket.
            raise ConfigError(f"socket {path}: expected a free path, found a file; give another --socket")
        _make_folder(path.parent, shared=group is not None)
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
            answer = probe.connect_ex(str(path))
        if answer == 0:
            raise SocketTakenError(f"another bridge listens at {path}; stop it first, one process commands a robot")
        if answer == errno.ECONNREFUSED:
            path.unlink(missing_ok=True)  # left behind by a bridge that was killed
        umask = os.umask(0o177)
        try:
            listener.bind(str(path))
        finally:
            os.umask(umask)
        if group is not None:
            try:
                _share(path, group)
            except BaseException:
                path.unlink(missing_ok=True)
                raise
    except ConfigError:
        listener.close()
        raise
    except OSError as error:
        listener.close()
        raise ConfigError(f"socket {path}: cannot be used: {error.strerror}; give another --socket") from error
    listener.listen(4)
    listener.setblocking(False)
    return listener


def _make_folder(folder: Path, *, shared: bool) -> None:
    """Create the sockets' folder. Other users may traverse a shared one; only this user may write."""
    if not shared:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if folder == runtime_dir():  # under /tmp another user may have created it
            check_is_ours(folder)
        return
    if not folder.exists():
        folder.mkdir(mode=0o711, parents=True)
        folder.chmod(0o711)  # whatever the umask is
    found = folder.lstat()
    mode = stat.S_IMODE(found.st_mode)
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or mode & 0o022 or not mode & 0o001:
        raise ConfigError(
            f"{folder}: expected a folder of this user's with mode 0711, found {stat.filemode(found.st_mode)} of user"
            f" {found.st_uid}; correct it or give another --socket"
        )


def _share(path: Path, group: str) -> None:
    """Let a group connect. Raises ConfigError for an unknown group or one without this process's user."""
    try:
        os.chown(path, -1, grp.getgrnam(group).gr_gid)
    except KeyError:
        raise ConfigError(
            f"group {group or repr('')}: this machine has no such group; make it first (systemd-sysusers, see"
            " edge-install units)"
        ) from None
    except PermissionError:
        raise ConfigError(
            f"group {group}: the bridge's user is not in it, so {path} cannot be given to it;"
            f" SupplementaryGroups={group} in the unit, or usermod -aG"
        ) from None
    path.chmod(0o660)


def check_is_ours(folder: Path, option: str = "--socket") -> None:
    """Raise ConfigError unless `folder` is a directory of this user that no other user can enter.

    `option`: the option that names another place, for the message.
    """
    found = folder.lstat()
    if found.st_uid != os.getuid() or not stat.S_ISDIR(found.st_mode) or found.st_mode & 0o077:
        what = f"expected a folder of this user's alone, found {stat.filemode(found.st_mode)} of user {found.st_uid}"
        raise ConfigError(f"{folder}: {what}; remove it or give another {option}")


def _identity(path: Path) -> tuple[int, int] | None:
    try:
        found = path.lstat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


class ClientLink:
    """One listening socket with one client at a time, or a few."""

    def __init__(self, path: Path, *, places: int = 1, group: str | None = None) -> None:
        """`places`: number of clients; a further one is refused at 1, and replaces the oldest above 1.

        `group`: users that may connect besides the bridge's own and root.
        """
        self.malformed = 0
        self._path = path
        self._places = places
        self._listener = listen(path, group)
        self._file = _identity(path)
        self._refusing = False
        self._clients: list[socket.socket] = []
        self._sent_ns = 0
        self._sent: tuple[str, ...] = ()

    @property
    def is_removed(self) -> bool:
        """Whether the socket's file is gone or another one has its place: no new client can connect."""
        return _identity(self._path) != self._file

    @property
    def connected(self) -> bool:
        """Whether a client is connected."""
        return bool(self._clients)

    def files(self) -> list[socket.socket]:
        """Sockets to poll for input."""
        return self._clients if self._refusing else [self._listener, *self._clients]

    def receive(self) -> list[Message]:
        """Return received datagrams and handle connections; malformed datagrams are counted and ignored."""
        messages: list[Message] = []
        present = list(self._clients)
        for client in present:
            for data in self._datagrams(client):
                try:
                    messages.append(decode(data))
                except LinkError:
                    self.malformed += 1
        if self._clients == present:  # a reader of `connected` sees the disconnection before the next client connects
            self._accept()
        return messages

    def send_status(self, status: BridgeStatus) -> None:
        """Send the status on a change and at 10 Hz; drop it when the client does not read."""
        news = (status.state, status.cause, status.blocked_by)
        if news != self._sent or status.stamp_ns - self._sent_ns >= _STATUS_PERIOD_NS:
            self._sent_ns, self._sent = status.stamp_ns, news
            for client in self._clients:
                with contextlib.suppress(OSError):  # a closed connection is noticed by receive()
                    client.send(encode(status))

    def send(self, message: Message) -> None:
        """Send a message to every client; drop it for one that does not read."""
        if self._clients:
            data = encode(message)
            for client in self._clients:
                with contextlib.suppress(OSError):
                    client.send(data)

    def close(self) -> None:
        """Disconnect the clients and remove the socket file."""
        for file in (self._listener, *self._clients):
            file.close()
        if not self.is_removed:
            self._path.unlink(missing_ok=True)

    def _accept(self) -> None:
        self._refusing = False
        try:
            fresh, _ = self._listener.accept()
        except BlockingIOError:
            return
        except OSError:  # no descriptor left, or the client has disconnected: do not poll before the next step
            self._refusing = True
            return
        if len(self._clients) >= self._places > 1:
            self._drop(self._clients[0])
        if len(self._clients) < self._places:
            fresh.setblocking(False)
            self._clients.append(fresh)
            self._sent = ()
        else:
            fresh.close()  # without a greeting: its BridgeClient reports another client

    def _datagrams(self, client: socket.socket) -> Iterator[bytes]:
        was_reset = False
        for _ in range(_MAX_DATAGRAMS_A_STEP):
            try:
                data = client.recv(MAX_DATAGRAM_BYTES + 1)  # a longer datagram fails the length check
            except BlockingIOError:
                return
            except OSError as error:
                if isinstance(error, ConnectionResetError) and not was_reset:
                    was_reset = True  # it left with unread statuses; what it had sent before is still to be read
                    continue
                data = b""
            if not data:
                self._drop(client)
                return
            yield data

    def _drop(self, client: socket.socket) -> None:
        client.close()
        self._clients.remove(client)
