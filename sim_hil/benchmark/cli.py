"""`edge-bench`: run the benchmark's episodes and measure success, collisions and latency."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from edge.core.cli import command_line
from sim_hil.benchmark.arguments import SUBCOMMANDS


@command_line("edge-bench")
def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code (`sim_hil.benchmark.arguments.EXAMPLES`).

    Each sub-command loads only its own modules: those of a run take seconds.
    """
    argv = sys.argv[1:] if argv is None else list(argv)
    if argv[:1] == [SUBCOMMANDS[-1]]:
        from sim_hil.benchmark.suite import validate

        return int(validate.main(argv[1:]))
    if argv and argv[0] in SUBCOMMANDS:
        from sim_hil.benchmark.results import compare

        return compare.main(argv)
    from sim_hil.benchmark import run_command

    return run_command.main(argv)


if __name__ == "__main__":
    sys.exit(main())
