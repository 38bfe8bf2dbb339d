"""The pictures of an explanation: the text's with its own waypoints, the event's with what the robot drove by."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from edge.flightlog.explain.explanation import explain
from edge.flightlog.explain.flight import Truth
from edge.flightlog.explain.overlay import Overlay
from edge.flightlog.explain.pictures import CARD_PX, card, drawn_pictures, wanted_stamps
from edge.flightlog.standard_messages import Mount
from tests.support.runner import explained_flights as flights
from tests.support.runner import synthetic_run
from tests.support.runner.explained_flights import TEXT, at

MOUNT = Mount.of_record(flights.MOUNT)
LEFT = "Motion: nobody near.\nPlan: turn left in 1 m.\nwaypoints: (2.0, 1.2) (3.0, 2.0) (4.0, 3.0)"
ANCHOR_S = 1.0
"""Anchor of generation 1, whose text turns left; the robot drives by generation 0 then, which goes straight on."""


def columns(picture: np.ndarray | None) -> np.ndarray:
    """The columns in which something is drawn into the picture of ANCHOR_S."""
    plain = Overlay(MOUNT, CARD_PX).draw(synthetic_run.jpeg(ANCHOR_S), None, None)
    assert plain is not None and picture is not None
    return np.flatnonzero((np.abs(plain.astype(int) - picture).max(axis=2) > 10).any(axis=0))


def test_the_texts_picture_shows_its_own_waypoints_and_no_plan(tmp_path: Path) -> None:
    flights.write(tmp_path / "flight.mcap", 2.0)
    flight = flights.flight(texts=lambda number: LEFT if number == 1 else TEXT, mount=MOUNT)
    drawn = drawn_pictures(tmp_path / "flight.mcap", flight, {at(ANCHOR_S), (at(ANCHOR_S), 1)})
    text, event = columns(drawn[at(ANCHOR_S), 1]), columns(drawn[at(ANCHOR_S)])
    assert len(text) and text.max() < CARD_PX / 2, "left of the middle, where a plan straight on would be"
    assert event.min() < CARD_PX / 2 < event.max()


@pytest.mark.slow
def test_an_explanation_asks_for_the_picture_of_its_own_text(tmp_path: Path) -> None:
    def touched(second: float) -> Truth:
        return flights.truth(second, touching=("plant",) if 10.0 <= second < 10.3 else ())

    flights.write(tmp_path / "flight.mcap")
    stamps = [at(number / 10) for number in range(120)]
    flight = flights.flight(12.0, truths=touched, mount=MOUNT, frames_ns=stamps)
    found = explain(flight)
    assert wanted_stamps(found) == {(at(9.0), 5), at(10.0)}
    pictures = drawn_pictures(tmp_path / "flight.mcap", flight, wanted_stamps(found))
    shown = card(flight, found[0], pictures, decisive=True)["pictures"]
    assert [picture["caption"] for picture in shown] == ["the text's picture, 9.0 s", "the event, 10.0 s"]
