"""Releases of one board: numbered folders beside each other, and one link, `current`, to the one that is used.

A release is complete once its record is written, the last file of it to reach the disk. The link changes in one rename.
So a power cut at any point leaves a link to a complete release, and a folder without a record is unfinished.
Numbers order the releases, never times: a board without a clock battery boots in 1970.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import json
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from firmware_bridge.system.input_file import read_json

RECORD: Final = "release.json"
LINK: Final = "current"
PARTIAL_LINK: Final = "current.partial"
FOLDER: Final = "releases"
LOCK: Final = "lock"
MARKER: Final = ".tic-vla-edge-home"
"""File that marks a folder as made by `edge-install board`: nothing is removed from another folder."""


class ReleaseError(RuntimeError):
    """A release cannot be made, found or used; its text is the one line to show."""


class InputError(ReleaseError):
    """A bad argument or file."""


class CommandError(ReleaseError):
    """A program that a step runs has failed."""

    def __init__(self, code: int, text: str) -> None:
        super().__init__(text)
        self.code = code


@dataclass(frozen=True)
class Contents:
    """What a release is made from: two releases with equal contents are the same release."""

    wheel: str
    wheel_sha256: str
    manifest_sha256: str
    """Of the file manifest.json, which lists the hash of every other artifact."""
    extras: tuple[str, ...]
    requirements: tuple[str, ...]


@dataclass(frozen=True)
class Release:
    """A complete release."""

    number: int
    contents: Contents
    previous: int | None
    """Release that was current before this one: `rollback` returns to it."""

    def text(self) -> str:
        """Return the record's file content."""
        return json.dumps(asdict(self), indent=1) + "\n"


@dataclass(frozen=True)
class Layout:
    """Paths below the folder that holds the releases."""

    home: Path

    @property
    def link(self) -> Path:
        """The link to the current release."""
        return self.home / LINK

    def folder(self, number: int) -> Path:
        """Folder of a release."""
        return self.home / FOLDER / str(number)

    def record(self, number: int) -> Path:
        """Record of a release: there once the release is complete."""
        return self.folder(number) / RECORD

    def artifacts(self, number: int) -> Path:
        """Artifact directory of a release."""
        return self.folder(number) / "artifacts"

    def environment(self, number: int) -> Path:
        """Python environment of a release."""
        return self.folder(number) / "venv"

    def program(self, number: int, name: str) -> str:
        """Path of a program of a release."""
        return str(self.environment(number) / "bin" / name)


@dataclass(frozen=True)
class Home:
    """The releases as they were found."""

    layout: Layout
    releases: tuple[Release, ...]
    """Complete ones by rising number."""
    unfinished: tuple[int, ...]
    """Entries without a record that can be read: an install, or a removal, that was cut off, or damage."""
    current: int | None

    def find(self, number: int | None) -> Release | None:
        """Return the complete release of that number."""
        return next((release for release in self.releases if release.number == number), None)

    def made_from(self, contents: Contents) -> Release | None:
        """Return a complete release of these contents: the current one first, then the newest."""
        same = [release for release in self.releases if release.contents == contents]
        return max(same, key=lambda release: (release.number == self.current, release.number), default=None)

    def next_number(self) -> int:
        """Return a number above every other."""
        taken = (*(release.number for release in self.releases), *self.unfinished, self.current or 0)
        return max(taken, default=0) + 1

    def rollback_target(self, to: int | None) -> Release:
        """Return the release to go back to: `to`, else the one before the current one. Raises ReleaseError."""
        known = ", ".join(str(release.number) for release in self.releases) or "none"
        if to is not None and to in self.unfinished:
            raise ReleaseError(f"--to {to}: {self.layout.record(to)} cannot be read; there are: {known}")
        if to is not None:
            found = self.find(to)
            if found is None:
                raise ReleaseError(f"--to {to}: no such release in {self.layout.home}; there are: {known}")
            return found
        if self.current is None:
            raise ReleaseError(f"{self.layout.link}: no current release; make one with edge-install board")
        current = self.find(self.current)
        found = self.find(current.previous) if current is not None else None
        older = [release for release in self.releases if release.number < self.current]
        if found is None and not older:
            raise ReleaseError(
                f"{self.layout.home}: no release before {self.current} is kept; there are: {known}; name one with --to"
            )
        return found or older[-1]

    def to_prune(self, current: int, previous: int | None, keep: int) -> tuple[int, ...]:
        """Return what to remove so that `keep` releases stay beside the current one; never the previous one."""
        others = [release.number for release in self.releases if release.number not in (current, previous)]
        room = max(keep - (self.find(previous) is not None), 0)
        return tuple(others[: max(len(others) - room, 0)])


def read_home(path: Path) -> Home:
    """Read which releases there are and which is current. Raises ReleaseError for a `current` that is not ours."""
    layout = Layout(path)
    folder = path / FOLDER
    if folder.is_symlink():
        raise ReleaseError(f"{folder}: expected a folder, found a link; name the folder above its target with --home")
    entries = folder.iterdir() if folder.is_dir() else ()
    numbers = sorted(number for entry in entries if (number := _number(entry.name)) is not None)
    current = _current(layout)
    releases = []
    unfinished = []
    for number in numbers:
        # A link in place of a folder leads to files that are not ours.
        release = None if layout.folder(number).is_symlink() else _read_record(layout.record(number), number)
        if release is not None:
            releases.append(release)
        elif number != current:  # what the link leads to is never removed, whatever its record says
            unfinished.append(number)
    return Home(layout, tuple(releases), tuple(unfinished), current)


def _current(layout: Layout) -> int | None:
    if not layout.link.is_symlink():
        if layout.link.exists():
            raise ReleaseError(f"{layout.link}: expected a link to a release, found something else; move it away")
        return None
    target = layout.link.readlink()
    number = _number(target.name)
    if target.parent != Path(FOLDER) or number is None:
        raise ReleaseError(f"{layout.link}: expected a link to {FOLDER}/NUMBER, found {target}; remove the link")
    return number


def current_text(path: Path) -> str:
    """Return which release the link leads to now, for a message of a call that was cut off."""
    try:
        current = _current(Layout(path))
    except (ReleaseError, OSError):
        return f"{Layout(path).link} cannot be read"
    return "no release is current" if current is None else f"release {current} is current"


def _number(name: str) -> int | None:
    """Return the number of a release's folder; None for a name that no release has."""
    return int(name) if name.isascii() and name.isdecimal() and str(int(name)) == name else None


def home_argument(text: str) -> Path:
    """Parse --home. Raises ArgumentTypeError for an empty path, which would be the working directory."""
    if not text:
        raise argparse.ArgumentTypeError("expected a folder, found an empty path")
    return Path(text)


def check_owner(home: Home, *, empty_allowed: bool) -> None:
    """Raise InputError for a folder that `edge-install board` did not make.

    Earlier versions left no marker: a release is proof. `empty_allowed`: accept also an absent or an empty folder.
    """
    path, current = home.layout.home, home.current
    if (path / MARKER).is_file() or home.releases:
        return
    if current is not None and Path(home.layout.program(current, "edge-install")).exists():
        return
    others = sorted(entry.name for entry in path.iterdir() if entry.name != LOCK) if path.is_dir() else []
    if others or not empty_allowed:
        raise InputError(
            f"--home {path}: expected a folder that edge-install board made, found no release, and "
            f"{others[0] if others else 'no file'} in it; nothing was changed; name another folder"
        )


def _read_record(path: Path, number: int) -> Release | None:
    """Return the release of a record; None without a record that is whole."""
    try:
        found = read_json(path)
        made: dict[str, Any] = found["contents"]
        contents = Contents(
            str(made["wheel"]), str(made["wheel_sha256"]), str(made["manifest_sha256"]),
            tuple(map(str, made["extras"])), tuple(map(str, made["requirements"])),
        )  # fmt: skip
        previous = found["previous"]
        return Release(number, contents, None if previous is None else int(previous))
    except (OSError, ValueError, KeyError, TypeError, OverflowError):
        return None


@contextlib.contextmanager
def locked(home: Path) -> Iterator[int]:
    """Yield the descriptor of a lock on the releases; raises ReleaseError if another call has it."""
    home.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(home / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise ReleaseError(f"{home / LOCK}: another edge-install, or a pip that it started, works here; wait") from None
    try:
        yield descriptor
    finally:
        os.close(descriptor)
