"""What the simulated Go2 can do: short versions of the rows of tools/bench/locomotion.py."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pybullet
import pytest

from sim_hil.robots.go2.body import FOOT_GRIP, HALF_LENGTH_M, SHELL_GRIP
from sim_hil.robots.go2.sport import MODE_DAMPING
from sim_hil.robots.go2.urdf import LEGS, TORQUE_LIMITS_NM, TOTAL_MASS_KG, VELOCITY_LIMITS_RADPS
from tools.bench.sim.locomotion_runs import PUSHES, Command, Course, as_row, endure, push_over, track

WEIGHT_N = TOTAL_MASS_KG * 9.81


@pytest.fixture
def course() -> Iterator[Course]:
    with Course("flat", 500) as course:
        yield course


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "rate_hz"),
    [
        ((0.3, 0.0, 0.0), 500),
        ((0.0, 0.0, -0.6), 500),
        ((1.5, 0.0, 0.0), 500),
        ((1.5, 0.3, -1.0), 500),
        ((-0.6, -0.3, 1.0), 500),
        ((0.0, 0.5, 0.0), 480),
        ((1.5, -0.3, 1.0), 480),
        ((1.0, 0.3, -1.0), 240),
    ],
)
def test_the_envelope_is_tracked_within_a_tenth(command: Command, rate_hz: int) -> None:
    row = track(command, rate_hz)
    assert row.kept, row
    assert row.tilt_rad < 0.1


@pytest.mark.slow
@pytest.mark.parametrize(("ground", "settle_s"), [("bumps", 3.0), ("ramp", 5.0)])
@pytest.mark.parametrize("rate_hz", [500, 480])
def test_bumps_and_ramps_are_walked_over_at_speed(ground: str, settle_s: float, rate_hz: int) -> None:
    with Course(ground, rate_hz) as course:
        course.stand()
        course.walk((0.6, 0.0, 0.0), settle_s)
        row = as_row(ground, (0.6, 0.0, 0.0), course.walk((0.6, 0.0, 0.0), 6.0))
        assert row.kept, row
        assert course.robot.pose()[0][2] > (0.7 if ground == "ramp" else 0.3)


@pytest.mark.slow
@pytest.mark.parametrize("rate_hz", [500, 480])
def test_random_commands_do_not_topple_it(rate_hz: int) -> None:
    endured = endure(rate_hz, 7, 30.0)
    assert endured.kept, endured
    assert endured.path_m > 4.0 and endured.commands > 10


@pytest.mark.slow
@pytest.mark.parametrize("index", [0, 4, 6])
def test_a_light_push_is_taken_and_a_hard_one_topples_it_until_it_gets_up(index: int) -> None:
    pushed = push_over(index, 500)
    assert pushed.kept, pushed
    assert pushed.fell == PUSHES[index][3]


def test_the_feet_grip_and_the_rest_of_the_robot_slides(course: Course) -> None:
    body, client = course.robot.body, course.client
    grips = {"base": pybullet.getDynamicsInfo(body, -1, physicsClientId=client)[1]}
    for link in range(pybullet.getNumJoints(body, physicsClientId=client)):
        name = pybullet.getJointInfo(body, link, physicsClientId=client)[1].decode()
        grips[name] = pybullet.getDynamicsInfo(body, link, physicsClientId=client)[1]
    feet = {f"{leg}_foot" for leg in LEGS}
    assert feet < set(grips)
    assert grips == {name: FOOT_GRIP if name in feet else SHELL_GRIP for name in grips}


@pytest.mark.slow
def test_a_fallen_robot_is_limp_and_stays_down_until_a_stand_request(course: Course) -> None:
    course.stand()
    course.push((0.0, 600.0, 300.0), 0.1)
    course.wait(4.0)
    assert course.fell and course.robot.sport.mode == MODE_DAMPING
    assert not course.robot.ready and course.robot.pose()[0][2] < 0.2
    course.robot.command(0.5, 0.0, 0.0)
    assert course.robot.truth(course.time_s).commanded == (0.0, 0.0, 0.0)


@pytest.mark.slow
def test_nothing_of_a_turning_robot_leaves_its_circle_and_nothing_of_a_running_one_its_length(course: Course) -> None:
    robot = course.robot
    course.stand()
    for command, axis in (((0.0, 0.0, 1.0), None), ((1.5, 0.0, 0.0), 0)):
        for _ in range(100):
            course.walk(command, 0.02)
            feet = robot.truth(0.0).foot_position_body_m[:, :2]
            reach = np.linalg.norm(feet, axis=1) if axis is None else np.abs(feet[:, axis])
            assert reach.max() + 0.022 <= (robot.radius_m if axis is None else HALF_LENGTH_M)


@pytest.mark.slow
def test_the_feet_carry_the_weight_of_a_trotting_robot_in_pairs(course: Course) -> None:
    course.stand()
    course.walk((0.6, 0.0, 0.0), 1.5)
    forces = []
    for _ in range(1000):
        course.walk((0.6, 0.0, 0.0), 0.002)
        forces.append(course.robot.truth(0.0).foot_force_n)
    assert np.sum(forces, axis=1).mean() == pytest.approx(WEIGHT_N, rel=0.05)
    down = np.array(forces) > 5.0
    assert (down[:, 0] == down[:, 3]).mean() > 0.8 and (down[:, 0] != down[:, 1]).mean() > 0.6


@pytest.mark.slow
def test_motors_keep_their_limits_at_full_speed(course: Course) -> None:
    course.stand()
    course.walk((1.5, 0.0, 0.0), 1.5)
    for _ in range(1000):
        course.walk((1.5, 0.0, 0.0), 0.002)
        truth = course.robot.truth(0.0)
        assert (np.abs(truth.joint_dq_radps.reshape(4, 3)) < VELOCITY_LIMITS_RADPS).all()
        assert (np.abs(truth.joint_tau_nm.reshape(4, 3)) <= TORQUE_LIMITS_NM).all()


@pytest.mark.slow
def test_the_imu_feels_gravity_along_the_slope_and_nothing_in_the_air() -> None:
    with Course("ramp", 500) as course:
        course.stand()
        course.walk((0.6, 0.0, 0.0), 6.0)
        course.wait(3.0)  # its command expires and it stands on the slope
        truth = course.robot.truth(0.0)
        assert truth.accel_mps2 == pytest.approx(9.81 * np.array((-np.sin(truth.rpy_rad[1]), 0.0, 1.0)), abs=0.4)
        assert abs(truth.rpy_rad[1]) > 0.08
        for _ in range(50):
            course.push((0.0, 0.0, 600.0), 0.002)
        course.wait(0.1)
        assert np.abs(course.robot.truth(0.0).accel_mps2).max() < 4.0
