"""Releases of one board: numbered folders beside each other, and one link, `current`, to the one that is used.

A release is complete once its record is written, the last file of it to reach the disk. The link changes in one rename.
So a power cut at any point leaves a link to a complete release, and a folder without a record is unfinished.
Numbers order the releases, never times: a board without a clock battery boots in 1970.
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
import stat
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from edge.core.cli import write_whole
from edge.deploy.dds_binding import explained
from firmware_bridge.system.input_file import read_json

RECORD: Final = "release.json"
LINK: Final = "current"
PARTIAL_LINK: Final = "current.partial"
FOLDER: Final = "releases"
_COPY_BYTES: Final = 1 << 20


_ADVICE: Final = {
    "ensurepip is not available": "sudo apt-get install python3-venv, then run this again",
    "certificate is not yet valid": "the clock is wrong: set it (timedatectl), or install offline with --wheels DIR",
    "No module named 'onnxruntime'": "no ONNX Runtime: give --extras cpu, or on a Jetson --with onnxruntime-gpu",
    "libraries are missing or do not load": "on a Jetson: sudo apt-get install nvidia-jetpack, then run this again",
    "does not match the hash": "the wheel or the index is not the expected one",
}
"""What to do about an error line of pip, venv or a check; `dds_binding.explained` knows the compilers'."""

Run = Callable[[Sequence[str]], tuple[int, str]]


class ReleaseError(RuntimeError):
    """A release cannot be made, found or used; its text is the one line to show."""


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
    """Folders without a record: an install, or a removal, that was cut off."""
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
    entries = folder.iterdir() if folder.is_dir() else ()
    numbers = sorted(int(entry.name) for entry in entries if entry.name.isdecimal() and entry.name.isascii())
    current = _current(layout)
    releases = []
    unfinished = []
    for number in numbers:
        release = _read_record(layout.record(number), number)
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
    if target.parent != Path(FOLDER) or not target.name.isdecimal():
        raise ReleaseError(f"{layout.link}: expected a link to {FOLDER}/NUMBER, found {target}; remove the link")
    return int(target.name)


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
    except (FileNotFoundError, NotADirectoryError, ValueError, KeyError, TypeError):
        return None


class Disk:
    """The actions on files that make, switch and remove releases; each returns once it would survive a power cut.

    Only `copy` leaves its bytes to `flush`, which a plan calls before it writes a record.
    """

    def make_folder(self, path: Path) -> None:
        """Make a folder and those above it."""
        path.mkdir(parents=True, exist_ok=True)

    def copy(self, source: Path, target: Path) -> None:
        """Copy a file, readable by every user."""
        with source.open("rb") as reader, target.open("xb") as writer:
            shutil.copyfileobj(reader, writer, _COPY_BYTES)
        target.chmod(stat.S_IRUSR | stat.S_IWUSR | stat.S_IRGRP | stat.S_IROTH)

    def flush(self) -> None:
        """Write everything that the kernel still keeps in memory to the disks: thousands of files of an environment."""
        os.sync()

    def write(self, path: Path, text: str) -> None:
        """Write a file in one rename."""
        write_whole(path, text)
        sync_folder(path.parent)

    def point(self, link: Path, target: Path) -> None:
        """Let a link lead to `target` in one rename: at every instant it leads to the old or to the new one."""
        partial = link.with_name(PARTIAL_LINK)
        partial.unlink(missing_ok=True)
        partial.symlink_to(target)
        partial.replace(link)
        sync_folder(link.parent)

    def delete(self, path: Path) -> None:
        """Delete a file or a link, if it is there."""
        path.unlink(missing_ok=True)
        if path.parent.is_dir():
            sync_folder(path.parent)

    def remove_tree(self, path: Path) -> None:
        """Remove a folder with everything in it, if it is there."""
        if path.exists():
            shutil.rmtree(path)


def sync_folder(path: Path) -> None:
    """Wait until the names in a folder are on the disk."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@dataclass(frozen=True)
class Step:
    """One step of a plan: what is printed, and what is done."""

    text: str
    act: Callable[[Disk], None]


def switch_step(home: Home, number: int) -> Step:
    """Make a release the current one."""
    link, target = home.layout.link, Path(FOLDER) / str(number)
    return Step(f"switch {link} to {target}", lambda disk: disk.point(link, target))


def check_steps(home: Home, number: int, command: Run) -> list[Step]:
    """Return the checks that a release has to pass before it becomes current: its own programs start."""
    layout = home.layout
    checks = (
        [layout.program(number, "python"), "-I", "-c", "import onnxruntime"],
        [layout.program(number, "edge-run"), "--help"],
        [layout.program(number, "edge-bridge"), "--help"],
    )
    return [command_step("check", words, command) for words in checks]


def command_step(text: str, words: Sequence[str], command: Run) -> Step:
    """Run a command; a failure is a CommandError that says what to do about it."""

    def act(_disk: Disk) -> None:
        code, output = command(words)
        if code != 0:
            advice = next((advice for sign, advice in _ADVICE.items() if sign in output), None) or explained(output)
            raise CommandError(code, f"cannot {text}: {advice}\n{output.rstrip()}")

    return Step(f"{text}: {shlex.join(words)}", act)


def record_step(home: Home, release: Release) -> Step:
    """Declare a release complete."""
    path = home.layout.record(release.number)
    return Step(f"write {path}: release {release.number} is complete", lambda disk: disk.write(path, release.text()))


def removal_steps(home: Home, numbers: Iterable[int], reason: str) -> list[Step]:
    """Remove releases; the record first, so that a removal that is cut off leaves an unfinished release."""
    return [_removal(home.layout, number, reason) for number in numbers]


def _removal(layout: Layout, number: int, reason: str) -> Step:
    def act(disk: Disk) -> None:
        disk.delete(layout.record(number))
        disk.remove_tree(layout.folder(number))

    return Step(f"remove {layout.folder(number)}: {reason}", act)


def uninstall_steps(home: Home) -> list[Step]:
    """Remove the link and every release: the undo of `edge-install board`."""
    layout = home.layout
    steps = []
    if home.current is not None:
        steps.append(Step(f"remove {layout.link}: nothing is current", lambda disk: disk.delete(layout.link)))
    numbers = {*(release.number for release in home.releases), *home.unfinished}
    if home.current is not None and layout.folder(home.current).is_dir():
        numbers.add(home.current)
    return [*steps, *removal_steps(home, sorted(numbers), "undo of edge-install board")]


def plan_rollback(home: Home, to: int | None, command: Run) -> list[Step]:
    """Return the steps to another release that is there; none if it is the current one. Raises ReleaseError."""
    target = home.rollback_target(to).number
    if target == home.current:
        return []
    return [*check_steps(home, target, command), switch_step(home, target)]
