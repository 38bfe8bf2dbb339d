"""An episode's world: control at 10 Hz over 30 Hz frames, odometry apart from truth, collisions, ends, determinism."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from math import hypot, pi

import numpy as np
import pytest

from edge.core.geometry import SE2
from sim_hil.benchmark.env.observation import Odometer
from sim_hil.benchmark.env.world import EpisodeWorld, WorldOptions
from tests.support.benchmark.benchmark_episodes import block, corridor_episode, hall

FORWARD = (0.8, 0.0, 0.0)


def drive(world: EpisodeWorld, velocity: tuple[float, float, float], steps: int) -> None:
    for _ in range(steps):
        if not world.done:
            world.step(velocity)


@pytest.fixture(scope="module")
def reached() -> Iterator[EpisodeWorld]:
    """An episode that was driven straight to its goal."""
    with EpisodeWorld(corridor_episode()) as world:
        drive(world, FORWARD, 200)
        yield world


@pytest.mark.slow
def test_the_robot_begins_at_the_episodes_start_ready_to_move() -> None:
    with EpisodeWorld(corridor_episode(start=(2.0, 0.3, 0.5))) as world:
        pose = world.pose()
        assert hypot(pose.x_m - 2.0, pose.y_m - 0.3) < 0.1 and abs(pose.theta_rad - 0.5) < 0.1
        assert world.robot.ready and world.time_s == 0.0 and not world.done
        assert world.observe().state == (0.0, 0.0, 0.0) and world.observe().T_odom_base == SE2(0.0, 0.0, 0.0)


@pytest.mark.slow
def test_one_step_is_three_frames_of_a_thirtieth_of_a_second() -> None:
    with EpisodeWorld(corridor_episode()) as world:
        world.step(FORWARD)
        assert world.time_s == pytest.approx(0.1)
        assert len(world.trajectory()) == 4


def test_the_episode_ends_in_the_frame_that_comes_within_the_threshold(reached: EpisodeWorld) -> None:
    outcome = reached.outcome()
    gaps = np.hypot(*(reached.trajectory()[:, :2] - (6.0, 0.0)).T)
    assert reached.end == "reached" and outcome.success
    assert gaps[-1] < 1.5 and np.all(gaps[:-1] >= 1.5)
    assert outcome.ne_m == pytest.approx(gaps[-1])


def test_an_episode_that_is_over_takes_no_further_step(reached: EpisodeWorld) -> None:
    with pytest.raises(RuntimeError, match="over"):
        reached.step(FORWARD)


@pytest.mark.slow
def test_a_policy_may_linger_at_the_goal() -> None:
    with EpisodeWorld(corridor_episode(robot="carter"), WorldOptions(linger_s=1.0)) as world:
        drive(world, FORWARD, 200)
        gaps = np.hypot(*(world.trajectory()[:, :2] - (6.0, 0.0)).T)
        assert world.end == "reached"
        assert int(np.argmax(gaps < 1.5)) == len(gaps) - 1 - 30


def test_path_and_time_are_those_driven(reached: EpisodeWorld) -> None:
    outcome = reached.outcome()
    assert 4.4 < outcome.path_m < 5.2
    assert outcome.time_s == pytest.approx((len(reached.trajectory()) - 1) / 30)
    assert outcome.spl == 1.0 and not outcome.collided and outcome.first_collision_s is None


def test_without_drift_odometry_equals_the_true_path(reached: EpisodeWorld) -> None:
    start = SE2(*reached.trajectory()[0])
    reported, true = reached.observe().T_odom_base, start.inverse() @ reached.pose()
    assert reported.as_tuple() == pytest.approx(true.as_tuple(), abs=1e-6)
    assert reached.observe().state[0] == pytest.approx(0.8, abs=0.15)


@pytest.mark.slow
def test_a_timeout_ends_the_episode_without_success() -> None:
    with EpisodeWorld(corridor_episode(timeout_s=0.5)) as world:
        drive(world, (0.0, 0.0, 0.0), 10)
        assert world.end == "timeout" and world.time_s == pytest.approx(0.5)
        assert not world.outcome().success and world.outcome().spl == 0.0


@pytest.mark.slow
def test_an_outcome_before_the_end_is_refused_unless_the_episode_is_stopped() -> None:
    with EpisodeWorld(corridor_episode()) as world:
        with pytest.raises(RuntimeError, match="not over"):
            world.outcome()
        world.stop()
        assert world.done and world.outcome().end == "stopped"


@pytest.mark.slow
def test_a_person_nearby_is_a_collision_hidden_from_the_robot() -> None:
    with EpisodeWorld(corridor_episode(), scene=hall()) as world:
        pose = world.pose()
        world._simulation._people = np.array([(pose.x_m, pose.y_m + 0.4, 0.0)])
        world.step((0.0, 0.0, 0.0))
        assert world.touching == {"person"} and world.collided
        assert not world.observe().touching and not world.observe().collided


@pytest.mark.slow
def test_driving_into_an_object_is_a_collision_with_it() -> None:
    scene, episode = hall(block(-6.5, 0.0, 0.5, 2.0)), corridor_episode(start=(-8.0, 0.0, 0.0), goal_xy=(8.0, 0.0))
    with EpisodeWorld(episode, scene=scene) as world:
        for _ in range(35):
            if not world.touching:
                world.step(FORWARD)
        assert world.observe().collided and world.observe().touching and "block -6.5 0.0" in world.touching
        world.stop()
        outcome = world.outcome()
        assert outcome.collisions == ("block -6.5 0.0",)
        assert outcome.first_collision_s is not None and 0.5 < outcome.first_collision_s < 3.0


@pytest.mark.slow
def test_the_touched_one_of_many_neighbouring_objects_is_identified() -> None:
    # Neighbours share a body in the physics engine.
    things = [block(-8.0 + 1.2 * k, side, 0.5, 0.5) for k in range(1, 9) for side in (-1.6, 1.6)]
    scene = hall(*things, block(-6.0, 0.0, 0.5, 1.0))
    episode = corridor_episode(start=(-8.0, 0.0, 0.0), goal_xy=(8.0, 0.0))
    with EpisodeWorld(episode, scene=scene) as world:
        drive(world, FORWARD, 35)
        world.stop()
        assert world.outcome().collisions == ("block -6.0 0.0",)


@pytest.mark.slow
@pytest.mark.parametrize("velocity", [(float("nan"), 0.0, 0.0), (0.1, 0.0, float("inf")), (0.1, 0.2)])
def test_a_velocity_that_is_none_is_refused(reached: EpisodeWorld, velocity: tuple[float, ...]) -> None:
    with EpisodeWorld(corridor_episode()) as world, pytest.raises(ValueError, match="velocities"):
        world.step(velocity)  # type: ignore[arg-type]


@pytest.mark.parametrize("options", [{"rate_hz": 500}, {"drift": "some"}, {"camera": (8, 8)}])
def test_options_that_make_no_world_are_refused(options: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="world"):
        WorldOptions(**options)  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_picture_has_the_requested_size_and_is_taken_once_an_observation() -> None:
    with EpisodeWorld(corridor_episode(), WorldOptions(camera=(64, 48))) as world:
        image = world.observe().image
        assert image is not None and image.shape == (48, 64, 3) and image.dtype == np.uint8 and image.std() > 5
        assert world.observe().image is image


def hash_of(**changes: object) -> str:
    with EpisodeWorld(corridor_episode(people=3, timeout_s=2.5, **changes), WorldOptions(drift="severe")) as world:
        while not world.done:
            world.step((0.6, 0.0, 0.4 * np.sin(world.time_s)))
        return world.outcome().trajectory_sha256


@pytest.mark.slow
def test_the_same_episode_gives_the_same_bytes_again_and_in_another_process() -> None:
    here = hash_of()
    program = "from tests.sim_hil.benchmark.env.test_benchmark_world import hash_of; print(hash_of())"
    there = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True, timeout=120)
    assert hash_of() == here
    assert there.stdout.split()[-1] == here


@pytest.mark.slow
def test_people_are_updated_at_thirty_hertz_with_the_reported_velocities() -> None:
    with EpisodeWorld(corridor_episode(people=4)) as world:
        drive(world, (0.0, 0.0, 0.0), 20)
        before = world.people()
        world.step((0.0, 0.0, 0.0))
        moved = (world.people() - before)[:, :2] / 0.1
        assert np.abs(moved - world.people_velocities()).max() < 0.4
        assert np.hypot(*world.people_velocities().T).max() > 0.3


def drift_after_ten_metres(level: str, seed: int) -> float:
    odometer, pose = Odometer(level, seed, SE2(0.0, 0.0, 0.0)), SE2(0.0, 0.0, 0.0)
    for _ in range(300):
        pose = pose @ SE2(1 / 30, 0.0, 0.0)
        odometer.step(pose, 1 / 30)
    return hypot(odometer.pose.x_m - pose.x_m, odometer.pose.y_m - pose.y_m)


@pytest.mark.slow
def test_drift_grows_with_its_level() -> None:
    typical, severe = (
        np.mean([drift_after_ten_metres(level, s) for s in range(20)]) for level in ("typical", "severe")
    )
    assert drift_after_ten_metres("none", 0) < 1e-9 < 0.1 < typical < severe < 5.0


def test_velocity_is_the_mean_in_the_body_frame_since_the_last_reading() -> None:
    # A quarter circle of radius 1 m in 1 s: pi/2 m/s forwards, nothing sideways.
    odometer, pose = Odometer("none", 0, SE2(0.0, 0.0, 0.0)), SE2(0.0, 0.0, 0.0)
    assert odometer.velocity() == (0.0, 0.0, 0.0)
    for _ in range(30):
        chord = 2 * np.sin(pi / 120)
        pose = pose @ SE2(chord * np.cos(pi / 120), chord * np.sin(pi / 120), pi / 60)
        odometer.step(pose, 1 / 30)
    assert odometer.velocity() == pytest.approx((pi / 2, 0.0, pi / 2), abs=1e-6)
