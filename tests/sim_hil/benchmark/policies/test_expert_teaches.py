"""The expert as a teacher: it keeps to the way that its pupil is told, at a pupil's speed, and further from people."""

from __future__ import annotations

import numpy as np
import pytest

from sim_hil.benchmark.env.world import EpisodeWorld
from sim_hil.benchmark.policies.expert import ExpertPolicy
from sim_hil.benchmark.policies.expert_motion import STEPS
from sim_hil.benchmark.policies.expert_route import RoutePlanner
from sim_hil.scene.scene import Vec2
from tests.support.benchmark.benchmark_episodes import block, corridor_episode, hall

NOBODY = np.zeros((0, 2))
START, GOAL = (-8.0, 0.0), (8.0, 0.0)
ROUND_THE_LEFT: tuple[Vec2, ...] = (START, (-1.0, 3.6), (1.0, 3.6), GOAL)
# Of the two ways round it the right one is shorter.
BLOCKED = hall(block(0.0, 0.8, 1.0, 4.0))
NARROW = hall(block(0.0, 0.0, 1.0, 1.0))


def _route(told: tuple[Vec2, ...]) -> np.ndarray:
    return RoutePlanner(BLOCKED, GOAL, 0.3, 0.05, told=told).route(START, NOBODY, 20.0)


def test_without_a_told_way_it_takes_the_shorter_one() -> None:
    assert _route(())[:, 1].min() < -1.2


def test_it_keeps_to_the_told_way_where_another_is_shorter() -> None:
    route = _route(ROUND_THE_LEFT)
    assert route[:, 1].max() > 2.8 and route[:, 1].min() > -1.0
    assert np.hypot(*(route[-1] - np.array(GOAL))) < 0.2


def test_a_told_way_that_is_the_shorter_one_changes_nothing_much() -> None:
    told = (START, (-1.0, -1.8), (1.0, -1.8), GOAL)
    assert len(_route(told)) == pytest.approx(len(_route(())), abs=3)


def test_it_drives_at_the_speed_it_is_given_and_tells_what_it_chose() -> None:
    episode = corridor_episode(robot="carter", timeout_s=2.5)
    teacher = ExpertPolicy(margin_m=0.1, speed_mps=0.5)
    with EpisodeWorld(episode) as world:
        teacher.reset(episode, "Go.", world, 0)
        commands = []
        while not world.done:
            commands.append(teacher.act(world.observe()))
            world.step(commands[-1])
        choice = teacher.choice
    assert choice is not None and choice.future.shape == (STEPS, 2) and choice.headings_rad.shape == (STEPS,)
    assert max(vx for vx, _, _ in commands) == pytest.approx(0.5, abs=0.01)
    # Where it drives is where it looks.
    ways = np.diff(choice.future, axis=0)
    assert np.allclose(np.arctan2(ways[:, 1], ways[:, 0]), choice.headings_rad[1:], atol=0.05)


@pytest.mark.slow
def test_it_keeps_further_from_walls_and_things_if_it_is_to() -> None:
    episode = corridor_episode(robot="carter", start=(*START, 0.0), goal_xy=GOAL, timeout_s=60.0, shortest_m=16.0)

    def least_m(wall_m: float) -> float:
        teacher, gaps = ExpertPolicy(speed_mps=0.8, wall_m=wall_m), []
        with EpisodeWorld(episode, scene=NARROW) as world:
            teacher.reset(episode, "Go.", world, 0)
            while not world.done:
                world.step(teacher.act(world.observe()))
                x, y = world.pose().x_m, world.pose().y_m
                gaps += [abs(y) - 0.5] if abs(x) < 0.5 else []
            assert world.end == "reached"
        return min(gaps)

    assert least_m(0.15) > least_m(0.0) + 0.05
