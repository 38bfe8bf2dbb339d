"""Causes of failures without their logs: one small file per failed episode, counted by group.

`--flight-logs causes` keeps these files alone, so that a suite whose episodes nobody should read needs no pictures.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from edge.core.cli import write_whole
from edge.flightlog.explain.explanation import Explanation, deciding, explain
from edge.flightlog.explain.flight import read_flight
from edge.flightlog.reader import RecordingError
from firmware_bridge.system.input_file import read_json
from reporting.page import Table
from sim_hil.benchmark.results.record import EpisodeResult
from sim_hil.benchmark.results.store import CAUSES
from sim_hil.benchmark.results.summary import group_names, grouped_by

UNEXPLAINED: Final = "unexplained"
RULE_ERRORS: Final = (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, AssertionError)
"""Errors of a rule on values that it does not expect. They must not lose the episode: only failed ones come here."""


def general_reason(decisive: Explanation) -> str:
    """Return the verdict's sentence without the name of the object, so that equal failures count together."""
    event, because = decisive.event, decisive.verdict.because
    return because.replace(f"into {event.detail}", "into an object") if event.kind == "collision" else because


def keep_cause(flight: Path, folder: Path) -> None:
    """Explain a flight log, write its cause into the run's `folder`, and delete the log. Raises OSError.

    A log on which the rules fail is unexplained and kept beside its cause.
    """
    content, failed = {"cause": UNEXPLAINED, "because": ""}, False
    try:
        found = read_flight(flight)
        decisive = deciding(found, explain(found))
        if decisive is not None:
            content = {"cause": decisive.verdict.cause, "because": general_reason(decisive)}
    except RecordingError:
        pass  # a damaged log, which no later version explains either
    except RULE_ERRORS as error:
        content["because"], failed = f"the rules failed on its log ({type(error).__name__})", True
    path = folder / CAUSES / f"{flight.stem}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, json.dumps(content) + "\n")
    if failed:
        flight.replace(path.with_suffix(flight.suffix))
    else:
        flight.unlink()


def read_causes(directory: Path, results: Sequence[EpisodeResult]) -> dict[str, tuple[str, str]]:
    """Return cause and reason of the failed episodes of a run by id; an episode without a file is left out."""
    found = {}
    for result in results:
        try:
            content = read_json(directory / CAUSES / f"{result.id}.json")
            found[result.id] = (str(content["cause"]), str(content["because"]))
        except (OSError, ValueError, KeyError, TypeError):
            continue
    return found


def cause_counts(results: Sequence[EpisodeResult], causes: Mapping[str, tuple[str, str]]) -> dict[str, Any]:
    """Return the numbers of episodes by outcome ("missed", "collided") and cause: `all`, then `by_scene` and so on."""
    return {"all": _counts(results, causes)} | {
        f"by_{name}": {key: _counts(members, causes) for key, members in grouped_by(results, name)}
        for name in group_names(results)
    }


def _counts(results: Sequence[EpisodeResult], causes: Mapping[str, tuple[str, str]]) -> dict[str, dict[str, int]]:
    failed = [result for result in results if result.id in causes]
    return {
        name: dict(Counter(causes[each.id][0] for each in failed if each.success == success).most_common())
        for name, success in (("missed", False), ("collided", True))
    }


def cause_tables(
    results: Sequence[EpisodeResult], causes: Mapping[str, tuple[str, str]]
) -> tuple[Table, Table]:  # fmt: skip
    """Return the counts of missed goals by group and cause, and the counts by reason."""
    counted = cause_counts(results, causes)
    names = list(dict.fromkeys([*counted["all"]["missed"], *counted["all"]["collided"]]))
    groups = [("all", counted["all"])]
    groups += [
        (f"{kind.removeprefix('by_')}: {key}", counts)
        for kind, members in counted.items()
        if kind != "all"
        for key, counts in members.items()
    ]
    rows = [
        (group, str(sum(counts["missed"].values())), *(str(counts["missed"].get(name, 0)) for name in names),
         str(sum(counts["collided"].values())))
        for group, counts in groups
    ]  # fmt: skip
    by_group = Table(
        ("group", "goal missed", *names, "only collided"), rows, numeric=frozenset(range(1, len(names) + 3))
    )
    success = {result.id: result.success for result in results}
    keys = Counter((*reason, success[name]) for name, reason in causes.items())
    reasons = Counter(causes.values())
    lines = [
        (cause, because, str(keys[cause, because, False]), str(keys[cause, because, True]))
        for (cause, because), _ in reasons.most_common()
    ]
    head = ("cause", "what went wrong first", "goal missed", "only collided")
    return by_group, Table(head, lines, numeric=frozenset({2, 3}))
