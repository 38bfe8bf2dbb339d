"""`python -m tools.train.importers`: import recordings of real robots as a data set for training."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from edge.core.cli import (
    EXIT_BAD_INPUT,
    EXIT_DONE,
    EXIT_INTERRUPTED,
    check_result_directory,
    check_result_target,
    command_line,
    write_result,
)
from firmware_bridge.system.terminal import CommandParser, one_line
from tools.train.config.checks import TrainError
from tools.train.drives.dataset import DatasetWriter
from tools.train.drives.drive import Entry
from tools.train.importers.cut import drives
from tools.train.importers.recording import LAYOUTS

EXAMPLES = """examples:
  python -m tools.train.importers scand extracted/scand --robot jackal --out data/real
  python -m tools.train.importers gnd extracted/gnd --robot jackal --out data/real --json -

exit codes: 0 done, 2 bad input, 130 interrupted
"""


def import_folder(root: Path, layout: str, robot: str, out: Path) -> dict[str, Any]:
    """Import every recording below `root` into the data set `out`; existing drives are kept. Returns counts.

    Raises TrainError, OSError.
    """
    form = LAYOUTS[layout]
    folders = sorted(folder for folder in root.iterdir() if folder.is_dir() and form.fits(folder))
    if not folders:
        raise TrainError(f"{root}: found no recording of {layout}; expected folders with {' and '.join(form.files)}")
    with DatasetWriter(out) as writer:
        for folder in folders:
            for drive in drives(form.read(folder), layout, robot):
                if not writer.has(drive.id):
                    path = writer.path(drive.id)
                    drive.save(path)
                    writer.add(Entry.of(drive, path))
        return {"recordings": len(folders), **writer.summary(f"{layout}-"), "sha256": writer.finish().sha256}


@command_line("importers")
def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit code."""
    parser = CommandParser(
        prog="python -m tools.train.importers",
        description=__doc__,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("layout", choices=sorted(LAYOUTS), help="format of the recordings")
    parser.add_argument("root", type=Path, metavar="DIR", help="folder with one folder per recording")
    parser.add_argument("--robot", default="unknown", metavar="NAME", help="robot that was recorded")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="data set to create or extend")
    parser.add_argument("--json", metavar="FILE", help="write counts as JSON to FILE, or to standard output for -")
    args = parser.parse_args(argv)
    try:
        check_result_target(args.json)
        check_result_directory(args.out)
        result = import_folder(args.root, args.layout, args.robot, args.out)
        write_result(args.json, result)
    except (TrainError, OSError) as error:
        sys.stderr.write(f"importers: {one_line(error)}\n")
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    sys.stderr.write(f"importers: {result['drives']} episodes of 20 s from {result['recordings']} recordings\n")
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
