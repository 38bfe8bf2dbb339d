"""`edge-replay explain` and `edge-replay video` on a log: text, JSON, page and video, and one line for bad input."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from edge import commands
from edge.core.cli import EXIT_BAD_INPUT, EXIT_DONE
from edge.core.geometry import SE2
from edge.flightlog.explain import command, video
from edge.flightlog.explain.flight import FaultSpan
from edge.flightlog.explain.overlay import PLAN_COLOUR, WAYPOINT_COLOUR, Overlay, label, waypoints_seen
from edge.flightlog.replay.records import RecordedFrame
from edge.flightlog.standard_messages import Mount
from tests.support.html_page import assert_loads_nothing
from tests.support.runner import explained_flights as flights
from tests.support.runner import synthetic_run
from tests.support.runner.explained_flights import at
from tools.report import explain_page


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("explain") / "flight.mcap"
    flights.write(path, touch_s=3.0)
    return path


def near(picture: np.ndarray, colour: tuple[int, int, int], tolerance: int = 60) -> int:
    """Pixels of about a colour."""
    return int((np.abs(picture.astype(int) - colour).max(axis=2) < tolerance).sum())


def test_a_log_is_explained_as_json(log: Path, tmp_path: Path) -> None:
    out = tmp_path / "why.json"
    assert command.main([str(log), "--json", str(out)]) == EXIT_DONE
    result = json.loads(out.read_text())
    assert [event["event"] for event in result["events"]] == ["collision", "stop", "timeout"]
    assert result["decisive"] == 1 and "camera-frozen" in result["events"][1]["because"]


def test_a_log_is_explained_as_text(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main([str(log)]) == EXIT_DONE
    text = capsys.readouterr().out
    assert "stop at 4.9 s" in text and "<- decisive" in text and "The camera saw" in text


def test_the_page_has_the_pictures_and_loads_nothing(log: Path, tmp_path: Path) -> None:
    page = tmp_path / "why.html"
    assert explain_page.main([str(log), "--page", str(page), "--json", str(tmp_path / "why.json")]) == EXIT_DONE
    html = page.read_text()
    assert html.count("data:image/jpeg") == 4 and "decisive" in html
    assert_loads_nothing(html)


def test_text_json_and_page_list_a_new_instruction(log: Path, tmp_path: Path) -> None:
    flight = flights.flight(generations={5: replace(flights.generation(5), instruction="come <back>")})
    result = command.as_result(log, flight, [])
    assert result["new_instructions"] == [{"at_s": 10.0, "instruction": "come <back>"}]
    assert "\ninstruction from 10.0 s: come <back>\n" in command.table(result)
    explain_page.write_page(tmp_path / "why.html", log, flight, [])
    assert "Instruction from 10.0 s: <b>come &lt;back&gt;</b>" in (tmp_path / "why.html").read_text()


def test_a_video_has_every_picture_with_the_plan_drawn_in_it(log: Path, tmp_path: Path) -> None:
    out = tmp_path / "flight.mp4"
    assert video.main([str(log), "--from", "1", "--to", "2", "--out", str(out)]) == EXIT_DONE
    film = cv2.VideoCapture(str(out))
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) == 11
    assert film.get(cv2.CAP_PROP_FPS) == pytest.approx(10)
    assert near(film.read()[1], PLAN_COLOUR) > 200
    assert [path.name for path in tmp_path.iterdir()] == ["flight.mp4"]


@pytest.mark.parametrize("main", [command.main, lambda argv: video.main([*argv, "--out", "x.mp4"])])
def test_what_is_no_log_is_one_line(main: object, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "no.mcap").write_text("no log")
    assert main([str(tmp_path / "no.mcap")]) == EXIT_BAD_INPUT  # type: ignore[operator]
    assert capsys.readouterr().err.count("\n") == 1


def test_a_video_of_a_span_without_pictures_is_refused(log: Path, tmp_path: Path) -> None:
    assert video.main([str(log), "--from", "100", "--out", str(tmp_path / "x.mp4")]) == EXIT_BAD_INPUT
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "module"),
    [
        (["flight.mcap", "--artifacts", "x"], "edge.flightlog.replay.command"),
        (["explain", "flight.mcap"], "edge.flightlog.explain.command"),
        (["explain", "flight.mcap", "--page=why.html"], "tools.report.explain_page"),
        (["video", "flight.mcap"], "edge.flightlog.explain.video"),
    ],
)
def test_only_a_page_needs_more_than_the_robot_has(arguments: list[str], module: str) -> None:
    assert commands.replay_module(arguments)[0] == module


def test_the_plan_and_the_waypoints_are_drawn_where_the_floor_is() -> None:
    overlay = Overlay(Mount.of_record(flights.MOUNT))
    plain = overlay.draw(synthetic_run.jpeg(0.0), None, None)
    drawn = overlay.draw(synthetic_run.jpeg(0.0), flights.tick(2.0), flights.generation(1))
    assert plain is not None and drawn is not None
    changed = np.abs(plain.astype(int) - drawn).max(axis=2) > 10
    assert changed[plain.shape[0] // 2 + 20 :].any() and not changed[: plain.shape[0] // 3].any()
    assert near(drawn, WAYPOINT_COLOUR) > near(plain, WAYPOINT_COLOUR)


def test_waypoints_move_towards_a_robot_that_drives() -> None:
    tick = flights.tick(2.0, offset=SE2(1.0, 0.0, 0.0))
    assert waypoints_seen(tick, flights.generation(1))[0] == pytest.approx((0.5, 0.0))


def test_the_edge_of_a_label_stays_around_its_text() -> None:
    picture = np.full((40, 640, 3), 120, np.uint8)
    label(picture, "command +0.50 +0.00 m/s +0.00 rad/s", (20, 25), (255, 255, 255))
    text, edge = (np.flatnonzero(found.any(axis=(0, 2))) for found in (picture > 170, picture < 90))
    assert abs(text.min() - edge.min()) <= 2 and abs(text.max() - edge.max()) <= 2


def test_the_panel_names_units_and_each_fault_once(monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[str] = []
    monkeypatch.setattr(video, "label", lambda _panel, text, *_: written.append(text))
    spans = [FaultSpan(name, "", at(0.0), 2**63) for name in ("camera-frozen", "too-hot", "too-hot")]
    flight = flights.flight(ticks=lambda s: flights.tick(s, reason="camera-frozen"), faults=spans)
    assert video.draw_page(Overlay(None), flight, RecordedFrame(at(5.0), synthetic_run.jpeg(5.0))) is not None
    assert "camera-frozen, too-hot" in written
    assert "measured +0.50 m/s +0.00 rad/s" in written


def test_a_picture_that_does_not_decode_is_left_out() -> None:
    assert Overlay(None).draw(b"\xff\xd8no", None, None) is None
