"""Flight logs with values that no run records: `edge-replay explain` and `video` print one line and leave no file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge.core.cli import EXIT_BAD_INPUT, EXIT_CHECK_FAILED, EXIT_DONE, EXIT_INTERRUPTED
from edge.flightlog.explain import command, video
from edge.flightlog.explain import flight as flight_module
from edge.flightlog.explain.overlay import Overlay
from edge.flightlog.part import LogPart, PartFile
from edge.flightlog.replay import records as records_module
from tests.edge.flightlog.test_log_schemas import SAMPLES
from tests.support.runner import explained_flights as flights
from tests.support.runner import synthetic_run
from tests.support.runner.explained_flights import at

HUGE = 10**400
"""A number that Python's JSON reads and that no 64-bit stamp and no float can be."""
Messages = list[tuple[str, int, Any]]


def messages(records: dict[str, Any]) -> Messages:
    """The messages of a log of 1 s without pictures; `records` replace those of their topics, or are fields of them."""
    found: Messages = []

    def add(topic: str, second: float, default: dict[str, Any]) -> None:
        given = records.get(topic, {})
        found.append((topic, at(second), {**default, **given} if isinstance(given, dict) else given))

    add("/run", 0.0, {**SAMPLES["/run"], "mount": flights.MOUNT})
    add("/semantic", 0.0, {**SAMPLES["/semantic"], "generation": 0, "frames_ns": [at(0.0)], "ready_ns": at(0.0)})
    for number in range(10):
        add("/tick", number / 10, {**SAMPLES["/tick"], "tick": number, "now_ns": at(number / 10), "generation": 0})
        add("/truth", number / 10, {"pose": [0.0, 0.0, 0.0], "people": [], "touching": []})
    add("/result", 1.0, {"end": "timeout", "ne_m": 7.0})
    return found


def explained(log: Path) -> int:
    return command.main([str(log)])


def filmed(log: Path) -> int:
    return video.main([str(log), "--out", str(log.with_name("film.mp4"))])


@pytest.mark.parametrize("main", [explained, filmed])
@pytest.mark.parametrize(
    ("records", "topic"),
    [
        ({"/result": ["timeout"]}, "/result"),
        ({"/result": {"ne_m": [7.0]}}, "/result"),
        ({"/result": {"ne_m": HUGE}}, "/result"),
        ({"/tick": {"now_ns": HUGE}}, "/tick"),
        ({"/tick": {"now_ns": -1e300}}, "/tick"),
        ({"/semantic": {"frames_ns": [HUGE]}}, "/semantic"),
        ({"/semantic": {"ready_ns": 1e300}}, "/semantic"),
        ({"/truth": {"pose": [HUGE, 0.0, 0.0]}}, "/truth"),
        ({"/truth": {"route_m": "far"}}, "/truth"),
        ({"/run": {"mount": {**flights.MOUNT, "aspect": 0}}}, "/run"),
        ({"/run": {"mount": {**flights.MOUNT, "aspect": -1.8}}}, "/run"),
        ({"/run": {"mount": {**flights.MOUNT, "aspect": 1e-9}}}, "/run"),
        ({"/run": {"mount": ["a camera"]}}, "/run"),
    ],
    ids=lambda value: str(value).replace(str(HUGE), "HUGE"),
)
def test_a_malformed_record_is_one_line_that_names_it(
    main: Callable[[Path], int],
    records: dict[str, Any],
    topic: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Whatever of it the reader of the file already refuses."""
    for module in (flight_module, records_module):
        monkeypatch.setattr(module, "read_messages", lambda *_: iter(messages(records)))
    assert main(tmp_path / "flight.mcap") == EXIT_BAD_INPUT
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and len(error) < 300 and f"a {topic} record" in error
    assert list(tmp_path.iterdir()) == []


def write(path: Path, pictures: list[tuple[float, bytes]]) -> Path:
    """Write a log of 1 s with these pictures, s and JPEG."""
    part = LogPart(PartFile(path, new=False), 1)
    for message in [*messages({}), *(("/camera", at(second), jpeg) for second, jpeg in pictures)]:
        part.add(*message)
    part.finish()
    part.file.close()
    return path


def bomb(width_px: int, height_px: int) -> bytes:
    """A JPEG whose header demands another size than its picture has."""
    jpeg = bytearray(synthetic_run.jpeg(0.0))
    frame = jpeg.index(b"\xff\xc0")
    jpeg[frame + 5 : frame + 9] = height_px.to_bytes(2, "big") + width_px.to_bytes(2, "big")
    return bytes(jpeg)


@pytest.mark.parametrize("size", [(60_000, 60_000), (5_000, 20), (4_096, 1), (1, 4_096)])
def test_a_picture_of_a_size_that_no_camera_has_is_left_out(size: tuple[int, int]) -> None:
    assert Overlay(None).draw(bomb(*size), None, None) is None


def test_a_picture_that_must_not_be_decoded_is_not_decoded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("edge.flightlog.explain.overlay.cv2.imdecode", lambda *_: pytest.fail("decoded"))
    assert Overlay(None).draw(bomb(60_000, 60_000), None, None) is None


def test_a_video_counts_the_pictures_that_are_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pictures = [(0.0, synthetic_run.jpeg(0.0)), (0.1, bomb(60_000, 60_000)), (0.2, synthetic_run.jpeg(0.2))]
    assert filmed(write(tmp_path / "flight.mcap", pictures)) == EXIT_DONE
    assert "film.mp4: 2 pictures, without 1 that cannot be decoded" in capsys.readouterr().err


def test_a_video_of_pictures_that_all_cannot_be_decoded_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert filmed(write(tmp_path / "flight.mcap", [(0.0, bomb(60_000, 60_000))])) == EXIT_BAD_INPUT
    assert "none of the 1 pictures between --from and --to can be decoded" in capsys.readouterr().err


@pytest.mark.parametrize("apart_ns", [0, 1])
def test_pictures_at_one_instant_are_no_video(
    apart_ns: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pictures = [(0.0, synthetic_run.jpeg(0.0)), (apart_ns / 1e9, synthetic_run.jpeg(0.1))]
    log = write(tmp_path / "flight.mcap", pictures)
    assert filmed(log) == EXIT_BAD_INPUT
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "2 pictures within" in error
    assert list(tmp_path.iterdir()) == [log]


@pytest.mark.parametrize(("raised", "code"), [(KeyboardInterrupt, EXIT_INTERRUPTED), (OSError, EXIT_CHECK_FAILED)])
def test_a_video_that_does_not_end_leaves_no_file(
    raised: type[BaseException], code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = write(tmp_path / "flight.mcap", [(k / 10, synthetic_run.jpeg(k / 10)) for k in range(5)])
    draw = Overlay.draw
    drawn: list[int] = []

    def ends(self: Overlay, *args: Any) -> np.ndarray | None:
        drawn.append(1)
        if len(drawn) == 4:
            raise raised("the disk has gone")
        return draw(self, *args)

    monkeypatch.setattr(Overlay, "draw", ends)
    assert filmed(log) == code
    assert list(tmp_path.iterdir()) == [log]


def test_a_video_that_a_full_disk_has_cut_is_no_video(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """OpenCV reports no error there: what it has written is read back."""
    log = write(tmp_path / "flight.mcap", [(k / 10, synthetic_run.jpeg(k / 10)) for k in range(5)])

    def cut(draft: Path, drawn: object, rate_hz: float) -> int:
        draft.write_bytes(b"cut")
        return 5

    monkeypatch.setattr(video, "_write_draft", cut)
    assert filmed(log) == EXIT_CHECK_FAILED
    assert "0 of 5 pictures could be written; is the disk full?" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == [log]


@pytest.mark.parametrize("out", ["", "folder"])
def test_a_video_over_a_folder_is_refused_in_one_line(
    out: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "folder").mkdir()
    log = write(tmp_path / "flight.mcap", [(0.0, synthetic_run.jpeg(0.0))])
    assert video.main([str(log), "--out", out and str(tmp_path / out)]) == EXIT_BAD_INPUT
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "--out" in error and "expected a file" in error
