"""The exported model on an episode's clock: the runner's own pieces, told the delay that virtual time made."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge.artifacts.files import ArtifactError
from edge.artifacts.manifest import Artifacts, load_artifacts
from edge.core.geometry import SE2
from edge.flightlog.part import encode
from edge.flightlog.schemas import SCHEMAS
from edge.inference.language import LanguageModel
from edge.reasoning.prompt import InstructionError
from edge.state.switches import Speculation, SwitchOptions
from sim_hil.benchmark.conditions.conditions import Conditions, ConditionsError, PolicySpec
from sim_hil.benchmark.conditions.latency import LatencyProfile
from sim_hil.benchmark.conditions.variants import VARIANTS, artifact_directory, check_variant
from sim_hil.benchmark.env.observation import Observation
from sim_hil.benchmark.policies.artifacts_policy import ArtifactsPolicy, check_suits
from sim_hil.benchmark.policies.select import camera_for, check_artifacts, open_policy, robot_config
from tests.edge.flightlog.test_log_schemas import complaints
from tests.support.artifact_directory import edit_manifest
from tests.support.benchmark import dynanav_fakes as fakes

LIMITS = robot_config().limits
Rows = list[tuple[tuple[float, float, float], dict[str, Any]]]


@pytest.fixture(scope="module")
def policies(nano_dir: Path) -> Iterator[dict[str, ArtifactsPolicy]]:
    """One opened policy a mode, with the latency that the test of it expects."""
    asked = {"async": 0.5, "sync": 0.5, "no-reasoning": 0.2}
    robot = robot_config()
    opened = {
        mode: ArtifactsPolicy(nano_dir, mode=mode, latency=LatencyProfile.constant(latency_s), robot=robot)
        for mode, latency_s in asked.items()
    }
    yield opened
    for policy in opened.values():
        policy.close()


class Sink:
    """A recorder that keeps topics and records."""

    def __init__(self, records: list[tuple[str, Any]]) -> None:
        self._records = records

    def put(self, topic: str, stamp_ns: int, payload: Any) -> None:
        self._records.append((topic, payload))


def drive(policy: ArtifactsPolicy, ticks: int, *, step_m: float = 0.05, seed: int = 1, obeys: bool = False) -> Rows:
    """What it does and knows in each tick; odometry reports a straight walk, if it `obeys` only where commanded."""
    rng = np.random.default_rng(seed)
    width, height = policy.camera
    policy.reset(fakes.episode("a"), "go down the corridor", None, seed)
    rows: Rows = []
    x_m = 0.0
    for tick in range(ticks):
        image = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
        odometry = SE2(x_m, 0.0, 0.0)
        command = policy.act(Observation(tick / 10, image, (step_m * 10, 0.0, 0.0), odometry, False, False))
        rows.append((command, policy.notes()))
        x_m += step_m if not obeys or any(command) else 0.0
    return rows


def test_graphs_that_the_self_test_cannot_prove_are_refused(nano_dir: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(nano_dir, tmp_path / "nano"))
    edit_manifest(copy, lambda manifest: manifest.update(self_test={}))
    with pytest.raises(ArtifactError, match="no known answers for the self-test; export again"):
        ArtifactsPolicy(copy, mode="async", latency=LatencyProfile.constant(0.5), robot=robot_config())


def test_it_stands_until_the_first_latency_is_over_and_drives_from_then_on(
    policies: dict[str, ArtifactsPolicy],
) -> None:
    rows = drive(policies["async"], 8)
    assert [command == (0.0, 0.0, 0.0) for command, _ in rows] == [True] * 5 + [False] * 3
    assert [notes["reason"] for _, notes in rows[:6]] == ["no-semantic-state"] * 5 + ["ok"]


def test_an_episode_is_recorded_like_a_flight_of_the_runner(policies: dict[str, ArtifactsPolicy]) -> None:
    policy, records = policies["async"], []
    policy.recorder = Sink(records)
    try:
        drive(policy, 8)
    finally:
        policy.recorder = None
    topics = [topic for topic, _ in records]
    assert [topics.count(topic) for topic in ("/run", "/tick", "/camera", "/semantic")] == [1, 8, 8, 1]
    for topic, record in records:
        assert topic == "/camera" or complaints(json.loads(encode(record, 1)), SCHEMAS[topic]) == []


@pytest.mark.slow
def test_the_model_receives_the_delay_and_motion_of_virtual_time(policies: dict[str, ArtifactsPolicy]) -> None:
    rows = drive(policies["async"], 12)
    inputs = [
        (round(notes["delay_s"], 3), round(notes["offset"][0], 3)) for _, notes in rows if notes["delay_s"] is not None
    ]
    assert inputs[:6] == [(0.5, 0.25), (0.6, 0.3), (0.7, 0.35), (0.8, 0.4), (0.9, 0.45), (0.5, 0.25)]


def test_odometry_that_reports_another_motion_changes_the_motion_offset(policies: dict[str, ArtifactsPolicy]) -> None:
    _, notes = drive(policies["async"], 6, step_m=0.06)[-1]
    assert notes["offset"][0] == pytest.approx(0.3)


@pytest.mark.slow
def test_the_same_pictures_give_the_same_commands_bit_for_bit(policies: dict[str, ArtifactsPolicy]) -> None:
    first, again, other = (drive(policies["async"], 12, seed=seed) for seed in (1, 1, 2))
    assert [command for command, _ in first] == [command for command, _ in again] != [command for command, _ in other]


@pytest.mark.slow
def test_commands_keep_the_robots_limits_and_slew(policies: dict[str, ArtifactsPolicy]) -> None:
    commands = np.array([command for command, _ in drive(policies["async"], 20)])
    assert np.abs(commands[:, 0]).max() <= LIMITS.vx_max_mps and np.abs(commands[:, 2]).max() <= LIMITS.wz_max_radps
    faster = np.diff(np.abs(commands[:, 0]))
    assert faster.max() <= LIMITS.accel_mps2 * 0.1 + 1e-9


@pytest.mark.slow
def test_sync_drives_half_a_second_with_delay_zero_and_halts_for_the_latency(
    policies: dict[str, ArtifactsPolicy],
) -> None:
    rows = drive(policies["sync"], 22, obeys=True)
    moved = [command != (0.0, 0.0, 0.0) for command, _ in rows]
    # The tick in which it halts sees the last of the motion: it thinks from the next one on.
    assert moved == [False] * 5 + [True] * 5 + [False] * 6 + [True] * 5 + [False]
    assert {notes["delay_s"] for _, notes in rows if notes["delay_s"] is not None} == {0.0}
    assert {tuple(notes["offset"]) for _, notes in rows if notes["offset"]} == {(0.0, 0.0, 0.0)}


def test_without_reasoning_it_drives_without_a_text(policies: dict[str, ArtifactsPolicy]) -> None:
    policy = policies["no-reasoning"]
    rows = drive(policy, 6)
    assert [command != (0.0, 0.0, 0.0) for command, _ in rows] == [False, False, True, True, True, True]
    assert {record["new_tokens"] for record in policy.generations()} == {0} and rows[-1][1]["text"] == ""


CALLS = LatencyProfile("n", "s", (1.0,), call_s=((2, 0.011), (4, 0.011), (16, 0.011)), rest_s=(0.1,))


def by_calls(directory: Path, speculation: Speculation = Speculation.ON) -> ArtifactsPolicy:
    switches = SwitchOptions(speculation=speculation)
    return ArtifactsPolicy(directory, mode="async", latency=CALLS, robot=robot_config(), switches=switches)


@pytest.fixture(scope="module")
def guessing(nano_dir: Path) -> ArtifactsPolicy:
    """A policy whose latency depends on the calls of its texts."""
    return by_calls(nano_dir)


def test_a_generation_takes_the_time_of_the_calls_that_its_text_takes(guessing: ArtifactsPolicy) -> None:
    drive(guessing, 12)
    records = guessing.generations()
    assert records
    for record in records:
        due_s = record["started_s"] + 0.1 + CALLS.decode_s(record["call_tokens"][1:])
        assert due_s - 1e-6 <= record["released_s"] <= due_s + 0.1


@pytest.mark.slow
def test_without_guesses_each_token_of_the_same_text_costs_a_call(nano_dir: Path, guessing: ArtifactsPolicy) -> None:
    plain = by_calls(nano_dir, Speculation.OFF)
    for policy in (plain, guessing):
        drive(policy, 12)
    expected, found = plain.generations()[0], guessing.generations()[0]
    assert found["text"] == expected["text"] and max(found["call_tokens"]) > 1
    assert expected["call_tokens"] == (1,) * len(expected["call_tokens"])
    assert expected["new_tokens"] <= len(expected["call_tokens"]) <= expected["new_tokens"] + 1


@pytest.mark.slow
def test_the_same_episode_takes_the_same_calls_whatever_was_driven_before(guessing: ArtifactsPolicy) -> None:
    drive(guessing, 12)
    first = guessing.generations()
    drive(guessing, 12, seed=2)
    drive(guessing, 12)
    assert guessing.generations() == first


@pytest.mark.slow
def test_a_device_that_guesses_nothing_takes_one_call_a_token(
    guessing: ArtifactsPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(guessing, "_latency", replace(CALLS, call_s=((1, 0.01),)))
    drive(guessing, 12)
    assert {tokens for record in guessing.generations() for tokens in record["call_tokens"]} == {1}


@pytest.mark.slow
def test_more_rows_than_this_machine_computes_exactly_are_refused(
    nano_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(model: LanguageModel) -> str:
        return "no equal bits"

    monkeypatch.setattr(LanguageModel, "speculate", refuse)
    with pytest.raises(ArtifactError, match="up to 16 rows, this machine computes at most 1"):
        by_calls(nano_dir)


@pytest.mark.slow
def test_generations_have_times_of_the_episode(policies: dict[str, ArtifactsPolicy]) -> None:
    policy = policies["async"]
    drive(policy, 12)
    inputs = [(r["started_s"], r["anchor_s"], r["released_s"]) for r in policy.generations()]
    assert inputs == [(0.0, 0.0, 0.5), (0.5, 0.5, 1.0)]


def test_an_instruction_that_does_not_fit_the_model_is_refused(policies: dict[str, ArtifactsPolicy]) -> None:
    with pytest.raises(InstructionError):
        policies["async"].reset(fakes.episode("a"), "go " * 400, None, 1)


def asked(directory: Path, **changed: Any) -> Conditions:
    made = Conditions(PolicySpec("artifacts", str(directory)), mode="async", latency=LatencyProfile.constant(1))
    return replace(made, **changed)


@pytest.mark.slow
def test_a_worker_refuses_artifacts_that_are_not_those_of_the_run(nano_dir: Path) -> None:
    with pytest.raises(ArtifactError, match="expected the artifacts that started this run"):
        open_policy(asked(nano_dir), manifest_sha256="0" * 64)


def test_artifacts_that_are_none_are_refused_before_any_episode(tmp_path: Path) -> None:
    with pytest.raises(ArtifactError):
        check_artifacts(asked(tmp_path))


def test_the_world_renders_the_models_camera(policies: dict[str, ArtifactsPolicy], nano_dir: Path) -> None:
    assert camera_for(asked(nano_dir), policies["async"]) == (128, 128)
    with pytest.raises(ConditionsError, match="needs 128x128"):
        camera_for(asked(nano_dir, camera="320x180"), policies["async"])


def test_a_variant_is_its_own_sub_directory_or_the_artifacts_themselves(nano_dir: Path, tmp_path: Path) -> None:
    (tmp_path / "rl").symlink_to(nano_dir, target_is_directory=True)
    assert artifact_directory(tmp_path, "rl") == tmp_path / "rl"
    assert artifact_directory(nano_dir, "full") == nano_dir
    with pytest.raises(ConditionsError, match="--variant il: expected"):
        artifact_directory(tmp_path, "il")


@pytest.mark.parametrize("variant", sorted(set(VARIANTS) - {"full"}))
def test_a_variant_that_the_model_is_not_is_refused(nano_dir: Path, variant: str) -> None:
    artifacts = load_artifacts(nano_dir)
    check_variant(artifacts, "full")
    with pytest.raises(ConditionsError, match=f"--variant {variant}: expected a model with"):
        check_variant(artifacts, variant)


def test_a_model_guided_by_its_text_cannot_do_without_reasoning(
    artifacts: Artifacts, monkeypatch: pytest.MonkeyPatch
) -> None:
    check_suits(artifacts, "no-reasoning")
    monkeypatch.setattr(Artifacts, "guided_by_waypoints", True)
    with pytest.raises(ConditionsError, match="expected async or sync"):
        check_suits(artifacts, "no-reasoning")
