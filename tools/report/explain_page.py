"""`edge-replay explain --page`: the explanations of a flight log as one self-contained page with pictures."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from edge.core.cli import write_named
from edge.flightlog.explain import command
from edge.flightlog.explain.explanation import Explanation, deciding
from edge.flightlog.explain.flight import Flight
from edge.flightlog.explain.pictures import card, drawn_pictures, wanted_stamps
from reporting.page import render


def cards(path: Path, flight: Flight, found: Sequence[Explanation]) -> list[dict[str, Any]]:
    """Return the cards of all explanations. Raises RecordingError, OSError."""
    pictures, decisive = drawn_pictures(path, flight, wanted_stamps(found)), deciding(flight, found)
    return [{**card(flight, each, pictures, decisive=each is decisive), "title": ""} for each in found]


def write_page(page: Path, log: Path, flight: Flight, found: Sequence[Explanation]) -> None:
    """Write the page. Raises RecordingError, OSError, OutputError."""
    causes = Counter(each.verdict.cause for each in found)
    tiles = [(f"{flight.seconds(flight.end_ns):.0f} s", "flight"), (str(len(found)), "events")]
    tiles += [(str(count), f"cause: {cause}") for cause, count in causes.most_common()]
    html = render(
        "explain",
        title=f"Why: {log.name}",
        instruction=flight.instruction,
        source=str(log),
        truth=bool(flight.truths),
        tiles=tiles,
        items=cards(log, flight, found),
    )
    write_named(page, html)


main = partial(command.main, write_page=write_page)

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
