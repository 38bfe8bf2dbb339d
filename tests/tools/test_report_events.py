"""The events in the demo's report: the first ones, and always the one that ended the run, with its reason."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from edge.flightlog.recorder import Recorder
from tests.support.runner import synthetic_run
from tools.report.demo_report import RunFiles, load_run
from tools.report.explain_page import SHOWN_EVENTS, explained_run

DURATION_S = 60.0
WHY = "the bridge stopped the robot: deadman"


def events_of(out: Path, stops: int, faults: list[str]) -> tuple[list[dict[str, Any]], int]:
    """The report's events of a run of 60 s that stands for 3 s of every 6 s, `stops` times, and then drives on."""
    synthetic_run.write_run(out, DURATION_S)
    (out / "flight.mcap").unlink()
    recorder = Recorder(out / "flight.mcap")
    recorder.put("/run", synthetic_run.START_NS, {"instruction": "walk", "mode": "async", "manifest_sha256": "0" * 64})
    for record in synthetic_run.generations(DURATION_S):
        fields = {"frames_ns": [record["anchor_ns"]], "before": "none."}
        recorder.put("/semantic", record["ready_ns"], {**record, **fields})
    way_m = 0.0
    for record in synthetic_run.tick_records(DURATION_S):
        second = record["tick"] / 10
        way_m += 0.0 if second % 6 >= 3 and second < 6 * stops else 0.05
        recorder.put("/tick", record["now_ns"], {**record, "pose": [way_m, 0.0, 0.0]})
    result = {**synthetic_run.run_result(DURATION_S), "faults": faults}
    recorder.put("/result", synthetic_run.START_NS + round(DURATION_S * 1e9), result)
    assert recorder.close()
    found = explained_run(load_run(RunFiles(out, out / "artifacts")))
    assert found is not None
    return found


@pytest.mark.parametrize("stops", [pytest.param(2, marks=pytest.mark.slow), 9])
def test_the_reports_events_name_why_the_run_ended(tmp_path: Path, stops: int) -> None:
    events, count = events_of(tmp_path, stops, [WHY])
    assert count == stops + 1 and len(events) == min(count, SHOWN_EVENTS)
    assert (events[-1]["event"], events[-1]["because"]) == ("stop", WHY)
    times_s = [event["at_s"] for event in events]
    assert times_s == sorted(times_s) and times_s[0] < 6


@pytest.mark.slow
def test_the_reports_last_event_is_the_runs_last_one(tmp_path: Path) -> None:
    events, count = events_of(tmp_path, 9, [])
    assert (count, len(events)) == (9, SHOWN_EVENTS)
    assert events[-1]["at_s"] > 50
