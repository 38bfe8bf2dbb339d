"""Files on both sides of the units: rights of those that the services read, and the writing of the units themselves."""

from __future__ import annotations

import contextlib
import errno
import os
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from stat import S_IROTH, S_ISDIR, S_ISVTX, S_IWOTH, S_IXOTH
from typing import Final

from edge.core.cli import OutputError, write_whole
from edge.deploy import units
from edge.deploy.unit_text import UnitError
from firmware_bridge.system.output_file import partial_of

_FULL: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def unreadable(paths: Sequence[Path]) -> list[Path]:
    """Return those of these paths and their parents that other users cannot read."""
    closed: list[Path] = []
    for path in paths:
        # Files below hidden folders are bound directly, without their parents.
        way = (
            [] if units.is_hidden(path) else [folder for folder in path.parents if not folder.stat().st_mode & S_IXOTH]
        )
        inside = sorted(path.iterdir()) if path.is_dir() else []
        needs = {path: S_IROTH | S_IXOTH if path.is_dir() else S_IROTH, **dict.fromkeys(inside, S_IROTH)}
        closed += [*way, *(entry for entry, bits in needs.items() if entry.stat().st_mode & bits != bits)]
    return list(dict.fromkeys(closed))


def check_writers(paths: Sequence[Path]) -> None:
    """Raise UnitError for a path that every user may replace or change, itself or through a folder above it."""
    for path in paths:
        real = Path(os.path.realpath(path))
        inside = real.iterdir() if real.is_dir() else ()
        for part in (path, *path.parents, real, *real.parents, *inside):
            mode = part.stat().st_mode
            if mode & S_IWOTH and not (S_ISDIR(mode) and mode & S_ISVTX):  # of a sticky folder, only the owner may
                raise UnitError(
                    f"{part}: expected no write access for every user, found mode {mode & 0o7777:04o}: any of them "
                    f"could change what the robot does; sudo chmod o-w {shlex.quote(str(part))}"
                )


def write_units(contents: Mapping[Path, str], *, force: bool) -> list[Path]:
    """Write the files that differ, and then rename them all; refuse before that if a path is not replaceable.

    Raises UnitError, or OutputError for a full disk: the files are as they were, or the line names the changed ones.
    """
    wanted: dict[Path, str] = {}
    for path, text in contents.items():
        if path.is_symlink() or (path.exists() and not path.is_file()):
            raise UnitError(f"{path}: is no plain file; remove it first")
        if path.exists() and path.read_text(encoding="utf-8", errors="replace") == text:
            continue
        if path.exists() and not force:
            raise UnitError(f"{path}: exists and differs; replace it with --force")
        wanted[path] = text
    partials: dict[Path, Path] = {}
    replaced: list[Path] = []
    try:
        for path, text in wanted.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            partials[path] = partial_of(path)
            write_whole(partials[path], text)
            # systemd complains about world-writable units and needs world-readable ones.
            partials[path].chmod(0o644)
        for path, partial in partials.items():
            partial.replace(path)
            replaced.append(path)
    except OSError as error:
        done = f"written so far: {', '.join(map(str, replaced))}" if replaced else "no file was changed"
        line = f"{path}: {error.strerror or error}; {done}; correct this and run it again"
        raise (OutputError if error.errno in _FULL else UnitError)(line) from error
    finally:
        for partial in partials.values():
            with contextlib.suppress(OSError):
                partial.unlink(missing_ok=True)
    return list(wanted)
