"""Steps that make, check, switch and remove releases: each is printed before it is done."""

from __future__ import annotations

import contextlib
import os
import shlex
import shutil
import stat
import subprocess
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from edge.artifacts.files import ArtifactError
from edge.core.cli import write_whole
from edge.deploy.artifact_copy import check_artifacts, open_plain
from edge.deploy.dds_binding import explained
from edge.deploy.releases import FOLDER, MARKER, PARTIAL_LINK, CommandError, Home, Layout, Release

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


class Disk:
    """The actions on files that make, switch and remove releases; each returns once it would survive a power cut.

    Only `copy` leaves its bytes to `flush`, which a plan calls before it writes a record.
    """

    def make_folder(self, path: Path) -> None:
        """Make a folder and those above it."""
        path.mkdir(parents=True, exist_ok=True)

    def copy(self, source: Path, target: Path) -> None:
        """Copy a regular file, readable by every user; a link may lead to a secret. Raises ArtifactError for one."""
        with open_plain(source) as reader, target.open("xb") as writer:
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
        """Remove a folder with everything in it, if it is there; of a link, the link itself."""
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            self.delete(path)


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


def note_step(text: str) -> Step:
    """Explain the steps after it."""
    return Step(text, lambda _disk: None)


def mark_home(home: Home, disk: Disk) -> None:
    """Mark a folder as made by `edge-install board`."""
    marker = home.layout.home / MARKER
    if not marker.exists():
        with contextlib.suppress(OSError):  # a full disk: the user may still remove the releases
            disk.write(marker, "")


def switch_step(home: Home, number: int) -> Step:
    """Make a release the current one."""
    link, target = home.layout.link, Path(FOLDER) / str(number)
    return Step(f"switch {link} to {target}", lambda disk: disk.point(link, target))


def check_steps(home: Home, number: int, command: Run) -> list[Step]:
    """Return the checks that a release has to pass before it becomes current: its own programs start."""
    return [command_step("check", words, command) for words in _checks(home.layout, number)]


def _checks(layout: Layout, number: int) -> tuple[list[str], ...]:
    return (
        [layout.program(number, "python"), "-I", "-c", "import onnxruntime"],
        [layout.program(number, "edge-run"), "--help"],
        [layout.program(number, "edge-bridge"), "--help"],
    )


def verify_step(home: Home, number: int, manifest_sha256: str) -> Step:
    """Check the hashes of a release's artifacts before it becomes current."""
    artifacts = home.layout.artifacts(number)

    def act(_disk: Disk) -> None:
        try:
            check_artifacts(artifacts, manifest_sha256)
        except ArtifactError as error:
            raise ArtifactError(
                f"release {number} is damaged: {error}; the current release is unchanged; edge-install board with the "
                f"same wheel and artifacts builds it again"
            ) from error

    return Step(f"verify the hashes of {artifacts}", act)


def damage_of(home: Home, release: Release, command: Run) -> str | None:
    """Return what is damaged of a complete release in one line; None for a whole one."""
    try:
        check_artifacts(home.layout.artifacts(release.number), release.contents.manifest_sha256)
    except ArtifactError as error:
        return str(error)
    for words in _checks(home.layout, release.number):
        code, output = _outcome(words, command)
        if code != 0:
            return f"{shlex.join(words)}: exit code {code} ({explained(output)})"
    return None


def _outcome(words: Sequence[str], command: Run) -> tuple[int, str]:
    """Run a command; returns its exit code and output, 127 for a program that cannot be started."""
    try:
        return command(words)
    except OSError as error:
        return 127, f"{words[0]}: {error.strerror or error}"


def command_step(text: str, words: Sequence[str], command: Run) -> Step:
    """Run a command; a failure is a CommandError that says what to do about it."""

    def act(_disk: Disk) -> None:
        code, output = _outcome(words, command)
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
        folder, record = layout.folder(number), layout.record(number)
        if not folder.is_symlink() and record.is_file():
            disk.delete(record)
        disk.remove_tree(folder)

    return Step(f"remove {layout.folder(number)}: {reason}", act)


def uninstall_steps(home: Home) -> list[Step]:
    """Remove the link and every release: the undo of `edge-install board`."""
    layout = home.layout
    steps = []
    if home.current is not None:
        steps.append(Step(f"remove {layout.link}: nothing is current", lambda disk: disk.delete(layout.link)))
    numbers = {*(release.number for release in home.releases), *home.unfinished}
    if home.current is not None and os.path.lexists(layout.folder(home.current)):
        numbers.add(home.current)
    return [*steps, *removal_steps(home, sorted(numbers), "undo of edge-install board")]


def plan_rollback(home: Home, to: int | None, command: Run) -> list[Step]:
    """Return the steps to another release that is there; none if it is the current one. Raises ReleaseError."""
    target = home.rollback_target(to)
    number = target.number
    if number == home.current:
        return []
    verify = verify_step(home, number, target.contents.manifest_sha256)
    return [verify, *check_steps(home, number, command), switch_step(home, number)]


def run_child(lock: int, words: Sequence[str]) -> tuple[int, str]:
    """Run a command; returns its exit code and output.

    The child keeps the lock: if this process is killed, the next call waits for a pip that still writes.
    """
    done = subprocess.run(
        list(words), env=child_environment(os.environ), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True, errors="replace", check=False, pass_fds=(lock,),
    )  # fmt: skip
    return done.returncode, done.stdout


def child_environment(given: Mapping[str, str]) -> dict[str, str]:
    """Return the environment without what would let a new release read packages of another."""
    return {name: value for name, value in given.items() if name not in ("PYTHONPATH", "PYTHONHOME", "PIP_TARGET")}
