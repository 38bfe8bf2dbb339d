"""`edge-bench` as a command: the same trajectories in any number of processes and through an interruption."""

from __future__ import annotations

import json
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import pytest

from sim_hil.benchmark import cli, run_command
from sim_hil.benchmark.results.store import StoreError, read_results
from tests.support.benchmark import dynanav_fakes as fakes
from tests.support.processes import REPOSITORY

EPISODES = ("walk-1", "walk-2")


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two short walks of the wheeled base beside somebody."""
    path = tmp_path_factory.mktemp("suite") / "small.toml"
    path.write_text(fakes.suite_text(*EPISODES, timeout_s=1.2, people=1))
    return path


@pytest.fixture(scope="module")
def two_jobs(suite: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of two processes at a time, with a video of one episode; its result in `asked.json`."""
    out = tmp_path_factory.mktemp("two") / "out"
    arguments = ["--suite", str(suite), "--policy", "random", "--drift", "severe", "--jobs", "2", "--video", "failed"]
    assert cli.main([*arguments, "--out", str(out), "--json", str(out.with_name("asked.json"))]) == 0
    return out


def hashes(out: Path) -> dict[str, str]:
    return {result.id: result.trajectory_sha256 for result in read_results(out)}


@pytest.mark.slow
def test_an_interrupted_run_of_one_process_continues_to_the_same_trajectories_as_one_of_two(
    suite: Path, two_jobs: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    arguments = ["--suite", str(suite), "--policy", "random", "--drift", "severe", "--out", str(out)]
    command = [sys.executable, "-m", "sim_hil.benchmark.cli", *arguments]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=REPOSITORY)
    deadline = time.monotonic() + 60
    while not (out / "results.jsonl").exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=30)
    assert process.returncode == 130, error
    assert f"continue with --resume --out {out}" in error
    before = hashes(out)
    assert 1 <= len(before) < len(EPISODES)
    assert cli.main([*arguments, "--resume"]) == 0
    assert hashes(out) == hashes(two_jobs) and set(hashes(out)) == set(EPISODES)
    assert before.items() <= hashes(out).items()


@pytest.mark.slow
def test_the_result_has_the_keys_that_other_tools_read(two_jobs: Path) -> None:
    result = json.loads(two_jobs.with_name("asked.json").read_text())
    assert {"episodes", "sr", "spl", "ne_m", "cr", "sr_ci95", "cr_ci95", "by_scene", "by_crowd", "by_robot"} <= set(
        result["summary"]
    )
    keys = {
        "id", "scene", "people", "robot", "seed", "success", "ne_m", "spl", "collided", "path_m", "shortest_m",
        "time_s", "trajectory_sha256",
    }  # fmt: skip
    assert [episode["id"] for episode in result["episodes"]] == list(EPISODES)
    assert all(keys <= set(episode) for episode in result["episodes"])
    assert set(result["latency"]["delay_s"]) == {"mean", "p50", "p99", "max"}
    assert result["summary"]["finished"] and result["tagged"] == "measured"


def test_the_report_is_one_page_that_loads_nothing(two_jobs: Path) -> None:
    html = (two_jobs / "report.html").read_text()
    assert html.count("data:image/png;base64,") >= 3
    assert not re.search(r"(src|href)=\"(?!data:|videos/)", html) and "<script" not in html
    assert all(name in html for name in EPISODES)


def test_failed_episodes_have_a_video_and_reached_ones_have_none(two_jobs: Path) -> None:
    for result in read_results(two_jobs):
        video = two_jobs / "videos" / f"{result.id}.mp4"
        assert video.exists() == (not result.success or result.collided)
        if video.exists():
            pictures = cv2.VideoCapture(str(video))
            found, picture = pictures.read()
            assert found and picture.shape == (720, 1280, 3) and picture[:450, :800].std() > 10
    assert not list((two_jobs / "videos").glob("*.partial*"))


def test_the_log_of_an_episode_has_a_row_a_control_period(two_jobs: Path) -> None:
    log = json.loads((two_jobs / "episodes" / "walk-1.json").read_text())
    times = log["columns"]["time_s"]
    assert (
        times[:3] == [0.0, 0.1, 0.2]
        and len(times) == 12
        and {len(column) for column in log["columns"].values()} == {12}
    )
    assert log["columns"]["odom_x_m"][-1] != pytest.approx(log["columns"]["x_m"][-1] - 1.0, abs=1e-4)


@pytest.mark.slow
def test_a_run_of_the_first_few_episodes_can_be_extended(suite: Path, two_jobs: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = ["--suite", str(suite), "--policy", "random", "--drift", "severe", "--out", str(out)]
    assert cli.main([*arguments, "--first", "1"]) == 0
    first = json.loads((out / "result.json").read_text())
    assert (first["summary"]["asked"], first["summary"]["finished"], len(hashes(out))) == (1, True, 1)
    assert "1 of 1 episodes finished" in (out / "report.html").read_text()
    assert cli.main([*arguments, "--resume"]) == 0
    assert hashes(out) == hashes(two_jobs)
    both = json.loads((out / "result.json").read_text())
    # As its wall time, what was simulated is that of the second session.
    assert both["simulated_s"] == pytest.approx(sum(r["time_s"] for r in both["episodes"]) - first["simulated_s"])


@pytest.mark.slow
def test_without_an_output_directory_the_result_is_only_printed(
    suite: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["--suite", str(suite), "--episodes", "walk-1", "--policy", "still", "--json", "-"]) == 0
    (episode,) = json.loads(capsys.readouterr().out)["episodes"]
    assert episode["end"] == "timeout" and episode["path_m"] < 0.05


def test_signals_wait_until_the_temporary_folder_is_removed(
    suite: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    handlers, remove = list[object](), shutil.rmtree

    def removed(folder: Path, **_: object) -> None:
        handlers.append(signal.getsignal(signal.SIGTERM))
        remove(folder)

    def fail(*_: object, **__: object) -> None:
        raise StoreError("made up")

    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(run_command, "execute", fail)
    monkeypatch.setattr("sim_hil.benchmark.run_command.shutil.rmtree", removed)
    assert cli.main(["--suite", str(suite), "--episodes", "walk-1", "--policy", "still"]) == 2
    assert len(handlers) == 1 and handlers[0] is not signal.SIG_DFL
    assert list(tmp_path.glob("edge-bench-*")) == []


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("--suite", "nowhere"), 2, "unknown suite 'nowhere'"),
        (("--episodes", "office-*"), 2, "--episodes 'office-*': expected a pattern of ids such as walk-1"),
        (("--clock", "realtime"), 2, "--clock realtime: expected --policy artifacts:DIR"),
        (("--live",), 2, "--live: expected --clock realtime"),
        (("--jobs", "0"), 2, "--jobs: expected 1 to 256, found 0"),
        (("--first", "0"), 2, "--first: expected a number of episodes from 1, found 0"),
        (("--wording", "9"), 2, "wording 9: episode walk-1 has 4"),
        (("--resume",), 2, "need a directory: add --out DIR"),
        (("--video", "all"), 2, "need a directory: add --out DIR"),
        (("--policy", "artifacts:nowhere"), 3, "nowhere"),
        (("--policy", "external:unix:nobody"), 2, "cannot be reached"),
        (("--json", "/"), 2, "--json"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else None,
)
def test_bad_input_is_one_clear_line_and_its_exit_code(
    suite: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], code: int, message: str
) -> None:
    given = {"--suite": str(suite), "--policy": "still", "--episodes": "walk-1"}
    asked = [part for key, value in given.items() if key not in arguments for part in (key, value)]
    assert cli.main([*asked, *arguments]) == code
    error = capsys.readouterr().err
    assert message in error and error.startswith("edge-bench: ") and error.count("\n") == 1
