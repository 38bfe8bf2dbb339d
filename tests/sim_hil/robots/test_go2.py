"""The simulated Go2 under physics: modes, tracking of commands, stopping, staying up."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from math import pi
from pathlib import Path

import numpy as np
import pybullet
import pytest

from sim_hil.robots.go2.gait import BodyMotion
from sim_hil.robots.go2.sport import ERROR_NOT_STANDING, Measured, SportController, motor_torque
from sim_hil.robots.go2.urdf import TORQUE_LIMITS_NM, VELOCITY_LIMITS_RADPS, write_go2_urdf
from sim_hil.scene.scene import Scene, load_scene
from sim_hil.simulation.physics import Simulation, SimulationClosedError, SportAction


@pytest.fixture(scope="module")
def corridor() -> Scene:
    return load_scene("corridor")


@pytest.fixture
def open_floor(corridor: Scene) -> Scene:
    """A floor with nothing on it, to walk freely in any direction."""
    return replace(corridor, walls=(), objects=(), routes=(), floor_min_m=(-30.0, -30.0), floor_max_m=(30.0, 30.0))


@pytest.fixture
def simulation(open_floor: Scene) -> Iterator[Simulation]:
    simulation = Simulation(open_floor, people=0, seed=0)
    yield simulation
    simulation.close()


def _run(simulation: Simulation, seconds: float, command: tuple[float, float, float] | None = None) -> None:
    for index in range(round(seconds / Simulation.DT_S)):
        if command is not None and index % 50 == 0:
            simulation.command(*command)
        simulation.step()


def _stand(simulation: Simulation) -> None:
    simulation.sport(SportAction.STAND_UP)
    _run(simulation, 2.0)
    simulation.sport(SportAction.BALANCE_STAND)
    _run(simulation, 0.2)


@pytest.mark.slow
def test_a_lying_robot_stands_up_locked_and_only_then_balances(simulation: Simulation) -> None:
    _run(simulation, 0.5)
    truth = simulation.truth()
    assert truth.mode == 5 and truth.body_height_m < 0.12
    assert simulation.sport(SportAction.BALANCE_STAND) == ERROR_NOT_STANDING
    assert simulation.sport(SportAction.STAND_UP) == 0
    _run(simulation, 2.0)
    truth = simulation.truth()
    assert truth.mode == 6
    assert truth.body_height_m == pytest.approx(0.31, abs=0.02)
    assert simulation.sport(SportAction.BALANCE_STAND) == 0
    _run(simulation, 1.0)
    truth = simulation.truth()
    assert truth.mode == 1 and truth.gait_type == 0
    assert np.abs(truth.rpy_rad[:2]).max() < 0.02
    assert truth.foot_force_n.sum() == pytest.approx(15.2 * 9.81, rel=0.15)
    assert truth.accel_mps2 == pytest.approx((0, 0, 9.81), abs=0.4)


@pytest.mark.slow
@pytest.mark.parametrize("prepare", [(), (SportAction.STAND_UP,), (SportAction.DAMP,)])
def test_move_has_no_effect_unless_balanced(simulation: Simulation, prepare: tuple[SportAction, ...]) -> None:
    for action in prepare:
        simulation.sport(action)
    _run(simulation, 2.0)
    before = simulation.truth()
    _run(simulation, 1.0, (0.5, 0.0, 0.0))
    after = simulation.truth()
    assert after.mode == before.mode and after.commanded == (0, 0, 0)
    assert np.linalg.norm(after.position_m - before.position_m) < 0.01


@pytest.mark.slow
def test_positive_yaw_turns_left_and_positive_vy_walks_left(simulation: Simulation) -> None:
    _stand(simulation)
    _run(simulation, 1.5, (0.0, 0.2, 0.0))
    assert simulation.truth().position_m[1] > 0.1
    _run(simulation, 1.0, (0.0, 0.0, 0.5))
    assert simulation.truth().rpy_rad[2] > 0.2


@pytest.mark.slow
def test_a_move_is_held_one_second_and_then_the_robot_stands_still(simulation: Simulation) -> None:
    _stand(simulation)
    simulation.command(0.5, 0.0, 0.0)
    _run(simulation, 0.98)
    truth = simulation.truth()
    assert truth.commanded == (0.5, 0.0, 0.0) and truth.mode == 3 and truth.gait_type == 1
    _run(simulation, 0.04)
    assert simulation.truth().commanded == (0.0, 0.0, 0.0)
    _run(simulation, 2.5)
    rest = simulation.truth()
    assert rest.mode == 1
    _run(simulation, 1.0)
    assert np.linalg.norm(simulation.truth().position_m - rest.position_m) < 0.02


@pytest.mark.slow
def test_stop_move_takes_effect_at_once(simulation: Simulation) -> None:
    _stand(simulation)
    _run(simulation, 1.0, (0.5, 0.0, 0.0))
    assert simulation.sport(SportAction.STOP_MOVE) == 0
    assert simulation.truth().commanded == (0.0, 0.0, 0.0)


@pytest.mark.slow
def test_commands_beyond_the_robots_range_are_clipped_and_do_not_topple_it(simulation: Simulation) -> None:
    _stand(simulation)
    _run(simulation, 3.0, (99.0, -99.0, 99.0))
    assert simulation.truth().commanded == (3.8, -1.0, 4.0)
    assert not simulation.fell


@pytest.mark.slow
def test_a_walking_robot_comes_to_rest_before_it_lies_down(simulation: Simulation) -> None:
    _stand(simulation)
    _run(simulation, 2.0, (1.0, 0.0, 0.0))
    assert simulation.sport(SportAction.STAND_DOWN) == 0
    sinking = []
    for _ in range(125):
        _run(simulation, 0.04, (1.0, 0.0, 0.0))  # no longer heeded
        truth = simulation.truth()
        assert truth.commanded == (0.0, 0.0, 0.0)
        if 0.12 < truth.body_height_m < 0.28:
            sinking.append(truth)
    assert not simulation.fell
    # The trunk sways by millimetres, at up to 0.12 m/s, over feet that grip; it goes nowhere.
    assert sinking and max(np.linalg.norm(truth.velocity_world_mps[:2]) for truth in sinking) < 0.15
    assert max(np.linalg.norm(truth.position_m[:2] - sinking[0].position_m[:2]) for truth in sinking) < 0.03
    assert simulation.truth().mode == 5


def test_a_robot_that_is_kept_from_resting_lies_down_all_the_same() -> None:
    controller = SportController(0.01)
    pushed = Measured((0.0, 0.85, -1.7) * 4, (0.0,) * 12, BodyMotion(0, 0, 0, 0, 0, 0, 0.5, 0), up=1.0)
    for action, seconds in ((SportAction.STAND_UP, 2), (SportAction.BALANCE_STAND, 1), (SportAction.STAND_DOWN, 6)):
        assert controller.request(action) == 0
        for _ in range(seconds * 100):
            controller.step(pushed)
    assert controller.mode == 5


@pytest.mark.slow
def test_a_repeated_stand_up_or_down_does_not_start_over(simulation: Simulation) -> None:
    for action, arrived in ((SportAction.STAND_UP, 6), (SportAction.STAND_DOWN, 5)):
        for _ in range(4):
            assert simulation.sport(action) == 0
            _run(simulation, 0.5)
        assert simulation.truth().mode == arrived


@pytest.mark.slow
def test_stand_down_overrides_a_stand_up_that_runs(simulation: Simulation) -> None:
    simulation.sport(SportAction.STAND_UP)
    _run(simulation, 1.0)
    simulation.sport(SportAction.STAND_DOWN)
    _run(simulation, 1.6)
    assert simulation.truth().mode == 5


@pytest.mark.slow
def test_damp_goes_limp_and_recovery_stands_up_again(simulation: Simulation) -> None:
    _stand(simulation)
    simulation.sport(SportAction.DAMP)
    _run(simulation, 1.0)
    truth = simulation.truth()
    assert truth.mode == 7 and truth.body_height_m < 0.2
    assert simulation.sport(SportAction.RECOVERY_STAND) == 0
    _run(simulation, 0.5)
    assert simulation.truth().mode == 8
    _run(simulation, 3.0)
    truth = simulation.truth()
    assert truth.mode == 1
    assert truth.body_height_m == pytest.approx(0.31, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("roll", [pi, 1.6, -2.5])
def test_recovery_turns_a_robot_on_its_back_over(simulation: Simulation, roll: float) -> None:
    pybullet.resetBasePositionAndOrientation(
        simulation.robot.body, (0, 0, 0.3), pybullet.getQuaternionFromEuler((roll, 0, 0.4)), simulation.client
    )
    simulation.sport(SportAction.DAMP)
    _run(simulation, 1.0)
    assert simulation.fell
    for _ in range(12):  # repeated calls do not interrupt the turning over
        assert simulation.sport(SportAction.RECOVERY_STAND) == 0
        _run(simulation, 0.5)
    truth = simulation.truth()
    assert truth.mode == 1
    assert truth.body_height_m == pytest.approx(0.31, abs=0.02)


@pytest.mark.slow
def test_velocities_agree_with_positions(simulation: Simulation) -> None:
    _stand(simulation)
    _run(simulation, 1.5, (0.5, 0.0, 0.3))
    before = simulation.truth()
    velocities = []
    for _ in range(200):
        _run(simulation, 0.002)
        velocities.append(simulation.truth().velocity_world_mps)
    after = simulation.truth()
    moved = after.position_m - before.position_m
    assert moved == pytest.approx(np.mean(velocities, axis=0) * (after.time_s - before.time_s), abs=0.003)


@pytest.mark.slow
def test_feet_carry_the_robot_where_kinematics_places_them(simulation: Simulation) -> None:
    _stand(simulation)
    truth = simulation.truth()
    assert truth.foot_position_body_m[:, 2] == pytest.approx(0.022 - truth.body_height_m, abs=0.006)
    assert np.sign(truth.foot_position_body_m[:, 0]).tolist() == [1, 1, -1, -1]
    assert np.sign(truth.foot_position_body_m[:, 1]).tolist() == [-1, 1, -1, 1]


@pytest.mark.parametrize("joint", [0, 1, 2])
def test_a_motor_drives_less_and_less_towards_its_top_speed_but_always_brakes(joint: int) -> None:
    torque, speed = TORQUE_LIMITS_NM[joint], VELOCITY_LIMITS_RADPS[joint]
    assert motor_torque(joint, 99.0, 0.0) == motor_torque(joint, 99.0, 0.5 * speed) == torque
    assert motor_torque(joint, 99.0, 0.9 * speed) == pytest.approx(0.5 * torque)
    assert motor_torque(joint, 99.0, speed) == motor_torque(joint, 99.0, 1.5 * speed) == 0.0
    assert motor_torque(joint, -99.0, 1.5 * speed) == -torque
    assert motor_torque(joint, -99.0, -speed) == 0.0


def test_a_joint_without_torque_is_held_by_its_dry_friction(simulation: Simulation) -> None:
    """Weightless, a torque below the friction (0.2 N.m) moves nothing and one above it does."""
    body = simulation.robot.body
    links = range(pybullet.getNumJoints(body, physicsClientId=simulation.client))
    names = [pybullet.getJointInfo(body, link, physicsClientId=simulation.client)[1] for link in links]
    calf = names.index(b"FR_calf")
    pybullet.setGravity(0, 0, 0, physicsClientId=simulation.client)
    pybullet.resetBasePositionAndOrientation(body, (0, 0, 1), (0, 0, 0, 1), physicsClientId=simulation.client)
    pybullet.resetJointState(body, calf, -1.8, physicsClientId=simulation.client)
    turned = []
    for torque in (0.15, 0.4):
        for _ in range(50):
            pybullet.setJointMotorControl2(
                body, calf, pybullet.TORQUE_CONTROL, force=torque, physicsClientId=simulation.client
            )
            pybullet.stepSimulation(physicsClientId=simulation.client)
        turned.append(pybullet.getJointState(body, calf, physicsClientId=simulation.client)[0] + 1.8)
    assert abs(turned[0]) < 1e-3 and turned[1] > 0.05


def test_no_line_of_the_urdf_is_longer_than_the_engine_reads(tmp_path: Path) -> None:
    assert max(len(line) for line in write_go2_urdf(tmp_path).read_text().splitlines()) < 8000


def test_a_running_simulation_keeps_no_files(
    open_floor: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    simulation = Simulation(open_floor, people=0, seed=0)
    assert list(tmp_path.iterdir()) == []
    simulation.close()


def test_a_closed_window_is_reported_and_the_simulation_can_still_be_closed(simulation: Simulation) -> None:
    simulation.step()
    pybullet.disconnect(physicsClientId=simulation.client)  # what closing the window does
    for call in (simulation.step, simulation.truth):
        with pytest.raises(SimulationClosedError, match="window") as raised:
            call()
        assert "\n" not in str(raised.value)
    simulation.close()
    with pytest.raises(SimulationClosedError):
        simulation.step()
