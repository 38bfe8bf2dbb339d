"""Prove on an emulated arm64 computer what docs/robot.md has a user do: install, check, replay and drive.

Needs root, debootstrap and qemu-user-static. The root folder (1 GB) is made once and kept. Emulation is 20 to 50 times
slower than a board: its times say nothing about one. Writes DIR/result.json and DIR/transcript.txt.

exit codes: 0 every step passed, 1 a step failed, 2 bad arguments or input, 130 interrupted
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from edge.core.cli import EXIT_BAD_INPUT, EXIT_CHECK_FAILED, EXIT_DONE, command_line, messages, write_result
from tools.board import drive as board_drive
from tools.board.root import RootError, inside, make_root, mounted, run

HOME: Final = "opt/tic-vla-edge"
BIN: Final = f"/{HOME}/venv/bin"
REPOSITORY: Final = Path(__file__).resolve().parents[2]
ROBOT: Final = REPOSITORY / "firmware_bridge/robots/go2_sim.toml"
QUIET: Final = ("cpuinfo", "cpuid_info")  # ONNX Runtime about the emulated processor


@command_line("board", {RootError: EXIT_BAD_INPUT})
def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = _parser().parse_args(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    for path in (args.artifacts / "manifest.json", args.flight):
        if not path.is_file():
            messages("board")(f"{path}: no such file")
            return EXIT_BAD_INPUT
    make_root(args.root)
    _copy(args)
    with mounted(args.root):
        results = list(_steps(args))
    write_result(str(args.out / "result.json"), {"tagged": "measured, emulated", "steps": results})
    return EXIT_DONE if all(step["passed"] for step in results) else EXIT_CHECK_FAILED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "python -m tools.board", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True, metavar="DIR", help="folder of the arm64 root, made once")
    parser.add_argument(
        "--artifacts", type=Path, required=True, metavar="DIR", help="artifacts exported on this machine"
    )
    parser.add_argument("--flight", type=Path, required=True, metavar="FILE.mcap", help="a log recorded with them here")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for result and transcript")
    parser.add_argument("--replay-to", type=float, default=4.0, metavar="S", help="seconds of the log to replay (4)")
    parser.add_argument("--domain", type=int, default=91, help="DDS domain of the drive (91)")
    return parser


def _copy(args: argparse.Namespace) -> None:
    """Put the wheel of this checkout, the artifacts, the log and the robot file into the root."""
    home = args.root / HOME
    shutil.rmtree(home / "input", ignore_errors=True)
    shutil.copytree(args.artifacts, home / "input/artifacts")
    shutil.copy(args.flight, home / "input/flight.mcap")
    shutil.copy(REPOSITORY / "constraints.txt", home / "input/constraints.txt")
    shutil.copy(ROBOT, home / "robot.toml")
    run([sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(home / "input"), str(REPOSITORY)])


def _steps(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Run one step after another; each gives its name, whether it passed, seconds and what it found."""
    home, root = f"/{HOME}", args.root
    wheel = next((root / HOME / "input").glob("*.whl")).name
    artifacts, flight = f"{home}/input/artifacts", f"{home}/input/flight.mcap"
    pip = [f"{BIN}/pip", "--disable-pip-version-check", "install", "-q", "-c", f"{home}/input/constraints.txt"]
    replay = [f"{BIN}/edge-replay", flight, "--artifacts", artifacts, "--to", str(args.replay_to), "--json", "-"]
    commands: dict[str, list[str]] = {
        "make the environment": ["python3", "-m", "venv", f"{home}/venv"],
        "install the wheel": [*pip, "--force-reinstall", f"{home}/input/{wheel}[cpu]"],
        "edge-install dds": [f"{BIN}/edge-install", "dds"],
        "edge-install dds, again": [f"{BIN}/edge-install", "dds"],
        "edge-run --help": [f"{BIN}/edge-run", "--help"],
        "edge-doctor": [f"{BIN}/edge-doctor", "--artifacts", artifacts, "--ticks", "0"],
        "edge-export verify": [f"{BIN}/edge-export", "verify", artifacts],
        "edge-replay": replay,
        "size": ["du", "-sm", f"{home}/venv"],
    }
    for name, words in commands.items():
        yield _step(args.out, name, lambda words=words: {"output": inside(root, words)})  # type: ignore[misc]
    yield _step(args.out, "edge-bridge drives", lambda: board_drive.drive(root, args.out, args.domain))


def _step(out: Path, name: str, action: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    started_s = time.monotonic()
    try:
        found, passed = action(), True
    except (RootError, board_drive.DriveError, subprocess.SubprocessError) as error:
        found, passed = {"error": str(error)}, False
    wall_s = round(time.monotonic() - started_s, 1)
    if "output" in found:
        lines = [line for line in str(found["output"]).splitlines() if not any(word in line for word in QUIET)]
        found = {"output": lines[-40:]}
    with (out / "transcript.txt").open("a") as file:
        file.write(f"== {name}: {'passed' if passed else 'FAILED'}, {wall_s} s\n{json.dumps(found, indent=1)}\n")
    print(f"board: {name}: {'passed' if passed else 'FAILED'}, {wall_s} s", flush=True)
    return {"name": name, "passed": passed, "wall_s": wall_s, **found}


if __name__ == "__main__":
    sys.exit(main())
