"""The demo's report: true to the recordings, self-contained, and inert whatever the model wrote."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.flightlog.recorder import Recorder
from firmware_bridge.system.output_file import partial_of
from reporting import page
from tests.support.html_page import HtmlPage, assert_loads_nothing
from tests.support.runner import synthetic_run
from tools.report import checks, demo_report, run_data
from tools.report.demo_report import RunFiles, load_run, spread, write_report
from tools.report.run_data import ReportError


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("demo")
    synthetic_run.write_run(out)
    return out


@pytest.fixture(scope="module")
def summary(run_dir: Path) -> dict[str, Any]:
    return write_report(RunFiles(run_dir, run_dir / "artifacts"), wall_s=80.0)


@pytest.fixture(scope="module")
def html(run_dir: Path, summary: dict[str, Any]) -> str:
    return (run_dir / "report.html").read_text(encoding="utf-8")


def _load(out: Path) -> run_data.RunData:
    return load_run(RunFiles(out, out / "artifacts"))


def _checks_of(out: Path, *, asked_s: float | None = None, **parts: Any) -> dict[str, checks.Check]:
    """The checks of a synthetic run; `asked_s`: another duration in settings.json than it has."""
    synthetic_run.write_run(out, **parts)
    if asked_s is not None:
        (out / "settings.json").write_text(json.dumps({"duration_s": asked_s}))
    return {check.name: check for check in checks.acceptance(_load(out))}


def _failed(found: dict[str, checks.Check]) -> set[str]:
    return {name for name, check in found.items() if not check.passed}


# ---- the page


@pytest.mark.slow
def test_the_page_loads_nothing_from_anywhere(html: str) -> None:
    assert_loads_nothing(html)


def test_the_models_text_cannot_act_on_the_page(html: str) -> None:
    assert "<script>alert" not in html
    assert "\u202e" not in html
    shown = "".join(HtmlPage(html).pieces)
    assert 'turn </pre><script>alert("x")</script> ⟨U+202E⟩left⟨U+0007⟩ & <b>go</b> \U0001f916' in shown


def test_every_picture_decodes(html: str) -> None:
    pictures = [attributes["src"] for tag, attributes in HtmlPage(html).tags if tag == "img"]
    assert len(pictures) == 4 + len(synthetic_run.generations(12.0))
    for uri in pictures:
        assert uri is not None
        data = np.frombuffer(run_data.jpeg_bytes({"data": uri.split(",", 1)[1]}), np.uint8)
        assert cv2.imdecode(data, cv2.IMREAD_COLOR) is not None


def test_contact_sheet_shows_the_frame_at_the_anchor(run_dir: Path, html: str) -> None:
    second = synthetic_run.generations(12.0)[1]
    expected = synthetic_run.jpeg((second["anchor_ns"] - synthetic_run.START_NS) / 1e9)
    assert page.image_uri(expected, "jpeg") in html
    assert "generation 1 · seen at 2.9 s · Δt 2.90 s at release" in html


def test_untrained_weights_are_marked(html: str) -> None:
    assert "The weights are untrained" in html


def _row_of(html: str, title: str) -> list[str]:
    """The cells of the first table row that holds this text."""
    row = next(row for row in html.split("<tr>") if title in row)
    return ["".join(HtmlPage(cell).pieces) for cell in row.split("</tr>")[0].split("</td>")[:-1]]


def test_commands_written_are_those_the_bridge_counted(html: str, summary: dict[str, Any]) -> None:
    written = synthetic_run.bridge_result(12.0)["commands"]
    assert _row_of(html, "velocity commands written by the bridge")[1] == str(written) == "121"
    assert _row_of(html, "motion requests received by the robot")[1] == str(written)
    assert summary["bridge"]["commands"] == written


def test_delay_at_the_call_is_shown_beside_the_check_and_not_judged(html: str, summary: dict[str, Any]) -> None:
    rows = html.split("<h2>Checks</h2>")[1].split("<tr>")
    check = next(index for index, row in enumerate(rows) if "Δt against the capture stamp" in row)
    title = "Δt given to the action expert against the instant of its call, worst tick"
    cells = ["–", title, "1.37 ms", "no check", "measured", "edge-run, its own clock"]
    assert _row_of("<tr>" + rows[check + 1], title) == cells
    assert summary["delay_error_ms"] == {"max": synthetic_run.CALL_ERROR_MS}
    assert summary["checks"]["delay_error_ms"]["value"] < 0.001


def test_the_machine_is_the_one_the_run_was_measured_on(html: str) -> None:
    assert _row_of(html.split("<h2>Machine</h2>")[1], "processor") == ["processor", "Synthetic 9000"]


@pytest.mark.slow
@given(st.integers(0, 60), st.integers(2, 12))
def test_spread_takes_the_first_the_last_and_no_more_than_asked(items: int, count: int) -> None:
    chosen = spread([{"n": n} for n in range(items)], count)
    numbers = [item["n"] for item in chosen]
    assert len(numbers) == min(items, count) and numbers == sorted(set(numbers))
    assert not items or (numbers[0], numbers[-1]) == (0, items - 1)


# ---- the checks


def test_a_good_run_passes_every_check(tmp_path: Path) -> None:
    found = _checks_of(tmp_path)
    assert _failed(found) <= {"generations"}  # 12 s at 2.9 s a generation cannot hold ten a minute's share
    assert found["control_ticks"].limit == 118
    assert found["moved_under_command_m"].limit == pytest.approx(0.2)


def test_demo_json_holds_the_checks_and_the_wire(summary: dict[str, Any], run_dir: Path) -> None:
    assert json.loads((run_dir / "demo.json").read_text()) == summary
    assert summary["wire"]["last_command_zero"] is True
    assert summary["wall_s"] == 80.0
    assert set(summary) >= {"control", "reasoning", "delay_s", "bridge", "wire", "checks", "wall_s"}
    assert all({"value", "limit", "pass"} <= set(check) for check in summary["checks"].values())


def test_delay_is_checked_against_the_frame_not_the_recorded_anchor(tmp_path: Path) -> None:
    ticks = synthetic_run.tick_records(12.0)
    for tick in ticks:  # a runner that is consistently wrong: anchor and Δt agree with each other, not with the frame
        if tick["generation"] is not None:
            tick["anchor_ns"] += 3_000_000
            tick["delay_s"] -= 0.003
    found = _checks_of(tmp_path, ticks=ticks)
    assert found["delay_error_ms"].value == pytest.approx(3.0)
    assert not found["delay_error_ms"].passed


def _without_anchor_frame(ticks: list[dict[str, Any]], semantics: list[dict[str, Any]]) -> None:
    semantics[1]["frames_ns"] = [semantics[1]["anchor_ns"] + 1]


def _outside_its_tick(ticks: list[dict[str, Any]], semantics: list[dict[str, Any]]) -> None:
    ticks[-1]["now_ns"] += 60_000_000  # and a Δt that agrees with it
    ticks[-1]["delay_s"] += 0.06


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "note"), [(_without_anchor_frame, "is not in the log"), (_outside_its_tick, "outside the tick")]
)
def test_a_tick_that_cannot_be_checked_fails_the_delay_check(tmp_path: Path, spoil: Any, note: str) -> None:
    ticks, semantics = synthetic_run.tick_records(12.0), synthetic_run.generations(12.0)
    spoil(ticks, semantics)
    found = _checks_of(tmp_path, ticks=ticks, semantics=semantics)["delay_error_ms"]
    assert not found.passed and note in found.note


@pytest.mark.slow
@pytest.mark.parametrize(
    "spoil",
    [
        lambda tick, semantics: tick.update(generation=semantics[0]["generation"]),  # an older one
        lambda tick, semantics: tick.update(generation=semantics[-1]["generation"]),  # not released yet
        lambda tick, semantics: tick.update(generation=None),  # none although there is one
    ],
)
def test_only_the_newest_released_generation_counts(
    tmp_path: Path, spoil: Callable[[dict[str, Any], list[dict[str, Any]]], None]
) -> None:
    ticks, semantics = synthetic_run.tick_records(12.0), synthetic_run.generations(12.0)
    tick = next(t for t in ticks if t["generation"] == 1)
    spoil(tick, semantics)
    assert _checks_of(tmp_path, ticks=ticks)["stale_generation_ticks"].value == 1


@pytest.mark.slow
def test_a_tick_uses_the_older_generation_until_the_newer_is_published(tmp_path: Path) -> None:
    ticks, semantics = synthetic_run.tick_records(12.0), synthetic_run.generations(12.0)
    tick = next(t for t in ticks if t["generation"] == 1)
    tick.update(generation=semantics[0]["generation"])
    semantics[1]["published_ns"] = tick["now_ns"]  # later than ready, as under load
    assert _checks_of(tmp_path, ticks=ticks, semantics=semantics)["stale_generation_ticks"].value == 0


@pytest.mark.slow
def test_a_fault_of_the_runner_fails_and_is_shown(tmp_path: Path) -> None:
    synthetic_run.write_run(tmp_path)
    result = {**synthetic_run.run_result(12.0), "faults": ["the bridge stopped the robot: deadman"]}
    (tmp_path / "run.json").write_text(json.dumps(result))
    write_report(RunFiles(tmp_path, tmp_path / "artifacts"), wall_s=1.0)
    assert "the bridge stopped the robot: deadman" in (tmp_path / "report.html").read_text(encoding="utf-8")
    assert json.loads((tmp_path / "demo.json").read_text())["checks"]["faults"]["pass"] is False


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "check"),
    [
        (lambda ticks: ticks[0].update(command=[0.1, 0.0, 0.0]), "motion_before_first_generation"),
        (lambda ticks: ticks.__delitem__(slice(-3, None)), "ticks_missing_in_log"),
        (lambda ticks: [tick.update(duration_ms=140.0) for tick in ticks[:3]], "tick_p99_ms"),
        (lambda ticks: [tick.update(late_ms=140.0) for tick in ticks[:3]], "tick_p99_ms"),
    ],
    ids=["motion before the first generation", "ticks not in the log", "slow ticks", "late ticks"],
)
def test_bad_ticks_fail_their_check(tmp_path: Path, spoil: Callable[[list[dict[str, Any]]], None], check: str) -> None:
    ticks = synthetic_run.tick_records(12.0)
    spoil(ticks)
    assert check in _failed(_checks_of(tmp_path, ticks=ticks))


@pytest.mark.slow
def test_a_runner_that_ended_early_is_judged_by_the_requested_time(tmp_path: Path) -> None:
    found = _checks_of(tmp_path, asked_s=60.0)
    assert found["control_ticks"].limit == 590 and not found["control_ticks"].passed


@pytest.mark.slow
@pytest.mark.parametrize(("beside_m", "reached"), [(1.4, True), (1.6, False)])
@pytest.mark.parametrize("share", [0.5, 1.0], ids=["passed on the way", "at the end"])
def test_trained_weights_must_reach_the_goal(tmp_path: Path, share: float, beside_m: float, reached: bool) -> None:
    lines = synthetic_run.trace_lines(12.0)
    poses = [line for line in lines if line["kind"] == "pose"]
    where = poses[round(share * (len(poses) - 1))]
    lines[0] = {**lines[0], "goal": [where["x"], where["y"] + (1 if where["y"] > 0 else -1) * beside_m]}
    found = _checks_of(tmp_path, asked_s=60.0, trace=lines, trained=True)
    assert found["goal_nearest_m"].passed is reached and found["goal_nearest_m"].limit == 1.5


@pytest.mark.parametrize(("trained", "duration_s"), [(False, 60.0), (True, 59.0)])
def test_the_goal_is_not_required_of_untrained_weights_or_short_runs(
    tmp_path: Path, trained: bool, duration_s: float
) -> None:
    assert "goal_nearest_m" not in _checks_of(tmp_path, asked_s=duration_s, trained=trained)


@pytest.mark.slow
def test_a_path_without_commands_does_not_count_as_walking(tmp_path: Path) -> None:
    trace = [line for line in synthetic_run.trace_lines(12.0) if line.get("name") != "Move"]
    found = _checks_of(tmp_path, trace=trace)
    assert found["moved_under_command_m"].value == 0.0 and not found["moved_under_command_m"].passed


@pytest.mark.slow
def test_path_under_command_is_the_ground_truth(tmp_path: Path) -> None:
    value = _checks_of(tmp_path)["moved_under_command_m"].value
    assert value == pytest.approx(synthetic_run.SPEED_MPS * 9.0, rel=0.15)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("last", "zero"),
    [
        (("Move", {"x": 0.0, "y": 0.0, "z": 0.0}), True),
        (("StopMove", ""), True),
        (("Move", {"x": 0.0, "y": 0.0, "z": 0.2}), False),
    ],
)
def test_last_command_is_read_from_the_wire(tmp_path: Path, last: tuple[str, Any], zero: bool) -> None:
    trace = synthetic_run.trace_lines(12.0)
    trace.insert(-1, synthetic_run.wire(trace[-1]["t_ns"] - 1, *last))
    trace.insert(-1, {**synthetic_run.wire(trace[-1]["t_ns"] - 1, "GetImageSample", ""), "service": "videohub"})
    assert _checks_of(tmp_path, trace=trace)["last_command_zero"].value is zero


# ---- reading


def test_odometry_is_laid_on_the_world_at_the_first_tick(run_dir: Path) -> None:
    data = _load(run_dir)
    stamps_ns, odometry = run_data.odometry_in_world(data)
    truth = run_data.truth_at(data.trace, stamps_ns)
    assert odometry[0] == pytest.approx(truth[0])
    drift_m = odometry[-1, 0] - truth[-1, 0]
    assert drift_m == pytest.approx(0.002 * 119, abs=0.01)  # what the synthetic odometry adds per tick


def test_velocity_is_turned_into_the_body_frame(tmp_path: Path) -> None:
    pose = {"kind": "pose", "x": 0, "y": 0, "z": 0.3, "theta": math.pi / 2, "vx": 0.0, "vy": 0.7, "wz": 0.1, "mode": 3}
    lines = [synthetic_run.SCENE, {"t_ns": 1, **pose}, {"t_ns": 2, **pose}]
    path = tmp_path / "trace.jsonl"
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert run_data.load_trace(path).velocity[0] == pytest.approx([0.7, 0.0, 0.1])


def test_a_trace_cut_in_its_last_line_is_read(run_dir: Path, tmp_path: Path) -> None:
    text = (run_dir / "hil_trace.jsonl").read_text()
    (tmp_path / "cut.jsonl").write_text(text[:-40])
    trace = run_data.load_trace(tmp_path / "cut.jsonl")
    assert trace.end == {} and len(trace.pose) > 100


def test_a_damaged_trace_line_is_named(tmp_path: Path) -> None:
    (tmp_path / "bad.jsonl").write_text('{"kind": "scene"}\nnonsense\n{"kind": "pose"}\n')
    with pytest.raises(ReportError, match=r"bad\.jsonl:2: expected one JSON object"):
        run_data.load_trace(tmp_path / "bad.jsonl")


@pytest.mark.parametrize(
    "name",
    [
        "settings.json",
        "flight.mcap",
        "hil_trace.jsonl",
        "run.json",
        "hil.json",
        "bridge.json",
        "artifacts/manifest.json",
    ],
)
def test_a_missing_file_is_named_in_one_line(tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    synthetic_run.write_run(tmp_path, 1.0)
    (tmp_path / name).unlink()
    assert demo_report.main([str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert Path(name).name in error and error.count("\n") == 1


@pytest.mark.slow
def test_the_command_prints_the_reports_path_and_fails_with_a_failed_check(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    synthetic_run.write_run(tmp_path, 2.0)
    assert demo_report.main([str(tmp_path)]) == 1
    assert capsys.readouterr().out.splitlines()[-1] == str(tmp_path / "report.html")
    assert "FAIL" in (tmp_path / "report.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_command_takes_the_artifacts_that_the_run_used(tmp_path: Path) -> None:
    out, elsewhere = tmp_path / "demo", tmp_path / "elsewhere"
    synthetic_run.write_run(out, 6.0)
    (out / "artifacts").rename(elsewhere)
    settings = json.loads((out / "settings.json").read_text())
    (out / "settings.json").write_text(json.dumps({**settings, "artifacts": str(elsewhere)}))
    assert demo_report.main([str(out)]) in (0, 1)
    assert (out / "report.html").exists()


def _set(name: str, **fields: Any) -> Callable[[Path], None]:
    def spoil(out: Path) -> None:
        (out / name).write_text(json.dumps({**json.loads((out / name).read_text()), **fields}))

    return spoil


def _append_bytes(name: str, data: bytes) -> Callable[[Path], None]:
    return lambda out: (out / name).write_bytes((out / name).read_bytes() + data) and None


def _frames_that_are_no_pictures(data: Any) -> Callable[[Path], None]:
    def spoil(out: Path) -> None:
        (out / "flight.mcap").unlink()  # a recorder overwrites no file
        recorder = Recorder(out / "flight.mcap")
        for semantic in synthetic_run.generations(6.0):
            recorder.put("/camera", semantic["anchor_ns"], {"data": data})
            recorder.put("/semantic", semantic["ready_ns"], semantic)
        for tick in synthetic_run.tick_records(6.0):
            recorder.put("/tick", tick["now_ns"], tick)
        assert recorder.close()

    return spoil


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_append_bytes("hil_trace.jsonl", b"\xff\xfe\n"), "hil_trace.jsonl cannot be read as UTF-8"),
        (_append_bytes("hil_trace.jsonl", b'{"kind": "pose", "t_ns": 1}\n'), "hil_trace.jsonl: a record lacks"),
        (lambda out: (out / "demo.json").write_text("{}"), "demo.json: expected a time in seconds under 'wall_s'"),
        (_set("settings.json", duration_s=None), "settings.json: expected a time in seconds under 'duration_s'"),
        (_set("settings.json", artifacts=3), "settings.json: expected the artifact directory's path"),
        (_set("run.json", control={}), "a record of the run lacks or misshapes a field: KeyError('ticks')"),
        (_set("run.json", delay_error_ms=[]), "a record of the run lacks or misshapes a field: TypeError"),
        (_frames_that_are_no_pictures("~"), "not a foxglove.CompressedImage"),
        (_frames_that_are_no_pictures("a" * 5), "not a foxglove.CompressedImage"),
        (lambda out: partial_of(out / "report.html").mkdir(), "report.html and demo.json cannot be written"),
    ],
)
def test_a_damaged_file_is_one_line_and_leaves_the_old_report(
    tmp_path: Path, spoil: Callable[[Path], None], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    synthetic_run.write_run(tmp_path, 6.0)
    (tmp_path / "report.html").write_text("the old one")
    spoil(tmp_path)
    assert demo_report.main([str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1
    assert (tmp_path / "report.html").read_text() == "the old one"


@pytest.mark.slow
def test_an_empty_picture_does_not_end_the_report(tmp_path: Path) -> None:
    synthetic_run.write_run(tmp_path, 6.0)
    _frames_that_are_no_pictures("")(tmp_path)
    assert demo_report.main([str(tmp_path)]) in (0, 1)
