"""What plans are measured by: the expert's, beside plans that need no policy, told apart by the age of the state."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.support.train.train_drives import MadeUpTokens, tiny_model
from tests.support.train.train_imitate_rank import SideStates, side_dataset
from tools.train.config.imitate import DelayConfig, ImitateEvalConfig, SampleConfig
from tools.train.drives.drive import Dataset
from tools.train.imitate.data import Delays, Samples
from tools.train.imitate.evaluation import evaluate, keep_state, to_waypoints
from tools.train.samples.action_batch import ActionBatch
from tools.train.samples.drive_frames import DriveFrames

CPU = torch.device("cpu")
FEW = ImitateEvalConfig(samples=96, batch=16)


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> Samples:
    dataset: Dataset = side_dataset(tmp_path_factory.mktemp("collect"))
    plain = SampleConfig().undisturbed()
    drives = [DriveFrames.of(drive, 30, plain.weights) for drive in dataset.drives(dataset.val, pictures=False)]
    delays = Delays.uniform(DelayConfig())
    return Samples(drives, MadeUpTokens(), SideStates(dataset), delays, plain, tiny_model(), drop=False)


@pytest.mark.slow
def test_keeping_the_state_is_driving_on_along_its_arc() -> None:
    plans = keep_state(np.array([(0.5, 0.0, 0.0), (0.4, 0.0, 0.2), (0.0, 0.3, 0.5), (0.0, 0.0, 0.0)]), 50)
    np.testing.assert_allclose(plans[0, 19], (1.0, 0.0, 0.0), atol=1e-12)
    # Radius 2 m: after 5 s it has turned by one radian.
    np.testing.assert_allclose(plans[1, 49], (2 * np.sin(1.0), 2 * (1 - np.cos(1.0)), 1.0))
    pose = np.zeros(3)
    for _ in range(50_000):
        pose += np.array((-0.3 * np.sin(pose[2]), 0.3 * np.cos(pose[2]), 0.5)) * 1e-4
    np.testing.assert_allclose(plans[2, 49], pose, atol=1e-3)
    assert not plans[3].any()


def test_driving_to_waypoints_arrives_at_their_times() -> None:
    points = np.array([(-0.5, 0.0), (1.0, 1.0), (1.0, 4.0)])
    plan = to_waypoints(points, 4.0, 50)
    # The first one's time, 3 s, is over; the second is to be reached in 2 s, the third in 5 s.
    np.testing.assert_allclose(plan[19, :2], (1.0, 1.0), atol=1e-9)
    np.testing.assert_allclose(plan[49, :2], (1.0, 4.0), atol=1e-9)
    np.testing.assert_allclose(plan[4], (0.25, 0.25, np.pi / 4), atol=1e-9)
    assert plan[30, 2] == pytest.approx(np.pi / 2)
    assert not to_waypoints(points, 9.5, 20).any()
    np.testing.assert_allclose(to_waypoints(points, 8.0, 20)[9:, :2], [(1.0, 4.0)] * 11, atol=1e-9)


@pytest.mark.slow
def test_a_policy_that_plans_as_the_expert_does_makes_no_error(samples: Samples) -> None:
    result = evaluate(lambda batch: batch.target, samples, FEW, seed=1, device=CPU)
    policy = result["all"]["policy"]
    assert policy["samples"] == result["samples"] == 96
    assert policy["ade_m"] == {"1s": 0.0, "2s": 0.0, "3s": 0.0} and policy["fde_m"]["3s"] == 0.0
    assert policy["speed_mps"] == 0.0 and policy["yaw_rate_radps"] == 0.0
    kept, straight = result["all"]["keep_state"], result["all"]["waypoints"]
    assert kept["fde_m"]["3s"] > 0.05 and straight["fde_m"]["3s"] > 0.01


@pytest.mark.slow
def test_errors_are_listed_by_age_and_add_up(samples: Samples) -> None:
    result = evaluate(lambda batch: batch.target, samples, FEW, seed=1, device=CPU)
    bins = result["by_delay"]
    assert [(each["from_s"], each["to_s"]) for each in bins] == [(0, 1), (1, 2), (2, 3), (3, 5), (5, 7), (7, 10)]
    assert sum(each["policy"]["samples"] for each in bins) == 96

    seen: list[float] = []

    def listening(batch: ActionBatch) -> torch.Tensor:
        seen.extend(batch.latency[:, 0].tolist())
        return batch.target

    again = evaluate(listening, samples, FEW, seed=1, device=CPU, semantics=False)
    for each in again["by_delay"]:
        last = each["to_s"] == 10
        count = sum(each["from_s"] <= age + 1e-6 < each["to_s"] or (last and age > 9.99) for age in seen)
        assert each["policy"]["samples"] == count


def test_another_drives_states_increase_the_error(samples: Samples) -> None:
    def by_words(batch: ActionBatch) -> torch.Tensor:
        """Drives to the side that the text names; its own drives always have the right text."""
        side = torch.sign(batch.guidance[:, -1, 0]).repeat_interleave(len(batch) // len(batch.guidance))
        true = batch.target.clone()
        true[..., 1:] = true[..., 1:].abs() * side[:, None, None]
        return true

    result = evaluate(by_words, samples, FEW, seed=1, device=CPU)
    assert result["all"]["policy"]["fde_m"]["3s"] == pytest.approx(0.0, abs=1e-6)
    assert result["all"]["other_words"]["fde_m"]["3s"] > 0.05
