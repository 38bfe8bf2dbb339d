"""Baselines: what each may know, and how it drives."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest

from edge.core.geometry import SE2
from sim_hil.benchmark.conditions.conditions import BASELINES
from sim_hil.benchmark.env.observation import Observation
from sim_hil.benchmark.env.world import EpisodeWorld
from sim_hil.benchmark.policies.baselines import PointGoalPolicy, RandomPolicy, StillPolicy, make_baseline
from sim_hil.benchmark.policies.policy import Policy
from tests.support.benchmark.benchmark_episodes import block, corridor_episode, hall


def seen(x: float = 0.0, y: float = 0.0, theta: float = 0.0, *, touching: bool = False) -> Observation:
    return Observation(0.0, None, (0.0, 0.0, 0.0), SE2(x, y, theta), False, touching)


def velocities(policy: Policy, seed: int, count: int = 600) -> np.ndarray:
    policy.reset(corridor_episode(), "Go.", None, seed)
    return np.array([policy.act(seen()) for _ in range(count)])


@pytest.mark.parametrize("name", BASELINES)
def test_every_baseline_is_made_by_its_name(name: str) -> None:
    policy = make_baseline(name)
    assert policy.name == name and not policy.needs_image
    assert policy.privileged == (name == "expert")
    policy.close()
    policy.close()


def test_an_unknown_baseline_is_refused_by_naming_the_known_ones() -> None:
    with pytest.raises(ValueError, match="expert, point-goal, random, still"):
        make_baseline("brave")


def test_still_never_moves() -> None:
    assert not velocities(StillPolicy(), 1).any()


def test_a_random_walk_is_smooth_keeps_its_limits_and_never_backs() -> None:
    walk = velocities(RandomPolicy(), 1)
    assert np.abs(np.diff(walk, axis=0)).max() < 0.8
    assert walk[:, 0].min() >= 0.0 and walk[:, 0].max() <= 1.0 and np.abs(walk[:, 2]).max() <= 1.0
    assert 0.3 < walk[:, 0].mean() < 0.7 and np.abs(walk[:, 2]).mean() > 0.1


def test_a_random_walk_is_its_seeds() -> None:
    assert np.array_equal(velocities(RandomPolicy(), 1), velocities(RandomPolicy(), 1))
    assert not np.array_equal(velocities(RandomPolicy(), 1), velocities(RandomPolicy(), 2))


def test_point_goal_knows_the_goal_by_odometry_from_a_turned_start() -> None:
    policy = PointGoalPolicy()
    policy.reset(corridor_episode(start=(1.0, 0.0, pi / 2), goal_xy=(1.0, 5.0)), "Go.", None, 0)
    vx, vy, wz = policy.act(seen())
    assert (vx, vy) == (pytest.approx(0.8), 0.0) and abs(wz) < 1e-9
    assert policy.notes()["waypoints"] == [pytest.approx([5.0, 0.0])]


def test_point_goal_stops_while_it_touches_something() -> None:
    policy = PointGoalPolicy()
    policy.reset(corridor_episode(), "Go.", None, 0)
    assert policy.act(seen())[0] > 0.5 and policy.act(seen(touching=True))[0] == 0.0


@pytest.mark.slow
def test_point_goal_reaches_a_goal_in_the_open_and_hits_what_stands_between() -> None:
    episode = corridor_episode(start=(-8.0, 0.0, 0.0), goal_xy=(-3.0, 1.5))
    for things, success in (((), True), ((block(-5.5, 0.7, 0.5, 1.5),), False)):
        policy = PointGoalPolicy()
        with EpisodeWorld(episode, scene=hall(*things)) as world:
            policy.reset(episode, "Go.", None, 0)
            while not world.done:
                world.step(policy.act(world.observe()))
            assert world.outcome().success is success
            assert world.outcome().collided is not success
