"""`edge-install board`, `rollback`, `releases`, `remove`: put a release on the board, beside the one that is used.

A release has its own Python environment and its own artifacts. It is built, checked by its own programs and flushed to
the disk before the link `current` leads to it; the release before it stays. No service is started or stopped.
"""

from __future__ import annotations

import argparse
import contextlib
import errno
import os
import platform
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from edge.artifacts.files import ArtifactError
from edge.core.cli import (
    EXIT_BAD_INPUT,
    EXIT_CHECK_FAILED,
    EXIT_DONE,
    EXIT_INTERRUPTED,
    EXIT_REFUSED,
    check_result_target,
    write_result,
)
from edge.deploy.artifact_copy import check_artifacts, plain_files, sha256_of
from edge.deploy.pins import PinsError, pinned_steps, pins_of, wheel_extras
from edge.deploy.releases import (
    FOLDER,
    LOCK,
    MARKER,
    CommandError,
    Contents,
    Home,
    InputError,
    Release,
    ReleaseError,
    check_owner,
    current_text,
    home_argument,
    locked,
    read_home,
)
from edge.deploy.steps import (
    Disk,
    Run,
    Step,
    check_steps,
    command_step,
    damage_of,
    mark_home,
    note_step,
    plan_rollback,
    record_step,
    removal_steps,
    run_child,
    switch_step,
    uninstall_steps,
    verify_step,
)
from firmware_bridge.system.input_file import open_regular

HOME: Final = Path("/opt/tic-vla-edge")
COMMANDS: Final = ("board", "rollback", "releases", "remove")
LOG: Final = "install.log"
SERVICES: Final = "tic-vla-edge-bridge tic-vla-edge-runner"
_EXTRAS: Final = re.compile(r"[a-z]+(,[a-z]+)*")
Say = Callable[[str], None]


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


def _release_number(text: str) -> int:
    if not re.fullmatch(r"[1-9][0-9]{0,8}", text, re.ASCII):
        raise argparse.ArgumentTypeError(f"expected the number of a release, from 1 on, found {text!r}")
    return int(text)


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
    back.add_argument("--to", type=_release_number, metavar="N", help="number of the release (edge-install releases)")
    listing = commands.add_parser("releases", help="list the releases of this board")
    listing.add_argument("--json", metavar="FILE|-", help="write the list as JSON")
    remove = commands.add_parser("remove", help="undo of board: remove every release and the link")
    for parser in (board, back, listing, remove):
        parser.add_argument(
            "--home", type=home_argument, default=HOME, metavar="DIR", help=f"folder of the releases ({HOME})"
        )
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
        say(f"interrupted; {current_text(args.home)}, run it again")
        return EXIT_INTERRUPTED
    finally:
        os.umask(before)


def _file_error(error: OSError, home: Path) -> str:
    where = error.filename or home
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"{where}: the disk is full; {current_text(home)}; free some space and run it again"
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return f"{where}: {error.strerror}; run it with sudo, or give a folder of yours with --home"
    return f"{where}: {error.strerror or error}"


def _run(args: argparse.Namespace, say: Say, board: Board) -> int:
    if args.command == "releases":
        check_result_target(args.json)
        return _list(_own_home(args), args.json, say)
    request = _request(args, board) if args.command == "board" else None
    if request is None and not args.home.is_dir():
        raise InputError(f"{args.home}: no such folder; install with edge-install board")
    home = _own_home(args)
    if args.dry_run:
        _, steps = _plan(args, request, board, home, _succeed)
        for number, step in enumerate(steps, 1):
            say(f"step {number} of {len(steps)}: {step.text}")
        say("nothing was changed (--dry-run)")
        return EXIT_DONE
    with locked(args.home) as descriptor:

        def command(words: Sequence[str]) -> tuple[int, str]:
            return (board.run or run_child)(descriptor, words)

        home = _own_home(args)
        mark_home(home, board.disk)
        unfinished, steps = _plan(args, request, board, home, command)
        _do(steps, say, board.disk, home, unfinished)
    if args.command == "remove":
        for name in (LOG, LOCK, MARKER):
            board.disk.delete(args.home / name)
        for folder in (args.home / FOLDER, args.home):
            with contextlib.suppress(OSError):  # something of the user's is in it
                folder.rmdir()
        return EXIT_DONE
    _say_current(read_home(args.home), say, changed=any(step.text.startswith("switch ") for step in steps))
    return EXIT_DONE


def _own_home(args: argparse.Namespace) -> Home:
    """Read the releases. Raises InputError for a folder of another program."""
    home = read_home(args.home)
    check_owner(home, empty_allowed=args.command in ("board", "releases"))
    return home


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
    damage = None if found is None else damage_of(home, found, command)
    previous, damaged = home.current, None
    if found is not None and damage is not None:
        # In another folder: services may still run from the damaged one.
        steps.append(note_step(f"build release {found.number} again, it is damaged: {damage}"))
        damaged = found.number
        previous = found.previous if damaged == home.current else home.current
        found = None
    if found is not None and found.number == home.current:
        return None, [*steps, *removal_steps(home, home.to_prune(found.number, found.previous, request.keep), "old")]
    number = home.next_number() if found is None else found.number
    release = Release(number, request.contents, previous)
    if found is None:
        steps += build_steps(home, number, request, board, command)
        steps.append(verify_step(home, number, request.contents.manifest_sha256))
        steps += check_steps(home, number, command)
    if found != release:
        steps += [Step("flush the disks", lambda disk: disk.flush()), record_step(home, release)]
    steps.append(switch_step(home, number))
    if damaged is not None and damaged != home.current:
        steps += removal_steps(home, [damaged], "damaged")
    old = [old for old in home.to_prune(number, previous, request.keep) if old not in (home.current, damaged)]
    return (number if found is None else None), [*steps, *removal_steps(home, old, "old")]


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
        raise CommandError(error.code, f"{first}; {current_text(layout.home)}; all output: {log}") from None
    except (ArtifactError, OSError, KeyboardInterrupt):
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
        record = home.layout.record(number)
        what = f"damaged, {record} cannot be read" if os.path.lexists(record) else "unfinished"
        say(f"release {number}: {what}; the next edge-install board removes it")
    if home.find(home.current) is None:
        reason = "" if home.current is None else f": {home.layout.record(home.current)} cannot be read"
        say(f"{home.layout.link}: no complete release is current{reason}; make one with edge-install board")
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
    try:
        manifest_sha256 = check_artifacts(artifacts)
    except ArtifactError as error:
        raise ArtifactError(f"{error}; copy or export the artifacts again") from error
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
        files=plain_files(artifacts),
        contents=Contents(wheel.name, _digest(wheel), manifest_sha256, extras, tuple(args.requirements)),
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
    with open_regular(path) as file:
        return sha256_of(file)


def _succeed(_words: Sequence[str]) -> tuple[int, str]:
    """Stand for every program in a dry run, which starts none."""
    return 0, ""
