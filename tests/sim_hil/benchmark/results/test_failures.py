"""A benchmark's report says why its episodes failed, from their flight logs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edge.core.geometry import SE2
from edge.flightlog.explain.events import COLLISION, Event
from edge.flightlog.explain.explanation import Explanation
from edge.flightlog.explain.flight import read_flight
from edge.flightlog.explain.verdict import Verdict
from edge.flightlog.standard_messages import jpeg_size
from sim_hil.benchmark.env.metrics import Outcome
from sim_hil.benchmark.results import causes as causes_of
from sim_hil.benchmark.results.causes import cause_counts, cause_tables, keep_cause, read_causes
from sim_hil.benchmark.results.failures import cause_table, failure_sheet, failures
from sim_hil.benchmark.results.flight import EpisodeFlight
from sim_hil.scene.scene import load_scene
from tests.edge.flightlog.test_log_schemas import SAMPLES
from tests.support.benchmark import dynanav_fakes as fakes
from tests.support.runner import explained_flights as flights


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run with the flight logs of two missed episodes and one that only collided."""
    folder = tmp_path_factory.mktemp("run")
    (folder / "flights").mkdir()
    for name in ("a", "b"):
        flights.write(folder / "flights" / f"{name}.mcap")
    flights.write(folder / "flights" / "c.mcap", 4.5, touch_s=3.0, end="reached")
    return folder


RESULTS = [
    fakes.missed("a"),
    fakes.missed("b"),
    fakes.result("c", collided=True, collisions=("plant",)),
    fakes.result("d"),
    fakes.missed("no-log"),
]


def test_failures_are_counted_by_cause(run: Path) -> None:
    found = failures(run, RESULTS)
    rows = cause_table(found).rows
    assert [tuple(row)[2:5] for row in rows] == [("2", "0", "67"), ("0", "1", "33")]
    assert rows[0][1] == "the plan drives, the command does not: camera-frozen"


@pytest.mark.parametrize(
    ("touched", "because", "general"),
    [
        ("plant 3", "the plan led into plant 3", "the plan led into an object"),
        ("person", "the person came after the picture", "the person came after the picture"),
    ],
)
def test_a_general_reason_names_no_object_and_keeps_the_person(touched: str, because: str, general: str) -> None:
    event, verdict = Event(COLLISION, 0, 0, touched), Verdict("action expert", because, ())
    assert causes_of.general_reason(Explanation(event, verdict, False, 0.0, (), "", None, None, None)) == general


@pytest.mark.slow
def test_the_contact_sheet_shows_each_failure(run: Path) -> None:
    sheet = failure_sheet(failures(run, RESULTS))
    assert sheet is not None and jpeg_size(sheet) == (1600, 352)


def test_a_damaged_log_leaves_its_episode_out(run: Path, tmp_path: Path) -> None:
    (tmp_path / "flights").mkdir()
    (tmp_path / "flights" / "a.mcap").write_bytes((run / "flights" / "a.mcap").read_bytes()[:100])
    assert failures(tmp_path, [fakes.missed("a")]) == [] and failure_sheet([]) is None


MISSED = Outcome("a", False, "timeout", 12.0, 0.0, False, (), None, False, 1.0, 12.0, 60.0, "0" * 64)
REACHED = replace(MISSED, success=True, end="reached")


def flight_of(folder: Path) -> EpisodeFlight:
    """One tick of an episode in the corridor, with a person in view, one behind a wall, and one far away."""
    episode = replace(fakes.episode("a"), scene="corridor", goal_xy=(13.0, 0.6))
    flight = EpisodeFlight(folder / "flights" / "a.mcap", load_scene("corridor"), episode)
    flight.put("/run", flights.START_NS, SAMPLES["/run"])
    flight.put("/tick", flights.START_NS, {**SAMPLES["/tick"], "now_ns": flights.START_NS})
    people = np.array([[3.0, 0.0, 0.0], [3.0, 5.0, 0.0], [90.0, 0.0, 0.0]])
    flight.see(flights.START_NS, SE2(1.0, 0.0, 0.0), people, ())
    return flight


def test_an_episodes_log_has_the_truth_with_the_path_to_the_goal(tmp_path: Path) -> None:
    flight_of(tmp_path).keep(MISSED)
    (truth,) = read_flight(tmp_path / "flights" / "a.mcap").truths
    assert truth.people == ((3.0, 0.0), (3.0, 5.0)), "those within 10 m"
    assert truth.seen == (True, False), "the second stands behind the corridor's wall"
    assert truth.route_m == pytest.approx(12.0, abs=0.5) and abs(truth.route_bearing_rad or 9.0) < 0.3
    assert [path.name for path in (tmp_path / "flights").iterdir()] == ["a.mcap"]


@pytest.mark.parametrize(
    ("choice", "outcome", "kept"),
    [
        ("all", REACHED, ["flights/a.mcap"]),
        ("failed", REACHED, []),
        ("failed", replace(REACHED, collided=True), ["flights/a.mcap"]),
        ("failed", MISSED, ["flights/a.mcap"]),
        ("causes", MISSED, ["causes/a.json"]),
        ("none", MISSED, []),
    ],
)
def test_what_is_kept_of_an_episode_is_what_was_asked_for(
    tmp_path: Path, choice: str, outcome: Outcome, kept: list[str]
) -> None:
    flight_of(tmp_path).settle(choice, outcome, tmp_path)
    assert [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()] == kept


def test_of_a_failure_its_cause_alone_can_be_kept(run: Path, tmp_path: Path) -> None:
    (tmp_path / "flights").mkdir()
    for name in ("a", "c"):
        log = tmp_path / "flights" / f"{name}.mcap"
        log.write_bytes((run / "flights" / f"{name}.mcap").read_bytes())
        keep_cause(log, tmp_path)
    found = read_causes(tmp_path, RESULTS)
    assert {name: cause for name, (cause, _) in found.items()} == {"a": "command limited", "c": "action expert"}
    assert not list((tmp_path / "flights").iterdir())
    counted = cause_counts(RESULTS, found)
    assert counted["all"] == {"missed": {"command limited": 1}, "collided": {"action expert": 1}}
    assert counted["by_scene"] == {"corridor": counted["all"]}


def test_a_log_that_cannot_be_read_is_an_unexplained_failure(run: Path, tmp_path: Path) -> None:
    log = tmp_path / "a.mcap"
    log.write_bytes((run / "flights" / "a.mcap").read_bytes()[:100])
    keep_cause(log, tmp_path)
    assert read_causes(tmp_path, RESULTS) == {"a": ("unexplained", "")}


@pytest.mark.parametrize("error", [KeyError("frames"), ZeroDivisionError(), TypeError(), ValueError()], ids=repr)
def test_a_log_on_which_the_rules_fail_is_an_unexplained_failure_and_kept(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def fail(_: object) -> None:
        raise error

    monkeypatch.setattr(causes_of, "explain", fail)
    (tmp_path / "flights").mkdir()
    log = tmp_path / "flights" / "a.mcap"
    log.write_bytes((run / "flights" / "a.mcap").read_bytes())
    keep_cause(log, tmp_path)
    because = f"the rules failed on its log ({type(error).__name__})"
    assert read_causes(tmp_path, RESULTS) == {"a": ("unexplained", because)}
    assert sorted(path.name for path in (tmp_path / "causes").iterdir()) == ["a.json", "a.mcap"]
    assert failures(tmp_path, RESULTS) == [], "the report does not read it"


def test_causes_are_counted_in_the_groups_of_the_rates() -> None:
    causes = {"a": ("reasoning text", "it turns too late"), "b": ("odometry", "it drifts"), "c": ("person", "it came")}
    by_group, reasons = cause_tables(RESULTS, causes)
    assert by_group.head == ("group", "goal missed", "reasoning text", "odometry", "person", "only collided")
    assert tuple(by_group.rows[0]) == ("all", "2", "1", "1", "0", "1")
    assert {tuple(row) for row in reasons.rows} >= {
        ("person", "it came", "0", "1"),
        ("odometry", "it drifts", "1", "0"),
    }
