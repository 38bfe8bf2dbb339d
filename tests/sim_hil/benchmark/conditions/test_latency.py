"""Latency of the benchmark: a constant, a measured profile, a flight log or an edge-run result."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.flightlog.recorder import Recorder
from edge.inference import latency_profile
from sim_hil.benchmark.conditions.latency import (
    LatencyError,
    LatencyProfile,
    LatencySampler,
    load_profile,
    parse_latency,
)


def profile(**changed: Any) -> dict[str, Any]:
    return {"schema": 1, "name": "orin", "source": "a bench", "generation_s": [4.5, 4.8, 5.1], **changed}


def test_a_number_is_a_constant() -> None:
    sampler = LatencySampler(parse_latency("2.5"), 1, "a")
    assert {sampler.draw().total_ns for _ in range(9)} == {2_500_000_000}


def test_draws_are_those_of_seed_and_episode_and_differ_between_episodes() -> None:
    def draws(seed: int, name: str) -> list[int]:
        sampler = LatencySampler(LatencyProfile.of_json(profile()), seed, name)
        return [sampler.draw().total_ns for _ in range(20)]

    assert draws(1, "a") == draws(1, "a")
    assert draws(1, "a") != draws(1, "b") and draws(1, "a") != draws(2, "a")


def test_a_generation_keeps_its_own_late_anchor() -> None:
    sampler = LatencySampler(LatencyProfile.of_json(profile(anchor_after_s=[0.5, 0.8, 1.1])), 1, "a")
    drawn = {(timing.total_ns, timing.anchor_after_ns) for timing in (sampler.draw() for _ in range(99))}
    assert drawn == {(4_500_000_000, 500_000_000), (4_800_000_000, 800_000_000), (5_100_000_000, 1_100_000_000)}


@given(st.lists(st.floats(0, 60), min_size=1, max_size=20))
def test_a_profile_survives_json(times: list[float]) -> None:
    made = LatencyProfile("n", "s", tuple(times))
    assert LatencyProfile.of_json(json.loads(json.dumps(made.as_json()))) == made


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"schema": 2}, "schema = 1"),
        ({"generation_s": []}, "1 to 100000 generation times, found 0"),
        ({"generation_s": [float("nan")]}, "list of seconds"),
        ({"generation_s": [61.0]}, "0 to 60 s"),
        ({"generation_s": "4.5"}, "list of seconds"),
        ({"generation_s": [True]}, "list of seconds"),
        ({"anchor_after_s": [0.1]}, "as many anchor_after_s"),
        ({"anchor_after_s": [5.0, 0.0, 0.0]}, "from 0 to its generation's time"),
        ({"name": ""}, "name and source"),
        ({"unit": "s"}, "unknown key 'unit'"),
    ],
)
def test_a_wrong_profile_is_one_clear_line(tmp_path: Path, changed: dict[str, Any], message: str) -> None:
    path = tmp_path / "profile.json"
    path.write_text(json.dumps(profile(**changed)))
    with pytest.raises(LatencyError, match=message) as caught:
        parse_latency(f"profile:{path}")
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


CALLS = {"call_s": {"2": 0.1, "4": 0.2, "8": 0.3}, "rest_s": [1.0, 1.1, 1.2]}


def test_a_profile_of_calls_survives_json() -> None:
    made = LatencyProfile.of_json(profile(**CALLS))
    assert made.call_s == ((2, 0.1), (4, 0.2), (8, 0.3))
    assert LatencyProfile.of_json(json.loads(json.dumps(made.as_json()))) == made


def test_a_profile_without_calls_is_written_as_before() -> None:
    assert set(LatencyProfile.constant(2.0).as_json()) == {
        "schema", "name", "source", "generation_s", "anchor_after_s", "tagged",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("call_tokens", "expected_s"),
    [((), 0.0), ((1,), 0.1), ((1, 2, 3), 0.4), ((8, 5), 0.6), ((9,), 0.4), ((16,), 0.6)],
)
def test_a_call_takes_the_time_of_the_next_permitted_number_of_rows(
    call_tokens: tuple[int, ...], expected_s: float
) -> None:
    assert LatencyProfile.of_json(profile(**CALLS)).decode_s(call_tokens) == pytest.approx(expected_s)


def test_calls_are_counted_only_where_the_policy_asks_for_it() -> None:
    made = LatencyProfile.of_json(profile(**CALLS))
    whole, counted = (LatencySampler(made, 1, "a", by_calls=by_calls).draw() for by_calls in (False, True))
    assert whole.total_ns in (4_500_000_000, 4_800_000_000, 5_100_000_000) and whole.decode_ns is None
    assert counted.total_ns in (1_000_000_000, 1_100_000_000, 1_200_000_000)
    assert counted.decode_ns is not None and counted.decode_ns((1, 8)) == 400_000_000


def test_scaling_scales_the_calls_too() -> None:
    scaled = LatencyProfile.of_json(profile(**CALLS)).scaled_to_mean(9.6)
    assert scaled.decode_s((1, 8)) == pytest.approx(0.8) and scaled.rest_s == pytest.approx((2.0, 2.2, 2.4))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"call_s": {"2": 0.1}}, "as many rest_s as generation_s, found 0"),
        ({"rest_s": [1.0, 1.0, 1.0]}, "expected call_s to have calls"),
        ({**CALLS, "call_s": {"4": 0.1}}, "expected call_s to have calls"),
        ({**CALLS, "call_s": {"1": 0.1, "2": 0.1}}, "expected call_s to have calls"),
        ({**CALLS, "call_s": {"2": 0.1, "17": 0.1}}, "expected call_s to have calls"),
        ({**CALLS, "call_s": {"2": 0.0}}, "call_s above 0"),
        ({**CALLS, "call_s": {"two": 0.1}}, "seconds by number of rows"),
        ({**CALLS, "call_s": [0.1]}, "seconds by number of rows"),
        ({**CALLS, "rest_s": [1.0, 1.0, 61.0]}, "rest_s from its anchor_after_s"),
        ({**CALLS, "anchor_after_s": [1.5, 0.0, 0.0]}, "rest_s from its anchor_after_s"),
    ],
)
def test_wrong_calls_are_one_clear_line(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(LatencyError, match=message):
        LatencyProfile.of_json(profile(**changed))


def test_a_profile_may_be_toml(tmp_path: Path) -> None:
    path = tmp_path / "profile.toml"
    path.write_text('schema = 1\nname = "n"\nsource = "s"\ngeneration_s = [1.0, 2]\n')
    assert load_profile(path).generation_s == (1.0, 2.0)


@pytest.mark.parametrize("suffix", ["json", "toml"])
def test_a_time_of_hundreds_of_digits_is_refused(tmp_path: Path, suffix: str) -> None:
    path, content = tmp_path / f"profile.{suffix}", profile(generation_s=[10**400])
    lines = [f"{key} = {json.dumps(value)}\n" for key, value in content.items()]
    path.write_text(json.dumps(content) if suffix == "json" else "".join(lines))
    with pytest.raises(LatencyError):
        load_profile(path)


@pytest.mark.parametrize("argument", ["soon", "-1", "nan", "inf", "61", "profile:", "profile:nowhere.json"])
def test_an_invalid_latency_is_refused(argument: str) -> None:
    with pytest.raises(LatencyError):
        parse_latency(argument)


def test_a_flight_log_gives_each_generations_time_and_anchor(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "flight.mcap")
    for started_s, anchor_s, ready_s in ((1.0, 1.5, 4.0), (4.0, 3.9, 6.0)):
        record = {"started_ns": int(started_s * 1e9), "anchor_ns": int(anchor_s * 1e9), "ready_ns": int(ready_s * 1e9)}
        recorder.put("/semantic", record["ready_ns"], record)
    recorder.close(5.0)
    read = load_profile(tmp_path / "flight.mcap")
    # The second one's newest frame is older than its start: its delay at release is kept, 2.1 s.
    assert read.generation_s == pytest.approx((3.0, 2.1)) and read.anchor_after_s == pytest.approx((0.5, 0.0))


def test_a_flight_log_with_a_stamp_of_hundreds_of_digits_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = {"started_ns": 0, "anchor_ns": 0, "ready_ns": 10**400}
    monkeypatch.setattr(latency_profile, "read_messages", lambda _: iter([("/semantic", 0, record)]))
    with pytest.raises(LatencyError, match="misshapes a field"):
        load_profile(tmp_path / "flight.mcap")


def test_an_edge_run_result_gives_a_distribution_through_its_percentiles(tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    points = {"p50": 2000.0, "p99": 3000.0, "max": 4000.0}
    path.write_text(json.dumps({"reasoning": {"generation_ms": points, "late_anchor_ms": {**points, "p50": 500.0}}}))
    read = load_profile(path)
    times = sorted(read.generation_s)
    assert times[: len(times) // 2] == [2.0] * (len(times) // 2) and 3.0 < times[-1] <= 4.0
    assert set(read.anchor_after_s) == {0.5}


def test_an_edge_run_without_generations_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    path.write_text(json.dumps({"reasoning": {"generation_ms": {"p50": None, "p99": None, "max": None}}}))
    with pytest.raises(LatencyError, match=r"expected reasoning.generation_ms with p50, p99 and max"):
        load_profile(path)
