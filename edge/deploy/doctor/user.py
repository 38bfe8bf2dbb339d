"""Whose rights `edge-doctor` judges: one's own can be tried, another user's are read from the modes of files."""

from __future__ import annotations

import os
import pwd
import stat
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from firmware_bridge.core.config import ConfigError


@dataclass(frozen=True)
class Whom:
    """A user of this machine."""

    name: str
    uid: int
    groups: frozenset[int]
    other: bool
    """Not the user who runs this: nothing can be tried, only read."""

    def may(self, path: Path, *, write: bool = False) -> bool:
        """Whether the user may read (and write) a file: by owner, groups and mode, without access lists for another."""
        if not self.other:
            return os.access(path, os.R_OK | os.W_OK if write else os.R_OK)
        if self.uid == 0:
            return True
        try:
            found = path.stat()
        except OSError:
            return False
        wanted = stat.S_IROTH | (stat.S_IWOTH if write else 0)
        # The first class that fits decides, as in the kernel.
        shift = 6 if found.st_uid == self.uid else 3 if found.st_gid in self.groups else 0
        return (stat.S_IMODE(found.st_mode) >> shift) & wanted == wanted

    def through_its_group(self, path: Path) -> bool:
        """Whether the group of a file may read it, so that membership would do."""
        try:
            return path.stat().st_mode & stat.S_IRGRP != 0
        except OSError:
            return False


def current_user(euid: Callable[[], int] = os.geteuid) -> Whom:
    """The user that runs this process."""
    uid = euid()
    try:
        name = pwd.getpwuid(uid).pw_name
    except KeyError:
        name = str(uid)
    return Whom(name, uid, frozenset({os.getegid(), *os.getgroups()}), other=False)


def user_named(name: str | None) -> Whom:
    """Return that user, by default the one of this process. Raises ConfigError for an unknown user."""
    if name is None:
        return current_user()
    try:
        entry = pwd.getpwnam(name)
    except KeyError:
        raise ConfigError(
            f"--user {name}: this machine has no such user; make it first (systemd-sysusers, see edge-install units)"
        ) from None
    if entry.pw_uid == os.geteuid():
        return current_user()
    return Whom(name, entry.pw_uid, frozenset(os.getgrouplist(name, entry.pw_gid)), other=True)
