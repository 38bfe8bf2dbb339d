"""`edge-replay explain`: why the robot stopped, collided, went astray or ran out of time, from its flight log."""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from edge.core.cli import EXIT_BAD_INPUT, EXIT_DONE, check_result_target, command_line, messages, write_result
from edge.flightlog.explain.explanation import Explanation, deciding, explain
from edge.flightlog.explain.flight import Flight, read_flight
from edge.flightlog.reader import RecordingError
from firmware_bridge.system.terminal import CommandParser

EXAMPLES = """examples:
  edge-replay explain flight.mcap
  edge-replay explain out/bench/flights/office-desk-0-go2.mcap --json - --page why.html

Rules compare picture, text, waypoints, plan, command and motion, and name the first that disagrees. Whether the text
contradicts the scene is known only where a simulator recorded the truth. docs/benchmark.md explains every cause.
exit codes: 0 done, 2 bad arguments or input, 130 interrupted
"""

PageWriter = Callable[[Path, Path, Flight, Sequence[Explanation]], None]
"""Writes the page: (page, log, flight, explanations); raises OSError."""


def parser() -> argparse.ArgumentParser:
    """Command line of `edge-replay explain`."""
    p = CommandParser(
        "edge-replay explain",
        description=__doc__,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("file", type=Path, metavar="FILE.mcap", help="flight log of edge-run --record or of edge-bench")
    p.add_argument("--page", type=Path, metavar="FILE", help="write a page with pictures (extra export or sim)")
    p.add_argument("--json", metavar="FILE|-", help="write the explanations as JSON")
    return p


_print = messages("edge-replay explain")


def as_result(path: Path, flight: Flight, found: Sequence[Explanation]) -> dict[str, Any]:
    """Return the explanations for --json.

    `decisive`: index of the event that cost the goal, None without one; `damage`: one line, None for a whole log.
    """
    decisive = deciding(flight, found)
    return {
        "file": str(path),
        "instruction": flight.instruction,
        "new_instructions": [
            {"at_s": round(flight.seconds(at_ns), 1), "instruction": text} for at_ns, text in flight.new_instructions
        ],
        "duration_s": round(flight.seconds(flight.end_ns), 1),
        "damage": flight.notice,
        "truth": bool(flight.truths),
        "events": [each.as_json() for each in found],
        "causes": dict(Counter(each.verdict.cause for each in found)),
        "decisive": None if decisive is None else found.index(decisive),
        "tagged": "measured",
    }


def table(result: dict[str, Any]) -> str:
    """Format the explanations as text."""
    lines = [f"instruction: {result['instruction']}"]
    lines += [f"instruction from {each['at_s']} s: {each['instruction']}" for each in result["new_instructions"]]
    if not result["events"]:
        lines.append("no stop of 2 s, collision, detour or timeout in this log")
    for number, event in enumerate(result["events"]):
        mark = "  <- decisive" if number == result["decisive"] else ""
        lines += ["", f"{event['event']} at {event['at_s']} s: {event['detail']}{mark}",
                  f"  cause: {event['cause']}: {event['because']}"]  # fmt: skip
        if event["refers"]:
            continue
        lines += [f"    {evidence}" for evidence in event["evidence"] if evidence]
        lines += [f"  {question}: {answer}" for question, answer in event["steps"].items()]
    if not result["truth"]:
        lines += ["", "The log has no ground truth: collisions and a text that contradicts the scene stay unknown."]
    return "\n".join(lines) + "\n"


@command_line("edge-replay explain", {RecordingError: EXIT_BAD_INPUT, OSError: EXIT_BAD_INPUT})
def main(argv: Sequence[str] | None = None, write_page: PageWriter | None = None) -> int:
    """Entry point; returns the exit code. `write_page`: writer of --page, where its packages are installed."""
    args = parser().parse_args(sys.argv[2:] if argv is None else argv)
    check_result_target(args.json)
    flight = read_flight(args.file)
    if flight.notice is not None:
        _print(flight.notice)
    found = explain(flight)
    result = as_result(args.file, flight, found)
    if args.page is not None:
        if write_page is None:
            raise RecordingError("--page needs the command edge-replay with the extra export or sim installed")
        write_page(args.page, args.file, flight, found)
    write_result(args.json, result)
    if args.json != "-":
        sys.stdout.write("".join(c if c.isprintable() or c == "\n" else "?" for c in table(result)))
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
