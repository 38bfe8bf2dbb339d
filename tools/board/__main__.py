"""Prove on an emulated arm64 computer what docs/robot.md has a user do: install, check, replay, drive and update.

Needs root, debootstrap and qemu-user-static. The root folder (1 GB) is made once and kept. Emulation is 20 to 50 times
slower than a board: its times say nothing about one. Writes DIR/result.json and DIR/transcript.txt.

exit codes: 0 every step passed, 1 a step failed, 2 bad arguments or input, 130 interrupted
"""

from __future__ import annotations

import argparse
import json
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from edge.artifacts.files import read_manifest
from edge.core.cli import (
    EXIT_BAD_INPUT,
    EXIT_CHECK_FAILED,
    EXIT_DONE,
    check_result_directory,
    command_line,
    messages,
    write_result,
)
from edge.flightlog.reader import read_messages
from firmware_bridge.system.terminal import CommandParser
from sim_hil.realtime.robots import MAX_DOMAIN
from tools.board import drive as board_drive
from tools.board import journey
from tools.board.journey import HOME, INPUT, INSTALLER, ROBOT_FILE
from tools.board.root import RootError, ended, make_root, mounted, run

REPOSITORY: Final = Path(__file__).resolve().parents[2]
ROBOT: Final = REPOSITORY / "firmware_bridge/robots/go2_sim.toml"
LINES: Final = 40  # of a step's output in the result


@command_line("board", {RootError: EXIT_BAD_INPUT})
def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = _parser().parse_args(argv)
    try:
        _check(args)
    except (ValueError, OSError) as error:
        messages("board")(str(error))
        return EXIT_BAD_INPUT
    args.out.mkdir(parents=True, exist_ok=True)
    make_root(args.root)
    (args.out / "transcript.txt").unlink(missing_ok=True)
    wheels = _copy(args)
    with mounted(args.root):
        results = list(_steps(args, *wheels))
    write_result(str(args.out / "result.json"), {"tagged": "measured, emulated", "steps": results})
    return EXIT_DONE if all(step["passed"] for step in results) else EXIT_CHECK_FAILED


def _check(args: argparse.Namespace) -> None:
    """Check the arguments before a root is made, which takes half an hour. Raises ValueError or OSError."""
    read_manifest(args.artifacts)
    if not 0 < args.replay_to < 1e6:
        raise ValueError(f"--replay-to {args.replay_to}: expected seconds above 0")
    if not 0 <= args.domain <= MAX_DOMAIN:
        raise ValueError(f"--domain {args.domain}: expected 0 to {MAX_DOMAIN}")
    check_result_directory(args.out)
    if next(read_messages(args.flight), None) is None:
        raise ValueError(f"--flight {args.flight}: expected a flight log with messages")
    check_result_directory(args.root, "--root")


def _parser() -> argparse.ArgumentParser:
    parser = CommandParser(
        "python -m tools.board", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--root",
        type=Path,
        required=True,
        metavar="DIR",
        help="folder of the arm64 root, made once; /opt in it is ours",
    )
    parser.add_argument(
        "--artifacts", type=Path, required=True, metavar="DIR", help="artifacts exported on this machine"
    )
    parser.add_argument("--flight", type=Path, required=True, metavar="FILE.mcap", help="a log recorded with them here")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for result and transcript")
    parser.add_argument("--replay-to", type=float, default=4.0, metavar="S", help="seconds of the log to replay (4)")
    parser.add_argument("--domain", type=int, default=91, help="DDS domain of the drive (91)")
    return parser


def _copy(args: argparse.Namespace) -> tuple[str, str]:
    """Put what a user copies to a board into the root; returns the names of two wheels of this checkout.

    They differ in their build tag only, which is enough for another release.
    """
    folder = args.root / INPUT.lstrip("/")
    for old in (INPUT, INSTALLER, HOME, "/root/.cache"):  # pip's downloads: a new board has none
        shutil.rmtree(args.root / old.lstrip("/"), ignore_errors=True)
    shutil.copytree(args.artifacts, folder / "artifacts")
    shutil.copy(args.flight, folder / "flight.mcap")
    shutil.copy(REPOSITORY / "constraints.txt", folder / "constraints.txt")
    robot = args.root / ROBOT_FILE.lstrip("/")
    robot.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(ROBOT, robot)
    run([sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(folder), str(REPOSITORY)])
    (wheel,) = folder.glob("*.whl")
    name, version, tags = wheel.name.split("-", 2)
    next_wheel = f"{name}-{version}-1-{tags}"
    shutil.copy(wheel, folder / next_wheel)
    return wheel.name, next_wheel


def _steps(args: argparse.Namespace, wheel: str, next_wheel: str) -> Iterator[dict[str, Any]]:
    """Run one step after another; each gives its name, whether it passed, seconds and what it found."""
    for command in (*journey.installation(wheel), *journey.use(args.replay_to)):
        yield _command(args, command)
    yield _drive(args, "edge-bridge drives", board_drive.drive)
    yield _drive(args, "edge-run, as far as an emulated processor lets it", board_drive.attempt_run)
    for command in journey.update(next_wheel):
        yield _command(args, command)


def _command(args: argparse.Namespace, command: journey.Command) -> dict[str, Any]:
    done = ended(args.root, command.words)
    current = journey.current_release(args.root)
    fault = command.fault(done.code, done.output, current)
    lines = [line for line in done.output.splitlines() if not any(word in line for word in journey.QUIET)]
    found: dict[str, Any] = {"command": shlex.join(command.words), "exit_code": done.code, "current": current}
    found["peak_rss_mb"] = done.peak_rss_mb
    if "-X" in command.words:
        (args.out / "importtime.txt").write_text(done.output)
        found["imports"], lines = journey.import_times(done.output), []
    return _note(args.out, command.name, fault, done.wall_s, {**found, "output": lines[-LINES:]})


def _drive(args: argparse.Namespace, name: str, drive: Callable[[Path, Path, int], dict[str, Any]]) -> dict[str, Any]:
    started_s = time.monotonic()
    fault, found = None, dict[str, Any]()
    try:
        found = drive(args.root, args.out, args.domain)
    except (board_drive.DriveError, subprocess.SubprocessError) as error:
        fault = str(error)
    return _note(args.out, name, fault, round(time.monotonic() - started_s, 1), found)


def _note(out: Path, name: str, fault: str | None, wall_s: float, found: dict[str, Any]) -> dict[str, Any]:
    """Write a step to the transcript and to the terminal, and return it."""
    result = "passed" if fault is None else f"FAILED: {fault}"
    with (out / "transcript.txt").open("a") as file:
        file.write(f"== {name}: {result}, {wall_s} s\n{json.dumps(found, indent=1)}\n")
    print(f"board: {name}: {result}, {wall_s} s", flush=True)
    return {"name": name, "passed": fault is None, "fault": fault, "wall_s": wall_s, **found}


if __name__ == "__main__":
    sys.exit(main())
