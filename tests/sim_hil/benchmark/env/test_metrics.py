"""The paper's equations 5 to 10, on trajectories whose answer can be worked out by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sim_hil.benchmark.env.gym_env import RewardWeights, reward
from sim_hil.benchmark.env.metrics import (
    Outcome,
    is_success,
    measure,
    navigation_error_m,
    path_length_m,
    spl,
    trajectory_sha256,
)
from tests.support.benchmark.benchmark_episodes import corridor_episode

TRAJECTORY = np.array([(0.0, 0.0, 0.0), (3.0, 4.0, 0.1), (3.0, 5.0, 0.2), (5.0, 5.0, 0.0)])


def outcome(trajectory: np.ndarray = TRAJECTORY, collisions: tuple[str, ...] = ()) -> Outcome:
    episode = corridor_episode(goal_xy=(6.0, 5.0), shortest_m=6.4)
    return measure(
        episode, trajectory, end="reached", time_s=1.0, collisions=collisions, first_collision_s=None, fell=False
    )


def test_navigation_error_is_the_planar_distance_at_the_end() -> None:
    assert navigation_error_m((3.0, 4.0), (0.0, 0.0)) == 5.0
    assert outcome().ne_m == 1.0


@pytest.mark.parametrize(("x", "expected"), [(1.49, True), (1.5, False), (1.51, False)])
def test_success_is_being_nearer_than_the_threshold(x: float, expected: bool) -> None:
    assert is_success((x, 0.0), (0.0, 0.0), 1.5) is expected


def test_path_length_sums_every_step() -> None:
    assert path_length_m(TRAJECTORY[:, :2]) == pytest.approx(5.0 + 1.0 + 2.0)
    assert path_length_m(TRAJECTORY[:1, :2]) == 0.0


def test_spl_is_the_share_of_the_shortest_path_and_zero_without_success() -> None:
    assert spl(True, 6.0, 8.0) == 0.75
    assert spl(False, 6.0, 8.0) == 0.0
    assert outcome().spl == pytest.approx(6.4 / 8.0)


def test_a_path_cut_short_by_the_threshold_gains_nothing() -> None:
    assert spl(True, 6.0, 4.6) == 1.0


def test_spl_without_a_shortest_path_is_refused() -> None:
    with pytest.raises(ValueError, match="shortest"):
        spl(True, 0.0, 1.0)


def test_one_collision_makes_an_episode_one_with_a_collision() -> None:
    assert outcome(collisions=("person",)).collided and not outcome().collided


def test_a_trajectorys_hash_tells_the_smallest_difference() -> None:
    moved = TRAJECTORY.copy()
    moved[2, 1] = np.nextafter(moved[2, 1], 9.0)
    assert trajectory_sha256(TRAJECTORY) == trajectory_sha256(TRAJECTORY.copy())
    assert trajectory_sha256(TRAJECTORY) != trajectory_sha256(moved)


def test_an_unknown_end_is_refused() -> None:
    with pytest.raises(ValueError, match="end"):
        replace(outcome(), end="bored")


def step(**changes: object) -> float:
    plain: dict[str, object] = {
        "reached": False,
        "distance_before_m": 5.0,
        "distance_after_m": 5.0,
        "collision_began": False,
        "speed_mps": 1.0,
    }
    return reward(**{**plain, **changes})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({}, 0.0),
        ({"reached": True}, 400.0),
        ({"distance_after_m": 4.9}, 0.5),
        ({"distance_after_m": 5.1}, -0.5),
        ({"collision_began": True}, -100.0),
        ({"speed_mps": 0.0}, -0.1),
        ({"speed_mps": 1.5}, -0.05),
    ],
)
def test_each_term_of_the_reward_counts_by_its_weight(change: dict[str, object], expected: float) -> None:
    assert step(**change) == pytest.approx(expected)


def test_a_weight_that_is_not_finite_is_refused() -> None:
    with pytest.raises(ValueError, match="finite"):
        RewardWeights(goal=float("nan"))
