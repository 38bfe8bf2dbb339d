"""Table of the command latency of demo runs: from the runner's sent command to its arrival at the robot, by protocol.

    python -m tools.bench.command_latency out/demo out/can

reads the flight log and the trace of folders that `python -m tools.demo` has written.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from edge.core.cli import EXIT_CHECK_FAILED, EXIT_DONE, check_result_target, command_line, write_result
from tools.bench import bad_input, command_parser
from tools.report.demo_report import RunFiles, load_run, recorded_artifacts
from tools.report.numbers import command_latency_ms
from tools.report.run_data import ReportError


@command_line("command_latency")
def main(argv: list[str] | None = None) -> int:
    """Run the command; exit codes 0 done, 1 a run without a command that can be matched, 2 bad input."""
    p = command_parser(__doc__)
    p.add_argument("runs", nargs="+", type=Path, metavar="DIR", help="folder of a demo run")
    args = p.parse_args(argv)
    try:
        check_result_target(args.json)
        runs = [row(folder) for folder in args.runs]
    except (ReportError, OSError, ValueError) as error:
        return bad_input("command_latency", error)
    write_result(args.json, {"runs": runs, "tagged": "measured"})
    table = Table(title="Command sent until received by the robot, ms", title_justify="left")
    for name in ("run", "robot", "protocol", "n", "p50", "p99", "max"):
        table.add_column(name, justify="right" if name in ("n", "p50", "p99", "max") else "left")
    for one in runs:
        figures = ["–" if one[name] is None else f"{one[name]:.1f}" for name in ("p50", "p99", "max")]
        table.add_row(one["run"], one["robot"], one["protocol"], str(one["n"]), *figures)
    Console(stderr=args.json == "-").print(table)
    return EXIT_DONE if all(one["n"] for one in runs) else EXIT_CHECK_FAILED


def row(folder: Path) -> dict[str, Any]:
    """Return one run's robot, protocol and figures. Raises ReportError."""
    data = load_run(RunFiles(folder, recorded_artifacts(folder)))
    about = {key: str(data.settings.get(key, "go2" if key == "robot" else "unitree")) for key in ("robot", "protocol")}
    return {"run": str(folder), **about, **command_latency_ms(data)}


if __name__ == "__main__":
    sys.exit(main())
