"""Why the episodes of a run failed: an explanation of each kept flight log, counts by cause, and a contact sheet."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edge.flightlog.explain.explanation import Explanation, deciding, explain
from edge.flightlog.explain.flight import read_flight
from edge.flightlog.explain.overlay import Picture
from edge.flightlog.explain.pictures import card, contact_sheet, drawn_pictures, wanted_stamps
from edge.flightlog.reader import RecordingError
from reporting.page import Table
from sim_hil.benchmark.results.causes import RULE_ERRORS, general_reason
from sim_hil.benchmark.results.record import EpisodeResult
from sim_hil.benchmark.results.store import FLIGHTS


@dataclass(frozen=True)
class Failure:
    """Decisive explanation of an episode that did not reach its goal or collided, with its picture and its card."""

    result: EpisodeResult
    decisive: Explanation
    card: dict[str, Any]
    picture: Picture | None


def failures(directory: Path, results: Sequence[EpisodeResult]) -> list[Failure]:
    """Return the failures whose flight log was kept, those that missed the goal first; a damaged log is left out."""
    found = []
    for result in sorted(results, key=lambda each: (each.success, each.id)):
        path = directory / FLIGHTS / f"{result.id}.mcap"
        if (result.success and not result.collided) or not path.is_file():
            continue
        try:
            failure = _failure(path, result)
        except (RecordingError, OSError, *RULE_ERRORS):  # one log does not lose the report of the others
            continue
        if failure is not None:
            found.append(failure)
    return found


def _failure(path: Path, result: EpisodeResult) -> Failure | None:
    flight = read_flight(path)
    decisive = deciding(flight, explain(flight))
    if decisive is None:
        return None
    pictures = drawn_pictures(path, flight, wanted_stamps([decisive]))
    title = f"{result.id} ({'collided' if result.success else result.end}): {decisive.event.kind}"
    shown = {**card(flight, decisive, pictures, decisive=False), "title": title}
    at_ns = decisive.event_frame_ns
    return Failure(result, decisive, shown, None if at_ns is None else pictures.get(at_ns))


def cause_table(found: Sequence[Failure]) -> Table:
    """Return the table of causes: what went wrong first, in how many episodes that missed the goal or only collided."""
    keys = Counter((each.decisive.verdict.cause, general_reason(each.decisive)) for each in found)
    rows = []
    for (cause, because), count in keys.most_common():
        members = [
            each for each in found if (each.decisive.verdict.cause, general_reason(each.decisive)) == (cause, because)
        ]
        missed = sum(not each.result.success for each in members)
        example = members[0].result.id
        rows.append((cause, because, str(missed), str(count - missed), f"{100 * count / len(found):.0f}", example))
    head = ("cause", "what went wrong first", "goal missed", "only collided", "% of failures", "example")
    return Table(head, rows, numeric=frozenset({2, 3, 4}))


def failure_sheet(found: Sequence[Failure]) -> bytes | None:
    """Return the contact sheet, JPEG: the picture at the decisive moment of each failure; None without a failure."""
    nothing = np.full((216, 384, 3), 60, np.uint8)
    tiles = [
        (nothing if each.picture is None else each.picture, each.result.id,
         f"{each.decisive.event.kind}: {each.decisive.verdict.cause}")
        for each in found
    ]  # fmt: skip
    return contact_sheet(tiles)
