"""`edge-replay explain --page`: the explanations of a flight log as one self-contained page with pictures."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from edge.core.cli import write_named
from edge.core.geometry import SE2
from edge.flightlog.explain import command
from edge.flightlog.explain.explanation import Explanation, deciding, explain
from edge.flightlog.explain.flight import Flight, Truth, read_flight
from edge.flightlog.explain.pictures import card, drawn_pictures, wanted_stamps
from edge.flightlog.reader import RecordingError
from reporting.page import render
from tools.report.run_data import RunData, Trace

SHOWN_EVENTS = 6
"""Largest number of events in the report of a run; `edge-replay explain` shows all."""
_TRUTH_PERIOD_NS = 100_000_000


def cards(path: Path, flight: Flight, found: Sequence[Explanation]) -> list[dict[str, Any]]:
    """Return the cards of all explanations. Raises RecordingError, OSError."""
    pictures, decisive = drawn_pictures(path, flight, wanted_stamps(found)), deciding(flight, found)
    return [{**card(flight, each, pictures, decisive=each is decisive), "title": ""} for each in found]


def explained_run(data: RunData) -> tuple[list[dict[str, Any]], int] | None:
    """Return the cards of a simulated run's events and their number; None for a log that cannot be explained.

    The simulator's trace is the truth; it has no times of contacts and no path to the goal. The last event is always
    shown: it is the one that ended the run, if any did.
    """
    try:
        flight = replace(read_flight(data.log.path), truths=truths(data.trace))
        found = explain(flight)
        shown = found if len(found) <= SHOWN_EVENTS else [*found[: SHOWN_EVENTS - 1], found[-1]]
        return cards(data.log.path, flight, shown), len(found)
    except (RecordingError, OSError):
        return None


def truths(trace: Trace) -> list[Truth]:
    """Return the trace's poses and people ten times a second."""
    found: list[Truth] = []
    for at_ns, pose in zip(trace.pose_ns.tolist(), trace.pose.tolist(), strict=True):
        if found and at_ns - found[-1].stamp_ns < _TRUTH_PERIOD_NS:
            continue
        index = int(np.searchsorted(trace.people_ns, at_ns, side="right")) - 1
        people = trace.people[index] if index >= 0 else ()
        found.append(Truth(at_ns, SE2(*pose), tuple((float(row[0]), float(row[1])) for row in people)))
    return found


def write_page(page: Path, log: Path, flight: Flight, found: Sequence[Explanation]) -> None:
    """Write the page. Raises RecordingError, OSError, OutputError."""
    causes = Counter(each.verdict.cause for each in found)
    tiles = [(f"{flight.seconds(flight.end_ns):.0f} s", "flight"), (str(len(found)), "events")]
    tiles += [(str(count), f"cause: {cause}") for cause, count in causes.most_common()]
    html = render(
        "explain",
        title=f"Why: {log.name}",
        instruction=flight.instruction,
        new_instructions=[(flight.seconds(at_ns), text) for at_ns, text in flight.new_instructions],
        source=str(log),
        damage=flight.notice,
        truth=bool(flight.truths),
        tiles=tiles,
        items=cards(log, flight, found),
    )
    write_named(page, html)


main = partial(command.main, write_page=write_page)

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
