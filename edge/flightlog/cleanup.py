"""Clean-up of old flight logs: `python -m edge.flightlog.cleanup FOLDER`, as the runner's service does before every
start.

A recording bounds itself, but every start makes another. Whole runs are deleted, the oldest first, until the rest fits;
the newest runs stay whatever they take, so that the last events can always be read. Which run is newer, `flight-order`
says, where each call adds the runs that it has not seen: a board without a clock begins every day at the same date.
"""

from __future__ import annotations

import argparse
import contextlib
import re
import shutil
import stat
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from edge.core.cli import EXIT_BAD_INPUT, EXIT_DONE, command_line, messages, write_whole
from firmware_bridge.system.input_file import read_text
from firmware_bridge.system.terminal import CommandParser

KEEP_BYTES: Final = 8 * 1024**3
"""Default limit of all logs, bytes: two recordings at their own bound (edge.flightlog.recorder); our choice."""
KEEP_SHARE: Final = 0.25
"""Largest share of the file system, where that is less."""
KEEP_RUNS: Final = 2
EMPTY_BYTES: Final = 1000
"""Size below which a run has no records: its runner was killed while it waited to be armed."""
ORDER: Final = "flight-order"
_PART: Final = re.compile(r"(flight-[A-Za-z0-9_-]+)(?:\.\d{3,})?\.mcap", re.ASCII)

EXAMPLES = """examples:
  python -m edge.flightlog.cleanup /var/lib/tic-vla-edge
  python -m edge.flightlog.cleanup /var/lib/tic-vla-edge --keep-bytes 2000000000

Only files named flight-ID.mcap and flight-ID.NNN.mcap are considered.
exit codes: 0 done, 2 bad arguments or a folder that cannot be read or written, 130 interrupted
"""


@dataclass
class _Run:
    """Files of one recording."""

    name: str
    newest_ns: int = 0
    size: int = 0
    files: tuple[Path, ...] = ()


def runs(folder: Path) -> list[_Run]:
    """Return the recordings in a folder, newest first: those seen earlier in that order, then the new by time of file.

    Raises OSError.
    """
    found: dict[str, _Run] = {}
    for path in sorted(folder.iterdir()):
        match, status = _PART.fullmatch(path.name), path.lstat()
        if match is None or not stat.S_ISREG(status.st_mode):
            continue
        run = found.setdefault(match[1], _Run(match[1]))
        run.newest_ns = max(run.newest_ns, status.st_mtime_ns)
        run.size += status.st_size
        run.files += (path,)
    seen: dict[str, int] = {}
    with contextlib.suppress(OSError, ValueError):  # none yet, or damaged: the times of the files decide
        seen = {name: number for number, name in enumerate(read_text(folder / ORDER).split())}
    return sorted(found.values(), key=lambda run: (seen.get(run.name, len(seen)), run.newest_ns), reverse=True)


def clean(folder: Path, keep_bytes: int, keep_runs: int = KEEP_RUNS) -> tuple[list[Path], int]:
    """Delete old recordings beyond the total; return the deleted files and the remaining bytes. Raises OSError."""
    deleted: list[Path] = []
    kept: list[str] = []
    left = newest = 0
    for run in runs(folder):
        # After the first recording that does not fit, delete all older ones.
        if newest < keep_runs or (not deleted and left + run.size <= keep_bytes):
            left += run.size
            newest += run.size >= EMPTY_BYTES
            kept.insert(0, run.name)
            continue
        for path in run.files:
            path.unlink(missing_ok=True)
            deleted.append(path)
    with contextlib.suppress(OSError):  # a full disk: the next call does it
        write_whole(folder / ORDER, "\n".join(kept) + "\n")
    return deleted, left


def parser() -> argparse.ArgumentParser:
    """Command line."""
    p = CommandParser(
        "edge.flightlog.cleanup",
        description=__doc__,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("folder", type=Path, metavar="FOLDER", help="folder of the flight logs")
    p.add_argument(
        "--keep-bytes",
        type=int,
        default=KEEP_BYTES,
        metavar="N",
        help=f"limit of all logs (default: {KEEP_BYTES}, at most a quarter of the file system)",
    )
    return p


_print = messages("edge.flightlog.cleanup")


@command_line("edge.flightlog.cleanup")
def main(
    argv: Sequence[str] | None = None, total_bytes: Callable[[Path], int] = lambda path: shutil.disk_usage(path).total
) -> int:
    """Entry point; returns the exit code. `total_bytes`: size of the file system that holds a path."""
    args = parser().parse_args(argv)
    if args.keep_bytes < 0:
        _print(f"--keep-bytes {args.keep_bytes}: expected 0 or more")
        return EXIT_BAD_INPUT
    try:
        deleted, left = clean(args.folder, min(args.keep_bytes, round(KEEP_SHARE * total_bytes(args.folder))))
    except OSError as error:
        _print(
            f"{error.filename or args.folder}: {error.strerror or error}; expected a folder whose logs may be deleted"
        )
        return EXIT_BAD_INPUT
    if deleted:
        _print(f"{len(deleted)} files of old runs deleted, the first {deleted[0].name}; {left / 2**20:.0f} MiB stay")
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
