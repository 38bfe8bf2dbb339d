"""Decides which process a client accepts as the bridge at the other end of a local socket."""

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
