"""`edge-install board`, `rollback`, `releases`, `remove`: put a release on the board, beside the one that is used.

A release has its own Python environment and its own artifacts. It is built, checked by its own programs and flushed to
the disk before the link `current` leads to it; the release before it stays. No service is started or stopped.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import fcntl
import hashlib
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from edge.artifacts.files import ArtifactError, read_manifest_bytes
from edge.core.cli import (
    EXIT_BAD_INPUT,
    EXIT_CHECK_FAILED,
    EXIT_DONE,
    EXIT_INTERRUPTED,
    EXIT_REFUSED,
    check_result_target,
    write_result,
)
from edge.deploy.pins import PinsError, pinned_steps, pins_of, wheel_extras
from edge.deploy.releases import (
    CommandError,
    Contents,
    Disk,
    Home,
    Release,
    ReleaseError,
    Run,
    Step,
    check_steps,
    command_step,
    plan_rollback,
    read_home,
    record_step,
    removal_steps,
    switch_step,
    uninstall_steps,
)
from firmware_bridge.system.input_file import open_regular

HOME: Final = Path("/opt/tic-vla-edge")
COMMANDS: Final = ("board", "rollback", "releases", "remove")
LOG: Final = "install.log"
LOCK: Final = "lock"
SERVICES: Final = "tic-vla-edge-bridge tic-vla-edge-runner"
_HASH_BYTES: Final = 1 << 20
_EXTRAS: Final = re.compile(r"[a-z]+(,[a-z]+)*")
Say = Callable[[str], None]


class InputError(ReleaseError):
    """A bad argument or file."""


@dataclass(frozen=True)
class Board:
    """The board as this module meets it; a test gives another."""

    python: str = sys.executable
    machine: str = field(default_factory=platform.machine)
    disk: Disk = field(default_factory=Disk)
    run: Callable[[int, Sequence[str]], tuple[int, str]] | None = None
    """Runs a command, given the lock's descriptor; None: as a child process."""


@dataclass(frozen=True)
class Request:
    """What to install, checked."""

    wheel: Path
    artifacts: Path
    files: tuple[Path, ...]
    """Every file of the artifact directory."""
    contents: Contents
    pip_options: tuple[str, ...]
    keep: int
    pins: str | None = None
    """Packages with hashes as a pip requirements file; None: pip chooses among those that fit."""
    unpinned: str = ""
    """Why there are no pins; empty with pins, and with --constraints."""


def add_parsers(commands: argparse._SubParsersAction[Any]) -> None:
    """Add the four sub-commands."""
    board = commands.add_parser("board", help="install or update: a new release beside the old, switched by a link")
    board.add_argument("--wheel", type=Path, required=True, metavar="FILE.whl", help="the package's wheel")
    board.add_argument("--artifacts", type=Path, required=True, metavar="DIR", help="directory made by edge-export")
    board.add_argument(
        "--extras", default="cpu", metavar="A,B", help="the wheel's extras, e.g. cpu,unitree; empty for none (cpu)"
    )
    board.add_argument(
        "--with", dest="requirements", action="append", default=[], metavar="REQUIREMENT",
        help="another package of pip's, e.g. onnxruntime-gpu on a Jetson instead of the extra cpu; may be repeated",
    )  # fmt: skip
    board.add_argument("--index", metavar="URL", help="package index besides pip's own, e.g. NVIDIA's for Jetson")
    board.add_argument("--wheels", type=Path, metavar="DIR", help="install from this folder of wheels, no network")
    board.add_argument(
        "--constraints",
        type=Path,
        metavar="FILE",
        help="versions to install, as pip's -c (default: those in the wheel, with hashes)",
    )
    board.add_argument(
        "--keep", type=int, default=2, metavar="N", help="releases to keep beside the current one, at least 1 (2)"
    )
    back = commands.add_parser("rollback", help="switch back to the release before the current one, or to another")
    back.add_argument("--to", type=int, metavar="N", help="number of the release (edge-install releases)")
    listing = commands.add_parser("releases", help="list the releases of this board")
    listing.add_argument("--json", metavar="FILE|-", help="write the list as JSON")
    remove = commands.add_parser("remove", help="undo of board: remove every release and the link")
    for parser in (board, back, listing, remove):
        parser.add_argument("--home", type=Path, default=HOME, metavar="DIR", help=f"folder of the releases ({HOME})")
    for parser in (board, back, remove):
        parser.add_argument("--dry-run", action="store_true", help="print the steps only")


def run(args: argparse.Namespace, say: Say, board: Board | None = None) -> int:
    """Do one of the four commands; returns the exit code."""
    board = board or Board()
    args.home = args.home.absolute()
    before = os.umask(0o022)  # services of other users read what root writes here
    try:
        return _run(args, say, board)
    except ArtifactError as error:
        say(str(error))
        return EXIT_REFUSED
    except (InputError, PinsError) as error:
        say(str(error))
        return EXIT_BAD_INPUT
    except CommandError as error:
        say(str(error))
        return EXIT_REFUSED if error.code == EXIT_REFUSED else EXIT_CHECK_FAILED
    except ReleaseError as error:
        say(str(error))
        return EXIT_CHECK_FAILED
    except OSError as error:
        say(_file_error(error, args.home))
        return EXIT_CHECK_FAILED if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG) else EXIT_BAD_INPUT
    except KeyboardInterrupt:
        say("interrupted; the current release is unchanged, run it again")
        return EXIT_INTERRUPTED
    finally:
        os.umask(before)


def _file_error(error: OSError, home: Path) -> str:
    where = error.filename or home
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"{where}: the disk is full; the current release is unchanged; free some space and run it again"
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return f"{where}: {error.strerror}; run it with sudo, or give a folder of yours with --home"
    return f"{where}: {error.strerror or error}"


def _run(args: argparse.Namespace, say: Say, board: Board) -> int:
    if args.command == "releases":
        check_result_target(args.json)
        return _list(read_home(args.home), args.json, say)
    request = _request(args, board) if args.command == "board" else None
    if args.dry_run:
        _, steps = _plan(args, request, board, read_home(args.home), _no_command)
        for number, step in enumerate(steps, 1):
            say(f"step {number} of {len(steps)}: {step.text}")
        say("nothing was changed (--dry-run)")
        return EXIT_DONE
    if request is None and not args.home.is_dir():
        raise InputError(f"{args.home}: no such folder; install with edge-install board")
    with _locked(args.home) as descriptor:

        def command(words: Sequence[str]) -> tuple[int, str]:
            return (board.run or _run_child)(descriptor, words)

        home = read_home(args.home)
        unfinished, steps = _plan(args, request, board, home, command)
        _do(steps, say, board.disk, home, unfinished)
    if args.command == "remove":
        board.disk.delete(args.home / LOG)
        board.disk.delete(args.home / LOCK)
        for folder in (args.home / "releases", args.home):
            with contextlib.suppress(OSError):  # something of the user's is in it
                folder.rmdir()
        return EXIT_DONE
    _say_current(read_home(args.home), say, changed=any(step.text.startswith("switch ") for step in steps))
    return EXIT_DONE


def _plan(
    args: argparse.Namespace, request: Request | None, board: Board, home: Home, command: Run
) -> tuple[int | None, list[Step]]:
    """Return the number of the release that the plan makes, None for none, and the steps."""
    if request is not None:
        return plan_board(home, request, board, command)
    return None, uninstall_steps(home) if args.command == "remove" else plan_rollback(home, args.to, command)


def plan_board(home: Home, request: Request, board: Board, command: Run) -> tuple[int | None, list[Step]]:
    """Return the number of the release to make, None if it is there, and the steps to it."""
    steps = removal_steps(home, home.unfinished, "unfinished, an earlier call was cut off")
    found = home.made_from(request.contents)
    if found is not None and found.number == home.current:
        return None, [*steps, *removal_steps(home, home.to_prune(found.number, found.previous, request.keep), "old")]
    number = home.next_number() if found is None else found.number
    release = Release(number, request.contents, home.current)
    if found is None:
        steps += build_steps(home, number, request, board, command)
    steps += check_steps(home, number, command)
    if found != release:
        steps += [Step("flush the disks", lambda disk: disk.flush()), record_step(home, release)]
    steps.append(switch_step(home, number))
    steps += removal_steps(home, home.to_prune(number, home.current, request.keep), "old")
    return (number if found is None else None), steps


def build_steps(home: Home, number: int, request: Request, board: Board, command: Run) -> list[Step]:
    """Return the steps that make a release's folder, environment and artifacts."""
    layout = home.layout
    artifacts = layout.artifacts(number)
    extras = [extra for extra in request.contents.extras if extra != "unitree" or board.machine == "x86_64"]
    wheel = f"{request.wheel}[{','.join(extras)}]" if extras else str(request.wheel)
    pip = [layout.program(number, "python"), "-m", "pip", "--disable-pip-version-check", "install"]

    def copy(disk: Disk) -> None:
        disk.make_folder(artifacts)
        for file in request.files:
            disk.copy(file, artifacts / file.name)

    size_mb = sum(file.stat().st_size for file in request.files) / 1e6
    pip += request.pip_options
    title = f"install the newest that fit, as {request.unpinned}" if request.unpinned else "install"
    install = [command_step(title, [*pip, wheel, *request.contents.requirements], command)]
    if request.pins is not None:
        pins = layout.environment(number) / "pins.txt"
        install = pinned_steps(pins, request.pins, pip, request.wheel, request.contents.requirements, command)
    steps = [
        Step(f"copy {len(request.files)} artifacts, {size_mb:.1f} MB, to {artifacts}", copy),
        command_step("make", [board.python, "-m", "venv", str(layout.environment(number))], command),
        *install,
    ]
    if "unitree" in request.contents.extras and board.machine != "x86_64":
        steps.append(command_step("get the DDS binding", [layout.program(number, "edge-install"), "dds"], command))
    # By the new release's own program: the one that runs this may know an older schema only.
    engines = [layout.program(number, "edge-install"), "engines", "--artifacts", str(artifacts)]
    return [*steps, command_step("verify the artifacts' hashes and build their engines", engines, command)]


def _do(steps: Sequence[Step], say: Say, disk: Disk, home: Home, unfinished: int | None) -> None:
    """Do the steps; a release that could not be finished is removed again, and a failed command's output is kept."""
    layout = home.layout
    try:
        for number, step in enumerate(steps, 1):
            say(f"step {number} of {len(steps)}: {step.text}")
            step.act(disk)
    except CommandError as error:
        first, _, output = str(error).partition("\n")
        _remove_unfinished(disk, home, unfinished)
        log = layout.home / LOG
        with contextlib.suppress(OSError):  # a full disk; the first line says what failed
            disk.write(log, output + "\n")
        raise CommandError(error.code, f"{first}; the current release is unchanged; all output: {log}") from None
    except (OSError, KeyboardInterrupt):
        _remove_unfinished(disk, home, unfinished)
        raise


def _remove_unfinished(disk: Disk, home: Home, unfinished: int | None) -> None:
    if unfinished is not None and not home.layout.record(unfinished).exists():
        with contextlib.suppress(OSError):  # the next call removes it
            disk.remove_tree(home.layout.folder(unfinished))


def _list(home: Home, where: str | None, say: Say) -> int:
    for release in home.releases:
        mark = "  (current)" if release.number == home.current else ""
        contents = release.contents
        extras = ",".join(contents.extras) or "no extras"
        say(f"release {release.number}: {contents.wheel} [{extras}], artifacts {contents.manifest_sha256[:12]}{mark}")
    for number in home.unfinished:
        say(f"release {number}: unfinished; the next edge-install board removes it")
    if home.find(home.current) is None:
        say(f"{home.layout.link}: no complete release is current")
    numbers = [release.number for release in home.releases]
    write_result(where, {"current": home.current, "releases": numbers, "unfinished": list(home.unfinished)})
    return EXIT_DONE if home.find(home.current) is not None else EXIT_CHECK_FAILED


def _say_current(home: Home, say: Say, *, changed: bool) -> None:
    say(f"{home.layout.link} is release {home.current}")
    if not changed:
        return
    say(f"running services keep the old release until: sudo systemctl restart {SERVICES}  (the robot has to stand)")
    say(f"back: edge-install rollback --home {home.layout.home}")
    say(f"undo of everything: edge-install remove --home {home.layout.home} --dry-run, then without --dry-run")


def _request(args: argparse.Namespace, board: Board) -> Request:
    """Check the arguments of `board`. Raises InputError, ArtifactError or OSError."""
    if args.extras and not _EXTRAS.fullmatch(args.extras):
        raise InputError(f"--extras {args.extras}: expected names with commas between them, e.g. cpu,unitree")
    if args.keep < 1:
        raise InputError(f"--keep {args.keep}: expected at least 1: the release to roll back to")
    extras = tuple(sorted(set(args.extras.split(",")))) if args.extras else ()
    artifacts = args.artifacts.absolute()
    manifest = read_manifest_bytes(artifacts)
    options: list[str] = []
    if args.wheels is not None:
        options += ["--no-index", "--find-links", _existing("--wheels", args.wheels, Path.is_dir)]
    if args.index is not None:
        options += ["--extra-index-url", args.index]
    if args.constraints is not None:
        options += ["-c", _existing("--constraints", args.constraints, Path.is_file)]
    wheel = args.wheel.absolute()
    unknown = sorted(set(extras) - wheel_extras(wheel))
    if unknown:
        raise InputError(f"--extras {unknown[0]}: {wheel.name} has no such extra")
    pins, unpinned = (None, "") if args.constraints else pins_of(wheel, extras, board.machine)
    return Request(
        wheel=wheel,
        artifacts=artifacts,
        files=tuple(sorted(path for path in artifacts.iterdir() if path.is_file())),
        contents=Contents(
            wheel.name, _digest(wheel), hashlib.sha256(manifest).hexdigest(), extras, tuple(args.requirements)
        ),
        pip_options=tuple(options),
        keep=args.keep,
        pins=pins,
        unpinned=unpinned,
    )


def _existing(option: str, path: Path, is_right: Callable[[Path], bool]) -> str:
    """Return a path without links. Raises InputError for another kind of file, or none."""
    if not is_right(path):
        raise InputError(f"{option} {path}: expected a {'folder' if is_right is Path.is_dir else 'file'}, found none")
    return os.path.realpath(path)


def _digest(path: Path) -> str:
    digest = hashlib.sha256()
    with open_regular(path) as file:
        while block := file.read(_HASH_BYTES):
            digest.update(block)
    return digest.hexdigest()


@contextlib.contextmanager
def _locked(home: Path) -> Iterator[int]:
    """Yield the descriptor of a lock on the releases; raises ReleaseError if another call has it."""
    home.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(home / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise ReleaseError(f"{home / LOCK}: another edge-install, or a pip that it started, works here; wait") from None
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def _run_child(lock: int, words: Sequence[str]) -> tuple[int, str]:
    """Run a command; returns its exit code and output.

    The child keeps the lock: if this process is killed, the next call waits for a pip that still writes.
    """
    done = subprocess.run(
        list(words), env=_environment(os.environ), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True, errors="replace", check=False, pass_fds=(lock,),
    )  # fmt: skip
    return done.returncode, done.stdout


def _environment(given: Mapping[str, str]) -> dict[str, str]:
    """Return the environment without what would let a new release read packages of another."""
    return {name: value for name, value in given.items() if name not in ("PYTHONPATH", "PYTHONHOME", "PIP_TARGET")}


def _no_command(words: Sequence[str]) -> tuple[int, str]:
    raise AssertionError(f"a dry run has run {words}")
