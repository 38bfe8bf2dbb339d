"""A drive is recorded at 10 Hz with what the expert did or would have done, up to where there is nothing to learn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from edge.core.geometry import SE2
from sim_hil.benchmark.env.observation import Observation
from sim_hil.benchmark.env.world import EpisodeWorld
from sim_hil.benchmark.policies.expert import ExpertPolicy
from sim_hil.scene.scene import Vec2, load_scene
from tests.support.benchmark.benchmark_episodes import corridor_episode
from tools.train.collect.record import (
    CameraSettings,
    DrivePlan,
    NothingToLearnError,
    Recorded,
    Rescue,
    Steer,
    is_hopeless,
    kept_frames,
    record,
)
from tools.train.collect.steering import Detour, Velocity
from tools.train.drives.drive import EXPERT, FUTURE_STEPS, NOISE, POLICY
from tools.train.drives.futures import relative

WAY = np.array(((0.0, 0.0), (6.0, 0.0)))


def _expert_command(_: Observation, wanted: Velocity) -> tuple[Velocity, int]:
    return wanted, EXPERT


def _still(_: Observation, wanted: Velocity) -> tuple[Velocity, int]:
    return (0.0, 0.0, 0.0), POLICY


def _tell(world: EpisodeWorld, chosen: NDArray[np.float64], plan_xy: Sequence[Vec2]) -> Mapping[str, Any]:
    return {"at": round(world.time_s, 1), "ahead_m": float(chosen[29, 0])}


def _drive(
    steer: Steer, way: NDArray[np.float64] = WAY, camera: CameraSettings | None = None, linger_s: float = 0.0,
    detour: Detour | None = None, legs: bool = True, **changes: Any,
) -> Recorded:  # fmt: skip
    """Along the corridor; a policy's drive where `steer` is not the expert."""
    episode = corridor_episode(robot="carter", **changes)
    policy_drives = steer is not _expert_command
    plan = DrivePlan(
        episode, load_scene("corridor"), way, camera or CameraSettings(), "none", policy_drives=policy_drives,
        linger_s=linger_s, detour=detour, legs=legs,
    )  # fmt: skip
    return record(plan, ExpertPolicy(speed_mps=0.8, rests=True), steer, _tell)


@pytest.fixture(scope="module")
def reached() -> Recorded:
    return _drive(_expert_command)


@pytest.fixture(scope="module")
def standing() -> Recorded:
    """A policy that does not move, for 4 s, seen through a camera of twice the size."""
    return _drive(_still, camera=CameraSettings(256, 80), timeout_s=4.0)


# -- the expert's drives ----------------------------------------------------------------------------------------------


def test_it_is_recorded_up_to_the_goal(reached: Recorded) -> None:
    pose = reached.arrays["pose"]
    assert reached.outcome == "reached" and not reached.collided
    assert pose[0, 0] == pytest.approx(0.0, abs=0.1) and 4.3 < pose[-1, 0] < 4.6


def test_the_label_of_a_frame_is_where_it_really_was_later(reached: Recorded) -> None:
    pose, future = reached.arrays["pose"], reached.arrays["future"]
    for k in (0, 5, len(pose) - 60):
        assert np.allclose(future[k], relative(pose[k], pose[k + 1 : k + 51]), atol=1e-5)


def test_at_the_goal_the_label_goes_on_to_it_and_stands_there(reached: Recorded) -> None:
    pose, future = reached.arrays["pose"], reached.arrays["future"]
    ends = pose[-1, 0] + future[-1, :, 0]
    assert np.all(reached.arrays["future_steps"] == FUTURE_STEPS)
    assert 5.4 < ends[-1] < 6.2 and np.allclose(future[-1, -10:], future[-1, -1])


def test_the_state_is_the_velocity_up_to_the_frame_and_not_after_it(reached: Recorded) -> None:
    pose, state = reached.arrays["pose"], reached.arrays["state"]
    moved = np.array([relative(pose[k - 1], pose[k])[0] * 10 for k in range(1, len(pose))])
    assert np.allclose(state[1:], moved, atol=0.03) and np.allclose(state[0], 0.0)


def test_traces_are_recorded_once_a_second_in_order(reached: Recorded) -> None:
    times = [trace["at"] for trace in reached.traces]
    assert times == [float(second) for second in range(len(times))]
    assert len(times) == (len(reached.arrays["pose"]) - 1) // 10 + 1


@pytest.mark.slow
def test_a_drive_of_a_body_without_wheels_is_as_long_and_as_fast(reached: Recorded) -> None:
    glided = _drive(_expert_command, legs=False)
    assert glided.outcome == "reached" and not glided.collided
    assert len(glided.arrays["pose"]) == pytest.approx(len(reached.arrays["pose"]), abs=3)
    assert np.allclose(glided.arrays["state"][20:40], reached.arrays["state"][20:40], atol=0.03)


@pytest.mark.slow
def test_a_drive_off_the_described_route_is_rejected() -> None:
    with pytest.raises(NothingToLearnError, match="left the described route"):
        _drive(_expert_command, way=np.array(((0.0, 9.0), (6.0, 9.0))), timeout_s=4.0)


@pytest.mark.slow
def test_a_short_drive_is_not_kept() -> None:
    with pytest.raises(NothingToLearnError, match="less than 3 s are usable"):
        _drive(_expert_command, timeout_s=1.0)


# -- a policy's drives ------------------------------------------------------------------------------------------------


def test_where_a_policy_drives_the_label_is_the_experts_plan(standing: Recorded) -> None:
    assert standing.outcome == "timeout" and len(standing.arrays["pose"]) == 40
    assert np.all(standing.arrays["by"] == POLICY)
    assert np.ptp(standing.arrays["pose"][:, 0]) < 0.05
    assert np.all(standing.arrays["future"][10:, 29, 0] > 1.5)


def _poses(x: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack((x, 0 * x, 0 * x), axis=1)


def _plan(*, policy_drives: bool) -> DrivePlan:
    return DrivePlan(
        corridor_episode(), load_scene("corridor"), WAY, CameraSettings(), "none", policy_drives=policy_drives
    )


def test_a_policy_that_waits_for_less_or_creeps_is_not_hopeless() -> None:
    plan = _plan(policy_drives=True)
    assert not is_hopeless(_poses(np.zeros(150)), plan)
    assert not is_hopeless(_poses(np.arange(200) * 0.004), plan)
    assert is_hopeless(_poses(np.arange(200) * 0.003), plan)


def test_a_policy_twenty_metres_off_the_route_is_hopeless_at_once() -> None:
    assert not is_hopeless(np.array(((3.0, 19.9, 0.0),)), _plan(policy_drives=True))
    assert is_hopeless(np.array(((3.0, 20.1, 0.0),)), _plan(policy_drives=True))


def test_the_expert_drives_a_policys_robot_back_from_six_metres_off_the_route_until_it_is_within_one() -> None:
    off_m = (0.0, 5.9, 6.1, 2.0, 1.1, 0.9, 5.9)
    policys, experts = Rescue(_plan(policy_drives=True)), Rescue(_plan(policy_drives=False))
    assert [policys.is_needed(SE2(3.0, y, 0.0)) for y in off_m] == [False, False, True, True, True, False, False]
    assert not any(experts.is_needed(SE2(3.0, y, 0.0)) for y in off_m)


# -- what is kept -----------------------------------------------------------------------------------------------------

WALK = _poses(np.arange(100) * 0.08)


def test_the_two_seconds_before_a_fall_or_a_collision_are_not_kept() -> None:
    assert kept_frames(WALK, "fell", None) == 80
    assert kept_frames(WALK, "reached", 60) == 40
    assert kept_frames(WALK, "reached", 5) == 0


def test_of_a_timeout_the_waiting_at_its_end_is_not_kept() -> None:
    waited = np.vstack((WALK, np.repeat(WALK[-1:], 200, axis=0)))
    for outcome in ("timeout", "cut"):
        assert kept_frames(waited, outcome, None) == pytest.approx(104, abs=2)


def test_a_policys_collisions_are_kept_and_its_falls_are_not() -> None:
    assert kept_frames(WALK, "reached", 60, policy_drives=True) == 100
    assert kept_frames(WALK, "fell", 60, policy_drives=True) == 80


# -- what is drawn ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_drive_that_lingers_comes_to_rest_at_the_goal_and_labels_every_frame_so() -> None:
    lingering = _drive(_expert_command, linger_s=6.0)
    pose = lingering.arrays["pose"]
    assert lingering.outcome == "reached"
    assert np.max(np.abs(pose[-10:] - pose[-1])) < 0.05
    assert np.max(np.hypot(*lingering.arrays["plan_xy"][-1].T)) < 0.4
    assert np.max(np.hypot(*lingering.arrays["future"][-10, :, :2].T)) < 0.3


@pytest.mark.slow
def test_on_a_detour_the_label_leads_back_to_the_route() -> None:
    aside = _drive(_expert_command, detour=Detour((1.3, 0.5), 3.5, 1.0), timeout_s=60.0)
    by, pose = aside.arrays["by"], aside.arrays["pose"]
    assert aside.outcome == "reached" and set(by) == {EXPERT, NOISE}
    last = int(np.flatnonzero(by == NOISE)[-1])
    assert np.all(pose[last:, 0] > 1.0) and abs(pose[last, 2]) > 2.0  # it looks back to where it came from
    there = SE2(*map(float, pose[last])) @ SE2(*map(float, aside.arrays["future"][last, -1]))
    assert there.x_m > pose[last, 0] + 0.3


@pytest.mark.slow
def test_where_there_is_no_way_to_it_there_is_no_detour() -> None:
    assert set(_drive(_expert_command, detour=Detour((500.0, 0.0), 1.0, 1.0)).arrays["by"]) == {EXPERT}
