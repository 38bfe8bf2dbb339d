"""One short soak with the real processes, and the files that it makes."""

from __future__ import annotations

import itertools
import json
import os
import shutil
import signal
import statistics
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest

from edge.run.say import say
from sim_hil.realtime.host_stall import read_stalls
from sim_hil.realtime.stack import STALLS
from sim_hil.realtime.truth import read_lines
from sim_hil.scene.scene import Vec3
from sim_hil.soak import cli, leg
from sim_hil.soak.analysis import ANALYSIS, TRACE, faults_of, read_life, read_trace
from sim_hil.soak.arguments import parse_seconds
from sim_hil.soak.leg import EVENTS, SAMPLES, Leg
from sim_hil.soak.run import SoakFolder
from sim_hil.soak.tasks import Journey, SoakTask
from sim_hil.soak.verdict import measures
from tests.support.processes import need_room_to_record, wait_for

pytestmark = pytest.mark.process

FULL_DISK = SimpleNamespace(f_frsize=1 << 30, f_bavail=60, f_blocks=1000)  # 60 of 1000 GiB are free
DURATION_S = 20
# A busy machine is slow. These only bound the waiting times.
LONGER_S = 60  # well within the limit of a test
ANSWER_S = 30.0
END_S = 300.0
CHECK_NS = 2_000_000_000
FAULTS = """
format = 1
gap_s = [2.0, 3.0]
[[faults]]
name = "camera stops"
inject = "camera-stop"
for_s = [1.2, 1.5]
weight = 1.0
fault = "camera-stopped"
expect = "zero"
"""


@dataclass(frozen=True)
class Soaked:
    """A finished soak: its command, folder and exit code."""

    arguments: list[str]
    folder: Path
    code: int

    @property
    def leg(self) -> Path:
        return self.folder / "legs" / "001"

    @property
    def result(self) -> dict[str, Any]:
        return dict(json.loads((self.folder / "result.json").read_text(encoding="utf-8")))

    def events(self, kind: str) -> list[dict[str, Any]]:
        return [event for event in read_lines(self.leg / EVENTS) if event["kind"] == kind]


def hurried(draw: Callable[[Journey, Vec3], SoakTask | None]) -> Callable[[Journey, Vec3], SoakTask | None]:
    """Tasks with a timeout of four seconds, so that a short soak has several."""

    def hurry(journey: Journey, at: Vec3) -> SoakTask | None:
        task = draw(journey, at)
        return None if task is None else replace(task, timeout_s=4.0)

    return hurry


def followed(events: list[dict[str, Any]]) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Pairs of consecutive tasks of one runner."""
    begun = [event for event in events if event["kind"] == "task_begin"]
    return [(a, b) for a, b in itertools.pairwise(begun) if a["run"] == b["run"]]


def driven(samples: Path) -> list[dict[str, Any]]:
    """Samples taken while a runner drove."""
    return [sample for sample in read_lines(samples) if sample["armed"]]


def is_enough(leg: Path) -> bool:
    """Whether a running leg has recorded the events that the tests check."""
    events = list(read_lines(leg / EVENTS))
    runs = [event["run"] for event in events if event["kind"] == "armed"]
    read = (read_life(leg / f"flight-{run}.mcap", leg / f"edge-run-{run}.json", run) for run in runs)
    lives = [life for life in read if life is not None]
    trace = read_trace(leg / TRACE)
    return (
        bool(followed(events))
        and any(event["kind"] == "fault_effect" for event in events)
        and any(fault["raised_ns"] is not None for fault in faults_of(events, lives, trace))
        and any(delay_s is not None for life in lives for delay_s in life.delay_s)
        and sum(life.ticks for life in lives) > 100
        and len(trace.command_gap_ms) > 500
        and "edge-run" in (driven(leg / SAMPLES) or [{"processes": ()}])[-1]["processes"]
    )


def patient(left_s: Callable[[Leg, int], float]) -> Callable[[Leg, int], float]:
    """Remaining time of a leg that is extended, by at most LONGER_S, until enough is recorded."""
    checked_ns, enough = 0, False

    def left(leg: Leg, now_ns: int) -> float:
        nonlocal checked_ns, enough
        seconds = left_s(leg, now_ns)
        if not -LONGER_S < seconds <= 0:
            return seconds
        if not enough and now_ns - checked_ns >= CHECK_NS:
            checked_ns, enough = now_ns, is_enough(leg.options.stack.folder)
        return seconds if enough else 1.0

    return left


@pytest.fixture(scope="module")
def soaked(nano_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Soaked:
    folder = tmp_path_factory.mktemp("soak")
    need_room_to_record(folder)
    faults = folder / "faults.toml"
    faults.write_text(FAULTS, encoding="utf-8")
    arguments = ["--artifacts", str(nano_dir), "--duration", f"{DURATION_S}s", "--leg", "10m", "--scene", "office"]
    arguments += ["--people", "2", "--faults", str(faults), "--out", str(folder / "out"), "--json", "-"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Journey, "next", hurried(Journey.next))
        patch.setattr(Leg, "left_s", patient(Leg.left_s))
        patch.setattr(leg, "STUCK_LIVES", 12)  # a runner that is late too often stops where it stands
        patch.setattr(leg, "say", partial(say, timeout_s=ANSWER_S))
        code = cli.main(arguments)
    return Soaked(arguments, folder / "out", code)


@pytest.mark.slow
def test_it_ends_by_itself_and_leaves_no_process_and_no_flight_log(soaked: Soaked) -> None:
    assert soaked.code in (0, 1) and soaked.result["finished"]
    lines = [" ".join(process.info["cmdline"] or []) for process in psutil.process_iter(["cmdline"])]
    assert not [line for line in lines if str(soaked.folder) in line]
    assert list(soaked.leg.glob("*.mcap")) == []


@pytest.mark.slow
def test_one_runner_gets_one_instruction_after_the_other(soaked: Soaked) -> None:
    events = list(read_lines(soaked.leg / EVENTS))
    pairs = followed(events)
    assert pairs and all(a["task"]["instruction"] != b["task"]["instruction"] for a, b in pairs)
    for _, event in pairs:
        log = (soaked.leg / f"edge-run-{event['run']}.log").read_text(encoding="utf-8")
        assert f"new instruction: {event['task']['instruction']}" in log


@pytest.mark.slow
def test_a_fault_takes_effect_and_the_runner_raises_it(soaked: Soaked) -> None:
    assert soaked.events("fault_effect")
    leg = json.loads((soaked.leg / ANALYSIS).read_text(encoding="utf-8"))
    # The last one may be cut by the end, and a busy machine may have stopped the runner for something else already.
    assert any(fault["raised_ns"] is not None for fault in leg["faults"])


@pytest.mark.slow
def test_every_second_has_a_sample_of_every_process(soaked: Soaked) -> None:
    assert len(list(read_lines(soaked.leg / SAMPLES))) >= 0.5 * DURATION_S  # a busy machine may skip some
    last = driven(soaked.leg / SAMPLES)[-1]
    assert {"edge-hil", "edge-bridge", "edge-run"} <= set(last["processes"])
    assert last["processes"]["edge-run"]["rss_bytes"] > 50e6 and last["pose"] is not None


@pytest.mark.slow
def test_timing_comes_from_ticks_and_the_wire(soaked: Soaked) -> None:
    found = soaked.result["measures"]
    assert found["tick_ms.p999"]["count"] > 50 and found["delay_s.p50"]["value"] > 0
    sent = [line for line in read_lines(soaked.leg / TRACE) if line["kind"] == "wire" and line["service"] == "sport"]
    stamps = [(line["name"], line["request_id"] / 1e6) for line in sent if line["name"] in ("Move", "StopMove")]
    # After a StopMove the bridge waits for the robot.
    gaps_ms = [b - a for (name, a), (_, b) in itertools.pairwise(stamps) if name == "Move"]
    off_ms = [abs(gap_ms - 20.0) for gap_ms in gaps_ms if 5.0 < gap_ms < 500.0]
    assert found["bridge_jitter_with_stalls_ms.max"]["count"] == len(off_ms) > 250
    assert found["bridge_jitter_with_stalls_ms.max"]["value"] == pytest.approx(max(off_ms), abs=0.01)
    # Less the machine's stalls, of which there are many while all cores are busy.
    assert found["bridge_jitter_ms.p50"]["count"] == len(off_ms)
    assert 0.0 <= found["bridge_jitter_ms.p50"]["value"] <= statistics.median(off_ms) + 0.01


@pytest.mark.slow
def test_the_machines_own_stalls_are_measured_beside_the_run(soaked: Soaked) -> None:
    found = soaked.result["measures"]["machine_stall_ms.max"]
    stalls = read_stalls(soaked.leg / STALLS)
    assert found["count"] == (0 if stalls is None else len(stalls))
    assert ("not measured in 1 legs" in found.get("note", "")) is (stalls is None)


@pytest.mark.slow
def test_the_result_has_the_keys_of_edge_run_and_the_report_loads_nothing(soaked: Soaked) -> None:
    result = soaked.result
    assert {"ticks", "missed", "tick_ms"} <= set(result["control"])
    assert set(result["delay_s"]) == {"p50", "p99", "max"} and set(result["power_w"]) == {"mean", "p99", "source"}
    text = (soaked.folder / "report.html").read_text(encoding="utf-8")
    assert "untrained" in text and "camera stops" in text and "data:image/gif" in text
    assert "<script" not in text and 'src="http' not in text


@pytest.mark.slow
@pytest.mark.parametrize(
    ("more", "named"), [([], "--resume"), (["--resume", "--people", "3"], "people")], ids=["again", "other options"]
)
def test_a_second_soak_and_other_options_are_refused(
    soaked: Soaked, capsys: pytest.CaptureFixture[str], more: list[str], named: str
) -> None:
    assert cli.main([*soaked.arguments, *more]) == 2
    assert named in capsys.readouterr().err


@pytest.mark.slow
def test_a_finished_soak_is_resumed_without_room_to_record_and_changes_nothing(
    soaked: Soaked, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = soaked.result["measures"]
    monkeypatch.setattr(os, "statvfs", lambda _path: FULL_DISK)
    assert cli.main([*soaked.arguments, "--resume"]) == soaked.code
    assert soaked.result["measures"] == before


@pytest.mark.slow
def test_the_files_of_a_killed_soak_are_counted(soaked: Soaked, tmp_path: Path) -> None:
    copy = tmp_path / "out"
    shutil.copytree(soaked.folder, copy)
    (copy / "legs" / "001" / ANALYSIS).unlink()
    samples = copy / "legs" / "001" / SAMPLES
    samples.write_text(samples.read_text(encoding="utf-8")[:-40], encoding="utf-8")  # cut in the last line
    (copy / "legs" / "002").mkdir()  # killed before its first second
    soak = SoakFolder.open(copy)
    assert len(soak.legs) == 1 and soak.elapsed_s > 0.5 * DURATION_S
    assert measures(soak.legs, soak.samples())["cpu_percent.edge-run.mean"].value is not None


@pytest.mark.parametrize(("text", "seconds"), [("90s", 90), ("10m", 600), ("1.5h", 5400), ("1d", 86_400), ("45", 45)])
def test_a_time_has_a_unit_or_is_in_seconds(text: str, seconds: float) -> None:
    assert parse_seconds(text) == seconds


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (["--duration", "1s"], "--duration"),
        (["--leg", "1s"], "--leg"),
        (["--scene", "nowhere"], "nowhere"),
        (["--scene", "office", "--scene", "corridor"], "--scene corridor"),  # hours later, without this check
        (["--faults", "absent.toml"], "absent.toml"),
        (["--budget", "absent.toml"], "absent.toml"),
        (["--speed-limit", "9"], "--speed-limit"),
        (["--people", "-1"], "--people"),
    ],
)
def test_bad_arguments_are_refused_before_anything_starts(
    nano_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], change: list[str], named: str
) -> None:
    arguments = ["--artifacts", str(nano_dir), "--duration", "1m", "--out", str(tmp_path / "out"), *change]
    assert cli.main(arguments) == 2
    error = capsys.readouterr().err
    assert named in error and error.count("\n") == 1 and not (tmp_path / "out").exists()


def test_invalid_artifacts_are_refused(tmp_path: Path) -> None:
    assert cli.main(["--artifacts", str(tmp_path), "--duration", "1m", "--out", str(tmp_path / "out")]) == 3


def test_a_disk_too_full_to_record_to_is_refused_before_anything_starts(
    nano_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(os, "statvfs", lambda _path: FULL_DISK)
    out = tmp_path / "not yet" / "out"
    assert cli.main(["--artifacts", str(nano_dir), "--duration", "1m", "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert f"--out {out}: 61440 MiB" in error and error.count("\n") == 1 and not out.parent.exists()


@pytest.mark.slow
def test_ctrl_c_writes_the_report_of_the_finished_part(nano_dir: Path, tmp_path: Path) -> None:
    need_room_to_record(tmp_path)
    out = tmp_path / "out"
    command = [sys.executable, "-m", "sim_hil.soak.cli", "--artifacts", str(nano_dir), "--duration", "1h"]
    samples = out / "legs" / "001" / SAMPLES
    with subprocess.Popen([*command, "--scene", "office", "--people", "0", "--out", str(out)]) as process:
        try:
            wait_for(
                lambda: process.poll() is not None or (samples.exists() and samples.read_bytes()),
                END_S,
                "the first sample",
            )
            process.send_signal(signal.SIGINT)
            assert process.wait(END_S) == 130
        finally:
            process.kill()
    result = json.loads((out / "result.json").read_text(encoding="utf-8"))
    assert not result["finished"] and (out / "report.html").exists()
