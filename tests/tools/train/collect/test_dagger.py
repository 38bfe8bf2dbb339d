"""The exported policy drives as it will on a robot, with delays of its own, and the expert labels where it gets to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from edge.artifacts.files import ArtifactError
from edge.artifacts.manifest import Artifacts
from edge.core.geometry import SE2
from export.model.config import PRESETS
from sim_hil.benchmark.env.observation import Observation
from sim_hil.benchmark.env.world import EpisodeWorld
from sim_hil.benchmark.policies.artifacts_policy import ArtifactsPolicy
from sim_hil.benchmark.policies.expert import ExpertPolicy
from sim_hil.scene.scene import Vec2, load_scene
from tests.support.benchmark.benchmark_episodes import corridor_episode
from tests.support.train.train_drives import dataset, drive
from tools.train.collect import collection
from tools.train.collect.collection import Collection
from tools.train.collect.record import CameraSettings, DrivePlan, record
from tools.train.collect.steering import SHORTEST_S, PolicyDriver, PolicyOptions, Velocity, draw_latency
from tools.train.config.checks import TrainError
from tools.train.config.collect import DaggerConfig
from tools.train.config.recipe import Recipe
from tools.train.drives.drive import EXPERT, FUTURE_STEPS, POLICY
from tools.train.run.job import StageJob
from tools.train.run.run_dir import RunDir, drives_after

# -- delays -----------------------------------------------------------------------------------------------------------


def test_each_drive_has_a_delay_of_its_own_within_the_bounds() -> None:
    means = [draw_latency(2.0, np.random.default_rng(seed)).mean_s for seed in range(300)]
    assert 0.8 * SHORTEST_S < min(means) < 1.0 and 3.5 < max(means) < 4.8
    assert np.mean(means) == pytest.approx((SHORTEST_S + 4.0) / 2, abs=0.2)


# -- a drive ----------------------------------------------------------------------------------------------------------


def _options(artifacts: Artifacts, beta: float) -> PolicyOptions:
    return PolicyOptions(str(artifacts.directory), artifacts.manifest_sha256, beta, 0.25)


def _nothing(_: EpisodeWorld, chosen: NDArray[np.float64], plan_xy: Sequence[Vec2]) -> Mapping[str, Any]:
    return {}


@pytest.mark.slow
def test_a_policys_drive_is_labelled_by_the_expert(artifacts: Artifacts) -> None:
    episode = corridor_episode(robot="carter", timeout_s=4.0)
    plan = DrivePlan(
        episode,
        load_scene("corridor"),
        np.array(((0.0, 0.0), (6.0, 0.0))),
        CameraSettings(),
        "none",
        policy_drives=True,
    )
    with PolicyDriver(_options(artifacts, 0.0), episode, np.random.default_rng(1)) as policy:
        recorded = record(plan, ExpertPolicy(speed_mps=0.8), policy.steer, _nothing)
        assert policy.name == f"policy:{artifacts.manifest_sha256[:12]}"
    assert np.all(recorded.arrays["by"] == POLICY) and np.all(recorded.arrays["future_steps"] == FUTURE_STEPS)
    # While an untrained policy stands or strays, the expert means to go on.
    assert np.all(np.hypot(*recorded.arrays["future"][:20, 29, :2].T) > 0.3)


@pytest.mark.slow
def test_in_the_experts_stretches_the_policy_goes_on_seeing(
    artifacts: Artifacts, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted: Velocity = (0.5, 0.0, 0.1)
    seen: list[float] = []
    act = ArtifactsPolicy.act

    def watched(self: ArtifactsPolicy, observation: Observation) -> Velocity:
        seen.append(observation.time_s)
        return act(self, observation)

    monkeypatch.setattr(ArtifactsPolicy, "act", watched)
    image = np.full((128, 128, 3), 90, np.uint8)
    with PolicyDriver(_options(artifacts, 1.0), corridor_episode(), np.random.default_rng(1)) as policy:
        inputs = [
            policy.steer(Observation(tick / 10, image, (0.0, 0.0, 0.0), SE2(0.0, 0.0, 0.0), False, False), wanted)
            for tick in range(5)
        ]
    assert inputs == [(wanted, EXPERT)] * 5 and seen == [0.0, 0.1, 0.2, 0.3, 0.4]


@pytest.mark.slow
def test_other_artifacts_than_the_rounds_are_refused(artifacts: Artifacts) -> None:
    options = PolicyOptions(str(artifacts.directory), "0" * 64, 0.0, 2.0)
    with pytest.raises(ArtifactError, match="not the artifacts"):
        PolicyDriver(options, corridor_episode(), np.random.default_rng(1))


# -- rounds -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def filled(monkeypatch: pytest.MonkeyPatch) -> list[Collection]:
    """What would have been collected."""
    asked: list[Collection] = []
    monkeypatch.setattr(collection, "fill", lambda writer, what, jobs, **rest: asked.append(what))
    return asked


def _job(folder: Path, **dagger: Any) -> StageJob:
    config = DaggerConfig(**{"rounds": 2, "episodes": 30, "latency_mean_s": 1.5, **dagger})
    return StageJob(Recipe("test", 1, PRESETS["nano"], dagger=config), RunDir(folder), seed=5)


@pytest.mark.slow
def test_the_expert_helps_less_in_every_round_and_drives_other_scenarios(
    tmp_path: Path, artifacts: Artifacts, filled: list[Collection]
) -> None:
    for number in (1, 2, 3):
        collection.run_round(_job(tmp_path), artifacts.directory, number)
    assert [asked.policy.beta for asked in filled if asked.policy is not None] == [0.5, 0.25, 0.125]
    seeds = {asked.orders(tmp_path, lambda _: False)[0].scenario_seed for asked in filled}
    assert len(seeds) == 3


@pytest.mark.slow
def test_a_round_that_was_begun_with_other_artifacts_is_not_gone_on_with(
    tmp_path: Path, artifacts: Artifacts, filled: list[Collection]
) -> None:
    dataset(tmp_path / "collect", drive("d1-00000", frames=20, driver="policy:0123456789ab"))
    with pytest.raises(TrainError, match="the same artifacts"):
        collection.run_round(_job(tmp_path), artifacts.directory, 1)
    assert not filled


@pytest.mark.slow
def test_new_drives_of_the_expert_come_with_a_round_in_layouts_of_their_own(
    tmp_path: Path, artifacts: Artifacts, filled: list[Collection]
) -> None:
    job = _job(tmp_path, expert_episodes=7)
    result = collection.run_round(job, artifacts.directory, 1)
    shown, driven = filled
    assert (shown.prefix, shown.count, shown.policy) == ("n1-", 7, None) and driven.policy is not None
    assert result["expert"]["drives"] == 0
    collection.run_round(job, artifacts.directory, 2)
    assert len({asked.orders(tmp_path, lambda _: False)[0].scenario_seed for asked in filled}) == 4


@pytest.mark.parametrize(("newest_only", "seen"), [(True, ("d2-0", "n2-0")), (False, ("d1-0", "d2-0", "e0", "n2-0"))])
def test_training_after_a_round_uses_all_drives_or_the_newest_rounds(
    tmp_path: Path, newest_only: bool, seen: tuple[str, ...]
) -> None:
    job = _job(tmp_path, newest_only=newest_only)
    for number in (0, 1):
        job.run_dir.finish(f"sft-{number}", {})
    dataset(tmp_path / "collect", *(drive(name, frames=20) for name in ("e0", "d1-0", "d2-0", "n2-0")))
    assert drives_after(job.run_dir, job.recipe, "sft").ids == seen
    assert len(drives_after(job.run_dir, job.recipe, "imitate").ids) == 4  # no round has come before it


def test_a_round_without_drives_is_not_learned_from(tmp_path: Path) -> None:
    job = _job(tmp_path, newest_only=True)
    job.run_dir.finish("sft-0", {})
    dataset(tmp_path / "collect", drive("e0", frames=20))
    with pytest.raises(TrainError, match="d1- or n1-"):
        drives_after(job.run_dir, job.recipe, "sft")
