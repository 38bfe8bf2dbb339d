"""`edge-calib odometry`: what it finds in a log, what it writes, and when it says no."""

from __future__ import annotations

import json
import math
import os
from dataclasses import asdict
from pathlib import Path

import cv2
import pytest

from calib import odometry as calib
from calib.cli import main
from calib.odometry import calibration_text
from edge.flightlog.recorder import Recorder
from edge.odometry.calibration import CalibrationError, OdometryCalibration, load_calibration
from tests.support.runner.floor_pictures import GEOMETRY, floor_texture, picture
from tests.support.runner.odometry_drives import Drive, drive


def write_log(path: Path, drives: Drive) -> Path:
    recorder = Recorder(path)
    for report in drives.reports:
        record = {
            "raw_pose": report.T_odom_base,
            "velocity": (report.vx_mps, report.vy_mps, report.wz_radps),
            "gyro_wz_radps": report.gyro_wz_radps,
            "roll_rad": 0.0,
            "pitch_rad": 0.0,
            "foot_forces": report.foot_forces,
            "command": report.commanded,
        }
        recorder.put("/odometry", report.received_ns, record)
    assert recorder.close(30.0)
    return path


def write_truth(path: Path, drives: Drive) -> Path:
    poses = [
        {"t_ns": report.received_ns, "kind": "pose", "x": true.x_m, "y": true.y_m, "theta": true.theta_rad}
        for true, report in zip(drives.true, drives.reports, strict=True)
    ]
    path.write_text("\n".join(json.dumps(line) for line in [{"t_ns": 1, "kind": "scene"}, *poses[::5]]) + "\n")
    return path


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A log and the truth: the odometry reports 4 % too much and turns 2° a metre, the gyro shows 0.3 °/s at rest."""
    folder = tmp_path_factory.mktemp("known")
    path = drive(
        26, scale=1.04, yaw_drift_rad_per_m=math.radians(2), gyro_bias_radps=math.radians(0.3), wz_radps=0.15
    )  # fmt: skip
    return write_log(folder / "drive.mcap", path), write_truth(folder / "truth.jsonl", path)


def test_a_known_scale_and_bias_are_found(known: tuple[Path, Path], tmp_path: Path) -> None:
    log, truth = known
    out = tmp_path / "robot.odometry.toml"
    assert main(["odometry", str(log), "--truth", str(truth), "--out", str(out)]) == 0
    found = load_calibration(out)
    assert found.scale_x == pytest.approx(1.04, abs=3 * found.scale_x_sigma)
    assert found.scale_x_sigma < 0.01
    assert math.degrees(found.gyro_bias_radps) == pytest.approx(0.3, abs=0.05)


def test_parameters_that_the_drive_does_not_excite_stay_uncertain(known: tuple[Path, Path], tmp_path: Path) -> None:
    log, truth = known
    out = tmp_path / "robot.odometry.toml"
    main(["odometry", str(log), "--truth", str(truth), "--out", str(out)])
    # It never walked sideways by itself.
    assert load_calibration(out).scale_y_sigma > 0.03


@pytest.mark.slow
def test_the_camera_is_reference_enough() -> None:
    path = drive(13.2, scale=1.05, wz_radps=0.05)
    texture = floor_texture()
    pictures = []
    for index in range(0, len(path.true), 8):
        _, jpeg = cv2.imencode(".jpg", picture(texture, path.true[index]))
        pictures.append((path.stamp_ns(index), jpeg.tobytes()))
    log = calib.Drive(path.reports, tuple(pictures))
    found = calib.fit(log, calib.visual_references(log, GEOMETRY), OdometryCalibration())
    assert found.good
    assert found.calibration.scale_x == pytest.approx(1.05, abs=0.015)


def test_the_result_is_json_for_other_tools(
    known: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:  # fmt: skip
    log, truth = known
    assert main(["odometry", str(log), "--truth", str(truth), "--json", "-"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["good"] is True
    assert result["unexplained"] < result["unexplained_before"]
    assert result["distance_m"] == pytest.approx(12.0, abs=1.0)


def test_a_drive_too_short_to_tell_is_not_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = drive(7)
    log, truth = write_log(tmp_path / "d.mcap", path), write_truth(tmp_path / "t.jsonl", path)
    out = tmp_path / "o.toml"
    assert main(["odometry", str(log), "--truth", str(truth), "--out", str(out)]) == 1
    assert not out.exists()
    assert "not good enough" in capsys.readouterr().err


def test_odometry_unrelated_to_the_truth_is_not_fitted(tmp_path: Path, capsys) -> None:  # type: ignore[no-untyped-def]
    log = write_log(tmp_path / "d.mcap", drive(26, wz_radps=0.1))
    truth = write_truth(tmp_path / "t.jsonl", drive(26, wz_radps=-0.5, vx_mps=0.2))
    assert main(["odometry", str(log), "--truth", str(truth)]) == 1
    assert "do not describe the same drive" in capsys.readouterr().err


def test_an_interrupted_calibration_reports_the_interrupt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(_path: Path) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(calib, "read_drive", interrupt)
    assert main(["odometry", str(tmp_path / "d.mcap"), "--truth", "t.jsonl"]) == 130
    assert capsys.readouterr().err == "edge-calib odometry: interrupted\n"


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda folder: folder / "missing.mcap", "no such file"),
        (lambda folder: _text(folder / "a.mcap", "not a log"), "not an MCAP file"),
        (lambda folder: write_log(folder / "b.mcap", drive(1)), "expected at least 100"),
    ],
)
def test_a_log_that_cannot_be_used_is_one_clear_line(make, message: str, tmp_path: Path, capsys) -> None:  # type: ignore[no-untyped-def]
    assert main(["odometry", str(make(tmp_path)), "--truth", str(tmp_path / "t.jsonl")]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


def test_without_camera_and_truth_there_is_nothing_to_compare_with(tmp_path: Path, capsys) -> None:  # type: ignore[no-untyped-def]
    log = write_log(tmp_path / "d.mcap", drive(5))
    assert main(["odometry", str(log)]) == 2
    assert "--robot" in capsys.readouterr().err


def test_a_trace_of_another_time_is_named(tmp_path: Path, capsys) -> None:  # type: ignore[no-untyped-def]
    log = write_log(tmp_path / "d.mcap", drive(5))
    trace = tmp_path / "t.jsonl"
    trace.write_text('{"t_ns": 900000000000000, "kind": "pose", "x": 0, "y": 0, "theta": 0}\n{"t_ns": 9')
    assert main(["odometry", str(log), "--truth", str(trace)]) == 2
    assert "same monotonic clock" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"\xff\xfe", "t.jsonl:1: expected a line of edge-hil's trace"),
        (b"[" * 100_000, "t.jsonl:1: expected a line of edge-hil's trace (nested too deeply)"),
        (b'{"kind": "pose", "t_ns": 1e400, "x": 0, "y": 0, "theta": 0}', "t.jsonl:1: expected a line"),
        (b'{"kind": "pose", "t_ns": 1, "x": 1%b, "y": 0, "theta": 0}' % (b"0" * 400), "an integer of 1329 bits"),
        (b'{"kind": "pose", "t_ns": 1, "x": 1e400, "y": 0, "theta": 0}', "pose (inf, 0.0, 0.0) is not finite"),
        (None, "is not a regular file"),
    ],
    ids=["not UTF-8", "deep", "endless stamp", "integer of 401 digits", "endless pose", "FIFO"],
)
def test_a_truth_that_cannot_be_read_is_one_clear_line(
    content: bytes | None, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, trace = write_log(tmp_path / "d.mcap", drive(5)), tmp_path / "t.jsonl"
    if content is None:
        os.mkfifo(trace)
    else:
        trace.write_bytes(content + b"\n")
    assert main(["odometry", str(log), "--truth", str(trace)]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


def test_a_calibration_reads_back_as_written(tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    written = OdometryCalibration(scale_x=1.031, gyro_bias_radps=-0.004)
    path.write_text(calibration_text(written, "a test"))
    found = load_calibration(path)
    assert (found.scale_x, found.gyro_bias_radps) == (1.031, -0.004)
    assert asdict(found) == pytest.approx(asdict(written), rel=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text + "colour = 1.0\n", "unknown key colour"),
        (lambda text: text.replace("scale_x = ", "# "), "missing key scale_x"),
        (lambda text: text.replace("scale_x = 1", "scale_x = 9"), "scale_x: expected 0.5..2"),
        (lambda text: text.replace("scale_x = 1", "scale_x = true #"), "scale_x: expected a number"),
        (lambda text: text.replace("scale_x = 1", "scale_x = nan #"), "scale_x: expected a finite number"),
        (lambda text: text + "[", "cannot be read"),
    ],
)
def test_a_calibration_that_cannot_be_used_is_refused(change, message: str, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "c.toml"
    path.write_text(change(calibration_text(OdometryCalibration(), "a test")))
    with pytest.raises(CalibrationError, match=message):
        load_calibration(path)


def _text(path: Path, text: str) -> Path:
    path.write_text(text)
    return path
