"""A stop until a new arming ends a run at once: it is found at the last tick, named, and decides what follows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from edge.core.cli import EXIT_DONE
from edge.core.geometry import SE2
from edge.flightlog.explain import command
from edge.flightlog.explain.events import COLLISION, DETOUR, FALL, STOP, TIMEOUT, find_events
from edge.flightlog.explain.explanation import deciding, explain
from edge.flightlog.explain.flight import FaultSpan, Flight, Truth, read_flight
from edge.flightlog.explain.verdict import LIMITED
from edge.flightlog.part import LogPart, PartFile
from tests.edge.flightlog.test_log_schemas import SAMPLES
from tests.support.runner import explained_flights as flights
from tests.support.runner.explained_flights import SPEED_MPS, at

STOP_S, TIMEOUT_S = 10.0, 40.0
LAST_TICK_S, LAST_TRUTH_S = 9.9, 39.9
FAULT = FaultSpan("camera-swapped", "the picture is upside down", at(9.95), 2**63, stops=True)
"""Raised after the last tick, as an urgent fault is."""
TIMED_OUT = {"end": "timeout", "ne_m": 9.0, "faults": []}


def standing_truth(second: float) -> Truth:
    way_m = SPEED_MPS * min(second, STOP_S)
    return flights.truth(second, T_world_base=SE2(way_m, 0.0, 0.0), route_m=30 - way_m)


def episode(**changes: object) -> Flight:
    """An episode whose robot drives for 10 s, is stopped by a fault, and stands until the timeout at 40 s."""
    truths = [standing_truth(number / 10) for number in range(round(TIMEOUT_S * 10))]
    whole = flights.flight(STOP_S, faults=[FAULT], result=TIMED_OUT)
    return replace(replace(whole, truths=truths), **changes)  # type: ignore[arg-type]


def test_the_stop_explains_the_timeout_that_follows_it() -> None:
    flight = episode()
    stop, timeout = found = explain(flight)
    assert (stop.event.kind, stop.at_s, stop.verdict.cause) == (STOP, pytest.approx(LAST_TICK_S), LIMITED)
    assert stop.verdict.because.endswith("camera-swapped") and "upside down" in stop.verdict.evidence[0]
    assert (timeout.event.kind, timeout.at_s) == (TIMEOUT, pytest.approx(LAST_TRUTH_S))
    assert timeout.refers and "camera-swapped" in timeout.verdict.because
    assert deciding(flight, found) is stop


def test_a_detour_ends_at_the_last_tick_and_the_stop_that_follows_decides() -> None:
    def away(second: float) -> Truth:
        off_m = SPEED_MPS * min(max(second - 4.0, 0.0), STOP_S - 4.0)
        return flights.truth(second, route_m=30.0 - SPEED_MPS * min(second, 4.0) + off_m)

    truths = [away(number / 10) for number in range(round(TIMEOUT_S * 10))]
    flight = episode(truths=truths, faults=[])
    found = explain(flight)
    assert [each.event.kind for each in found] == [DETOUR, STOP, TIMEOUT]
    assert found[0].event.end_ns == at(LAST_TICK_S)
    assert deciding(flight, found) is found[1] and "names no fault" in found[1].verdict.because


def test_a_robots_run_that_a_stop_phrase_ended_names_it() -> None:
    flight = flights.flight(truths=None, result={"faults": ["The user said stop. Arm again.", "bridge lost"]})
    (stop,) = explain(flight)
    assert (stop.event.kind, stop.verdict.cause) == (STOP, LIMITED)
    assert stop.verdict.because == "The user said stop. Arm again." and stop.verdict.evidence == ("bridge lost",)
    assert dict(stop.steps)["The robot did"].startswith("in 3.0 s"), "the steps show the time before the stop"


@pytest.mark.parametrize(
    "flight",
    [
        flights.flight(truths=None, result={"faults": []}),
        flights.flight(truths=None, faults=[FaultSpan("too-hot", "96 °C", at(9.0), 2**63)]),
        episode(faults=[], result={}),
    ],
    ids=["ended as asked", "only limited", "a simulator that goes on after the run"],
)
def test_a_run_that_no_fault_ended_has_no_such_stop(flight: Flight) -> None:
    assert find_events(flight) == []


def test_the_log_says_which_fault_stops_the_robot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "flight.mcap"
    part = LogPart(PartFile(path, new=False), 1)
    part.add("/run", at(0.0), SAMPLES["/run"])
    part.add("/tick", at(0.0), SAMPLES["/tick"])
    for name, action in (("camera-frozen", "ZERO"), ("camera-swapped", "STOP")):
        part.add("/fault", at(0.1), {**SAMPLES["/fault"], "name": name, "action": action})
    part.finish()
    part.file.close()
    fault = read_flight(path).stop_fault
    assert fault is not None and fault.name == "camera-swapped"
    assert command.main([str(path)]) == EXIT_DONE
    assert "cause: command limited: stopped until a new arming: camera-swapped" in capsys.readouterr().out


def test_a_fall_is_decisive_and_not_the_contact_before_it() -> None:
    def touched(second: float) -> Truth:
        return flights.truth(second, touching=("plant",) if 10.0 <= second < 10.3 else ())

    flight = flights.flight(truths=touched, result={"end": "fell"})
    found = explain(flight)
    assert [each.event.kind for each in found] == [COLLISION, FALL]
    assert deciding(flight, found) is found[1]
