"""`edge-calib latency`: generation times beside control, or out of a log, become a profile that others draw from."""

from __future__ import annotations

import dataclasses
import json
import threading
from pathlib import Path
from typing import Any

import pytest

from calib.cli import main
from calib.latency import LEAST
from calib.latency_load import WARM, Decoding, Measured, MeasureError, measure
from edge.artifacts.files import ArtifactError
from edge.artifacts.manifest import Artifacts
from edge.core.cli import EXIT_BAD_INPUT, EXIT_CHECK_FAILED, EXIT_DONE
from edge.flightlog.recorder import Recorder
from edge.inference.latency_profile import LatencyError, LatencyProfile, load_profile, times_of
from edge.reasoning.generation_cycle import Mode
from export.evaluation.calibration import load_calibration
from sim_hil.benchmark.conditions.latency import parse_latency

INSTRUCTION = "walk down the corridor"


def semantic(started_s: float, anchor_s: float, ready_s: float) -> dict[str, int]:
    return {"started_ns": round(started_s * 1e9), "anchor_ns": round(anchor_s * 1e9), "ready_ns": round(ready_s * 1e9)}


@pytest.fixture
def flight_log(tmp_path: Path) -> Path:
    """A run of 30 generations of 1.5 s, their newest frames 0.5 s late."""
    recorder = Recorder(tmp_path / "flight.mcap")
    for number in range(30):
        record = semantic(2.0 * number, 2.0 * number + 0.5, 2.0 * number + 1.5)
        recorder.put("/semantic", record["ready_ns"], record)
    recorder.close(5.0)
    return tmp_path / "flight.mcap"


def run(*arguments: object) -> int:
    return main(["latency", *map(str, arguments)])


def test_a_log_becomes_a_profile_that_the_benchmark_reads(flight_log: Path, tmp_path: Path, capsys: Any) -> None:
    out = tmp_path / "profile.json"
    assert run("--log", flight_log, "--out", out, "--json", "-") == EXIT_DONE
    profile = parse_latency(f"profile:{out}")
    assert profile.generation_s == pytest.approx([1.5] * 30) and profile.anchor_after_s == pytest.approx([0.5] * 30)
    assert profile.tagged == "measured"
    result = json.loads(capsys.readouterr().out)
    assert result["generations"] == 30 and result["mean_s"] == pytest.approx(1.5) and result["tagged"] == "measured"


def test_a_scaled_profile_has_the_requested_mean_and_is_marked_modelled(flight_log: Path, tmp_path: Path) -> None:
    out = tmp_path / "profile.json"
    assert run("--log", flight_log, "--scale-to-mean", 3, "--out", out) == EXIT_DONE
    profile = load_profile(out)
    assert profile.mean_s == pytest.approx(3.0) and profile.tagged == "modelled"
    assert "flight log" in profile.source and "scaled by 2 to a mean of 3 s" in profile.source
    assert profile.anchor_after_s == pytest.approx([1.0] * 30)


@pytest.mark.parametrize("mean_s", [0.0, -1.0, float("nan"), float("inf")])
def test_a_mean_that_no_profile_has_is_refused(mean_s: float) -> None:
    with pytest.raises(LatencyError, match="means above 0 s"):
        LatencyProfile("n", "s", (1.0,)).scaled_to_mean(mean_s)


def test_a_profile_is_marked_measured_or_modelled() -> None:
    content = {"schema": 1, "name": "n", "source": "s", "generation_s": [1.0]}
    assert LatencyProfile.of_json(content).tagged == "modelled"
    assert LatencyProfile.of_json({**content, "tagged": "measured"}).tagged == "measured"
    with pytest.raises(LatencyError, match="expected tagged to be measured or modelled"):
        LatencyProfile.of_json({**content, "tagged": "guessed"})


def test_a_frame_older_than_its_generation_counts_into_its_time() -> None:
    assert times_of(semantic(4.0, 3.9, 6.0)) == pytest.approx((2.1, 0.0))
    assert times_of(semantic(1.0, 1.5, 4.0)) == pytest.approx((3.0, 0.5))


def test_too_few_generations_make_no_profile(tmp_path: Path, capsys: Any) -> None:
    few, out = tmp_path / "few.json", tmp_path / "profile.json"
    few.write_text(json.dumps(LatencyProfile("n", "s", (1.0,) * (LEAST - 1)).as_json()))
    assert run("--log", few, "--out", out) == EXIT_CHECK_FAILED
    assert f"expected {LEAST} or more" in capsys.readouterr().err and not out.exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--log", "nowhere.mcap", "--out", "p.json"), "nowhere.mcap"),
        (("--artifacts", "nowhere", "--out", "p.json"), "nowhere"),
        (("--log", "x.json", "--out", "p.toml"), "ends in .json"),
        (("--log", "x.json", "--out", "no/where/p.json"), "there is no directory"),
        (("--log", "x.json", "--out", "p.json", "--generations", "1"), "--generations 1"),
        (("--log", "x.json", "--out", "p.json", "--seconds", "nan"), "--seconds nan"),
        (("--log", "x.json", "--out", "p.json", "--instruction", ""), "instruction"),
    ],
)
def test_invalid_arguments_are_refused_in_one_line(
    arguments: tuple[str, ...], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(*arguments) == EXIT_BAD_INPUT
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1 and not list(tmp_path.iterdir())


def measured(artifacts: Artifacts, *, mode: Mode = Mode.ASYNC, generations: int = 2, seconds: float = 60.0) -> Measured:
    return measure(
        artifacts,
        load_calibration("corridor-go2").clips[0],
        instruction=INSTRUCTION,
        mode=mode,
        generations=generations,
        seconds=seconds,
        say=lambda _line: None,
        stop=threading.Event(),
    )


@pytest.mark.slow
def test_generations_run_beside_ticks_and_the_first_generations_are_left_out(artifacts: Artifacts) -> None:
    found = measured(artifacts)
    assert len(found.times_s) >= 2 and found.failed == 0
    assert all(0 <= anchor_s < total_s < 60 for total_s, anchor_s in found.times_s)
    # Ticks went on all the while: ten a second, were it not for a busy machine.
    assert found.ticks >= len(found.times_s) + WARM
    calls = LatencyProfile("n", "s", (1.0,), call_s=found.call_s, rest_s=(0.5,))
    decoded_s = [calls.decode_s(decoding.call_tokens[1:]) for decoding in found.decoding]
    assert sum(decoded_s) == pytest.approx(sum(decoding.after_first_s for decoding in found.decoding))


@pytest.mark.slow
def test_a_measurement_ends_after_its_time_with_what_there_is(artifacts: Artifacts) -> None:
    found = measured(artifacts, mode=Mode.NO_REASONING, generations=10_000, seconds=0.5)
    assert len(found.times_s) < 10_000


def test_durations_of_calls_have_the_proportions_alone_and_the_sum_beside_control() -> None:
    decoding = (Decoding(0.5, (1, 2, 4)), Decoding(0.4, (2, 4)))
    found = Measured(((1.0, 0.0),) * 2, 9, 0, 0, decoding, {2: 1.0, 4: 2.0})
    assert found.call_s == ((2, pytest.approx(0.18)), (4, pytest.approx(0.36)))


def test_without_calls_after_the_first_token_no_duration_of_a_call_is_known() -> None:
    assert Measured(((1.0, 0.0),), 9, 0, 0, (Decoding(0.0, (1,)),), {2: 1.0}).call_s == ()


def test_graphs_that_the_self_test_has_not_proven_are_not_measured(artifacts: Artifacts) -> None:
    with pytest.raises(ArtifactError, match="no known answers for the self-test"):
        measured(dataclasses.replace(artifacts, known_answers=None))


@pytest.mark.slow
def test_a_control_thread_that_dies_ends_the_measurement(artifacts: Artifacts, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise ValueError("no picture")

    monkeypatch.setattr("calib.latency_load.TokenRing.put", fail)
    with pytest.raises(MeasureError, match="no picture"):
        measured(artifacts)
