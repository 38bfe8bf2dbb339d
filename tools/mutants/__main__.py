"""Change safety-critical modules in small ways, one at a time, and report the changes that no test notices.

    python -m tools.mutants                                   # every module of tools/mutants/targets.toml
    python -m tools.mutants --module edge.motion.controller   # one of them
    python -m tools.mutants --table                           # the results so far, without a run

A mutant is killed when a test fails or takes ten times as long. A second call goes on where the first has ended; it
runs survivors again, because tests may have been added, and all mutants of a module whose source has changed.
Exit codes: 0 every mutant is killed or named in tools/mutants/equivalents.toml; 1 some survive or were not run; 2 bad
arguments, or tests that fail without a change; 130 interrupted.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import pytest

from edge.core.cli import EXIT_BAD_INPUT, EXIT_CHECK_FAILED, EXIT_DONE, command_line
from firmware_bridge.system.terminal import CommandParser
from tools.mutants.plan import DONE, TABLE_HEAD, Results, read_equivalents, read_targets, row_of
from tools.mutants.session import MutantSession

MOST_MINUTES: Final = 7 * 24 * 60


def parser() -> argparse.ArgumentParser:
    """Command line of `python -m tools.mutants`."""
    p = CommandParser(
        "python -m tools.mutants", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--module", action="append", choices=sorted(read_targets()), metavar="NAME", help="may be repeated")
    p.add_argument("--out", type=Path, default=Path("out/mutants"), metavar="DIR", help="default out/mutants")
    p.add_argument("--minutes", type=float, default=600.0, metavar="N", help="end after this time; default 600")
    p.add_argument("--table", action="store_true", help="print the results so far")
    return p


@command_line("mutants")
def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    args = parser().parse_args(argv)
    if not 0 < args.minutes <= MOST_MINUTES:
        sys.stderr.write(f"mutants: --minutes {args.minutes}: expected above 0, at most {MOST_MINUTES} (a week)\n")
        return EXIT_BAD_INPUT
    end_ns = time.monotonic_ns() + round(args.minutes * 60e9)
    modules: list[str] = args.module or list(read_targets())
    if len(modules) == 1 and not args.table:
        problem = _run(modules[0], args.out, end_ns)
        if problem:
            sys.stderr.write(f"mutants: {modules[0]}: {problem}\n")
            return EXIT_BAD_INPUT
    elif not args.table:
        for module in modules:  # each in a process of its own, which imports that module's tests alone
            left = (end_ns - time.monotonic_ns()) / 60e9
            command = [sys.executable, "-m", "tools.mutants", "--module", module, "--out", str(args.out)]
            ended = subprocess.run([*command, "--minutes", f"{left:.2f}"], stdout=subprocess.DEVNULL, check=False)
            if ended.returncode not in (EXIT_DONE, EXIT_CHECK_FAILED):
                return ended.returncode
    equivalents = read_equivalents()
    rows = [row_of(module, Results(args.out, module).found, equivalents.get(module, {})) for module in modules]
    sys.stdout.write("\n".join([TABLE_HEAD, *(row.text for row in rows)]) + "\n")
    for row in rows:
        for key in row.survivors:
            sys.stdout.write(f"survived: {row.module}: {key}\n")
    return EXIT_CHECK_FAILED if any(row.survivors or row.unfinished for row in rows) else EXIT_DONE


def _run(module: str, out: Path, end_ns: int) -> str:
    """Run the mutants of one module; returns why that was not possible, or nothing."""
    results = Results(out, module)
    known = {key: result for key, result in results.found.items() if result in DONE}
    known |= read_equivalents().get(module, {})
    session = MutantSession(module, known, end_ns, results.add)
    options = ["-q", "-p", "no:cacheprovider", "-m", "not process and not repeated"]
    code = pytest.main([*options, *read_targets()[module]], plugins=[session])
    return session.problem or ("" if code in (0, 5) else f"pytest ended with exit code {int(code)}")


if __name__ == "__main__":
    sys.exit(main())
