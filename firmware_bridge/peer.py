"""Connects a client to one of the bridge's local sockets, and decides which process it accepts as the bridge there."""

from __future__ import annotations

import os
import socket
import stat
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Final

_UCRED: Final = struct.Struct("3i")  # pid, uid, gid
_OTHERS_WRITE: Final = stat.S_IWGRP | stat.S_IWOTH
CONNECT_TIMEOUT_S: Final = 1.0
"""A bridge that hangs accepts no connection; a client waits for so long, s."""


class BridgeUnavailable(RuntimeError):  # noqa: N818 - it names a state, not an error
    """No bridge listens, it has another client, or its connection has closed; one line for the operator."""


def connect(path: Path) -> socket.socket:
    """Return a connection to the bridge's socket at `path` that never waits. Raises BridgeUnavailable within 1 s."""
    connected = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        connected.settimeout(CONNECT_TIMEOUT_S)
        connected.connect(str(path))
        listener_uid = peer_uid(connected)
    except PermissionError as error:
        connected.close()
        message = f"no permission for the bridge at {path}; use sudo or join the socket's group"
        raise BridgeUnavailable(message) from error
    except OSError as error:
        connected.close()
        raise BridgeUnavailable(
            f"no bridge listens at {path} ({error.strerror}); start `edge-bridge --robot FILE.toml`"
        ) from error
    if not is_trusted_listener(path, listener_uid):
        connected.close()
        raise BridgeUnavailable(
            f"{path} belongs to user {listener_uid}, not to a bridge of this user's or the service's;"
            " expected a folder that root has given to that user alone, such as /run/tic-vla-edge"
        )
    connected.setblocking(False)
    return connected


def peer_uid(connected: socket.socket) -> int:
    """Return the user id of the listening process at the other end (SO_PEERCRED, unix(7))."""
    uid: int = _UCRED.unpack(connected.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _UCRED.size))[1]
    return uid


def is_trusted_listener(
    path: Path, uid: int, *, own_uid: int | None = None, lstat: Callable[[Path], os.stat_result] = Path.lstat
) -> bool:
    """Return whether a listener of user `uid` at `path` is accepted as the bridge.

    The user's own and root's processes are accepted. Another user's process is accepted only in a folder that root has
    given to that user, such as systemd's RuntimeDirectory=: no third user can have placed a socket there.
    """
    return uid in (os.getuid() if own_uid is None else own_uid, 0) or _is_given_by_root(path, uid, lstat)


def _is_given_by_root(path: Path, uid: int, lstat: Callable[[Path], os.stat_result]) -> bool:
    """Return whether only `uid` can write to the folder of `path`, and only root above it; links are refused."""
    folder = path.absolute().parent
    owners = {folder: uid, **dict.fromkeys(folder.parents, 0)}
    try:
        found = {each: lstat(each) for each in owners}
    except OSError:
        return False
    return all(
        stat.S_ISDIR(status.st_mode) and status.st_uid == owners[each] and status.st_mode & _OTHERS_WRITE == 0
        for each, status in found.items()
    )
