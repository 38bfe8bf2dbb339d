"""The privileged expert: gets there with room to spare round things and people, smoothly, and can say where it goes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import cos, hypot, radians, sin

import numpy as np
import pytest

from sim_hil.benchmark.env.metrics import Outcome
from sim_hil.benchmark.env.world import EpisodeWorld
from sim_hil.benchmark.policies.expert import ExpertPolicy
from sim_hil.benchmark.policies.expert_motion import STEPS, Driving, Motion
from sim_hil.benchmark.policies.expert_route import SPACING_M, PlannerGround, RoutePlanner
from sim_hil.scene.nav_grid import NavGrid
from sim_hil.scene.scene import Scene, Vec2
from tests.support.benchmark.benchmark_episodes import block, corridor_episode, hall

NOBODY = np.zeros((0, 2))
WAY = np.stack((np.arange(0.0, 8.0, SPACING_M), np.zeros(80)), axis=1)


@dataclass(frozen=True)
class Drive:
    """What an episode left behind."""

    outcome: Outcome
    commands: np.ndarray
    plans: list[list[tuple[float, float]]]
    poses: np.ndarray


def driven(scene: Scene | None = None, **changes: object) -> Drive:
    episode, policy, commands, plans, poses = corridor_episode(**changes), ExpertPolicy(), [], [], []
    with EpisodeWorld(episode, scene=scene) as world:
        policy.reset(episode, "Go.", world, 0)
        while not world.done:
            commands.append(policy.act(world.observe()))
            plans.append(policy.plan())
            poses.append(world.pose().as_tuple())
            world.step(commands[-1])
        return Drive(world.outcome(), np.array(commands), plans, np.array(poses))


@pytest.fixture(scope="module")
def round_a_wall() -> Drive:
    """A way that is barred in the middle of the hall."""
    return driven(hall(block(0.0, -1.5, 0.4, 6.0)), start=(-4.0, 0.0, 0.0), goal_xy=(4.0, 0.0), shortest_m=9.3)


@pytest.fixture(scope="module")
def crowded() -> Iterator[Drive]:
    """The corridor with people coming and going."""
    yield driven(people=6, seed=1, goal_xy=(12.0, 0.0), timeout_s=60.0, shortest_m=12.0)


@pytest.mark.slow
def test_it_goes_round_what_bars_the_way_without_touching_it(round_a_wall: Drive) -> None:
    assert round_a_wall.outcome.success and not round_a_wall.outcome.collided
    assert round_a_wall.outcome.spl > 0.9


@pytest.mark.slow
def test_it_reaches_its_goal_among_people_without_coming_near_them(crowded: Drive) -> None:
    assert crowded.outcome.success and not crowded.outcome.collided


def test_it_drives_smoothly_and_within_comfortable_limits(round_a_wall: Drive) -> None:
    commands, driving = round_a_wall.commands, Driving()
    assert np.all(commands[:, 1] == 0.0)
    assert commands[:, 0].max() <= driving.speed_mps and np.abs(commands[:, 2]).max() <= driving.turn_radps
    assert np.diff(commands[:, 0]).max() <= driving.accel_mps2 * 0.1 + 1e-9
    assert np.abs(np.diff(commands[:, 2])).max() <= driving.turn_accel_radps2 * 0.1 + 1e-9


def test_its_predicted_poses_are_its_poses(round_a_wall: Drive) -> None:
    errors = []
    for tick in range(10, len(round_a_wall.poses) - 30):
        x, y, heading = round_a_wall.poses[tick]
        ahead, left = round_a_wall.plans[tick][0]
        c, s = np.cos(heading), np.sin(heading)
        later = round_a_wall.poses[tick + 30]
        errors.append(hypot(x + c * ahead - s * left - later[0], y + s * ahead + c * left - later[1]))
    assert np.median(errors) < 0.5


@pytest.mark.slow
def test_the_same_episode_is_driven_alike(crowded: Drive) -> None:
    again = driven(people=6, seed=1, goal_xy=(12.0, 0.0), timeout_s=60.0, shortest_m=12.0)
    assert again.outcome.trajectory_sha256 == crowded.outcome.trajectory_sha256


def test_without_the_world_it_is_refused() -> None:
    with pytest.raises(ValueError, match="world"):
        ExpertPolicy().reset(corridor_episode(), "Go.", None, 0)


@pytest.mark.slow
def test_a_goal_without_a_way_to_it_is_refused() -> None:
    episode = corridor_episode(start=(-4.0, 0.0, 0.0), goal_xy=(4.0, 0.0))
    with (
        EpisodeWorld(episode, scene=hall(block(0.0, 0.0, 0.4, 10.0))) as world,
        pytest.raises(ValueError, match="no path"),
    ):
        ExpertPolicy().reset(episode, "Go.", world, 0)


def _turned_deg(route_deg: float, *, about_left: bool) -> float:
    """Return the largest rotation, degrees, of a robot in a hall whose route leads straight away at a bearing."""
    motion = Motion(ground(hall()).grid, Driving(), about_left=about_left)
    route = np.outer(np.arange(0.0, 6.0, SPACING_M), (cos(radians(route_deg)), sin(radians(route_deg))))
    at, heading, speed, turned = np.zeros(2), 0.0, 0.0, [0.0]
    while np.hypot(*at) < 1.0 and len(turned) < 100:
        nearest = int(np.argmin(np.hypot(*(route - at).T)))
        choice = motion.choose((*at, heading), speed, route[nearest:], NOBODY, NOBODY)
        heading, speed = heading + 0.1 * choice.wz_radps, choice.vx_mps
        at = at + 0.1 * speed * np.array((cos(heading), sin(heading)))
        turned.append(np.degrees(heading))
    return max(turned, key=abs)


@pytest.mark.parametrize("route_deg", [-175.0, -150.0, -120.0, 120.0, 175.0])
def test_a_teacher_turns_about_to_the_left_whichever_side_is_nearer(route_deg: float) -> None:
    assert _turned_deg(route_deg, about_left=True) > 100.0


def test_it_turns_to_the_right_up_to_there() -> None:
    assert _turned_deg(-100.0, about_left=True) < -80.0


def test_the_benchmarks_expert_turns_to_the_nearer_side() -> None:
    assert _turned_deg(-150.0, about_left=False) < -100.0


def ground(scene: Scene, clearance_m: float = 0.33, max_step_m: float = 0.06) -> PlannerGround:
    return PlannerGround(scene, NavGrid(scene, clearance_m=clearance_m, max_step_m=max_step_m))


def planner() -> RoutePlanner:
    # Two ways round a block in the middle, the lower one shorter.
    return RoutePlanner(ground(hall(block(0.0, 0.6, 1.0, 4.0))), (6.0, 0.0))


def test_a_route_is_evenly_spaced_keeps_its_room_and_leads_to_the_goal() -> None:
    plan = planner()
    route = plan.route((-6.0, 0.0), NOBODY, 20.0)
    steps = np.hypot(*np.diff(route, axis=0).T)
    assert np.all(steps < 1.5 * SPACING_M)
    assert plan.grid.clearances_at(route).min() > 0.3
    assert hypot(route[-1, 0] - 6.0, route[-1, 1]) < 0.2


def test_a_route_leads_round_people_in_the_shorter_path() -> None:
    free = planner().route((-6.0, 0.0), NOBODY, 20.0)
    barred = planner().route((-6.0, 0.0), np.array([(0.0, -2.0), (0.0, -2.8), (0.0, -3.6), (0.0, -4.4)]), 20.0)
    assert free[:, 1].min() < -1.4 and barred[:, 1].max() > 2.6


def test_a_way_begun_is_kept_until_another_is_clearly_better() -> None:
    plan = planner()
    upper = plan.route((-6.0, 0.0), np.array([(0.0, -2.0), (0.0, -3.0), (0.0, -4.0)]), 20.0)
    assert np.allclose(plan.route((-6.0, 0.0), NOBODY, 20.0, upper)[: len(upper)], upper)


def motion() -> Motion:
    return Motion(NavGrid(hall(), clearance_m=0.33), Driving())


def settled(people: np.ndarray, velocities: np.ndarray) -> tuple[float, float]:
    """What it commands after thinking for a second in the same place."""
    moving, speed = motion(), 0.0
    for _ in range(10):
        choice = moving.choose((0.0, 0.0, 0.0), speed, WAY, people, velocities)
        speed = choice.vx_mps
    return choice.vx_mps, choice.shift_m


def test_on_a_free_way_it_speeds_up_to_the_comfortable_speed() -> None:
    assert settled(NOBODY, NOBODY) == (pytest.approx(1.0), 0.0)


@pytest.mark.parametrize("side", [0.25, -0.25])
def test_a_person_in_the_path_is_passed_on_the_freer_side(side: float) -> None:
    _, shift = settled(np.array([(2.5, side)]), np.zeros((1, 2)))
    assert np.sign(shift) == -np.sign(side)


def test_a_crossing_person_goes_first() -> None:
    crossing = settled(np.array([(1.3, 1.6)]), np.array([(0.0, -1.0)]))
    assert crossing[0] < 0.8


def test_a_person_right_ahead_is_not_driven_into() -> None:
    speed, _ = settled(np.array([(0.8, 0.0)]), np.zeros((1, 2)))
    assert speed <= 0.3


def test_where_people_take_the_goal_up_being_near_it_is_enough() -> None:
    around = np.array([(6.0, 0.0), (6.0, 0.9), (6.0, -0.9)])
    exact, near = (RoutePlanner(ground(hall()), (6.0, 0.0), near_m) for near_m in (0.0, 1.2))
    assert np.allclose(exact.route((0.0, 0.0), around, 20.0)[-1], (6.0, 0.0), atol=0.15)
    end = near.route((0.0, 0.0), around, 20.0)[-1]
    assert 0.5 < hypot(end[0] - 6.0, end[1]) < 1.25
    assert np.allclose(near.route((0.0, 0.0), NOBODY, 20.0)[-1], (6.0, 0.0), atol=0.15)


# The expert as a teacher

START, GOAL = (-8.0, 0.0), (8.0, 0.0)
ROUND_THE_LEFT: tuple[Vec2, ...] = (START, (-1.0, 3.6), (1.0, 3.6), GOAL)
# Of the two ways round it the right one is shorter.
BLOCKED = hall(block(0.0, 0.8, 1.0, 4.0))
NARROW = hall(block(0.0, 0.0, 1.0, 1.0))


def _prescribed(points: tuple[Vec2, ...]) -> np.ndarray:
    return RoutePlanner(ground(BLOCKED, 0.3, 0.05), GOAL, prescribed=points).route(START, NOBODY, 20.0)


def test_without_a_prescribed_route_it_takes_the_shorter_one() -> None:
    assert _prescribed(())[:, 1].min() < -1.2


def test_it_keeps_to_the_prescribed_route_where_another_is_shorter() -> None:
    route = _prescribed(ROUND_THE_LEFT)
    assert route[:, 1].max() > 2.8 and route[:, 1].min() > -1.0
    assert np.hypot(*(route[-1] - np.array(GOAL))) < 0.2


@pytest.mark.slow
def test_it_drives_at_the_speed_it_is_given_and_reports_its_choice() -> None:
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
