"""Low-level mode: what a low command makes of the joints, and what of it is believed."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_bridge.unitree.messages.crc import crc_of_words
from sim_hil.protocols.unitree.services.behaviour import Go2Behaviour
from sim_hil.protocols.unitree.services.idl_command import BmsCmd_, LowCmd_, MotorCmd_
from sim_hil.protocols.unitree.services.low_level import (
    LOW_COMMAND_LAYOUT,
    POSITION_STOP_RAD,
    SILENCE_S,
    VELOCITY_STOP_RADPS,
    LowLevel,
    MotorTarget,
    low_command_crc,
    motor_targets,
)
from sim_hil.protocols.unitree.services.postures import STANDING
from sim_hil.robots.go2.body import Go2
from sim_hil.robots.go2.gait import BodyMotion
from sim_hil.robots.go2.sport import LYING_RAD, Measured
from sim_hil.robots.go2.urdf import TORQUE_LIMITS_NM
from sim_hil.scene.scene import load_scene
from sim_hil.simulation.physics import Simulation


def command(q_rad: tuple[float, ...] = (0.0,) * 12, *, kp: float = 0.0, kd: float = 0.0, tau: float = 0.0) -> LowCmd_:
    """As the maker's examples fill it in, checksum included."""
    motors = [MotorCmd_(1, q, 0.0, tau, kp, kd, [0, 0, 0]) for q in q_rad]
    motors += [MotorCmd_(1, 0.0, 0.0, 0.0, 0.0, 0.0, [0, 0, 0]) for _ in range(8)]
    low = LowCmd_(
        b"\xfe\xef", 0xFF, 0, [0, 0], [0, 0], 0, motors, BmsCmd_(0, b"\0\0\0"), bytes(40), bytes(12), bytes(2), 0, 0, 0
    )
    low.crc = low_command_crc(low)
    return low


def still(q_rad: tuple[float, ...] = (0.0,) * 12, dq_radps: float = 0.0) -> Measured:
    return Measured(q_rad, (dq_radps,) * 12, BodyMotion(*[0.0] * 8), 1.0)


def test_the_checksum_covers_the_c_struct_of_812_bytes() -> None:
    assert LOW_COMMAND_LAYOUT.size + struct.calcsize("<I") == 812


def test_the_checksum_is_the_same_after_the_wire() -> None:
    low = command(LYING_RAD, kp=60.0, kd=5.0)
    assert low_command_crc(LowCmd_.deserialize(low.serialize())) == low.crc
    assert crc_of_words(bytes(808)) != low.crc


@given(st.integers(0, 11), st.sampled_from(["q", "dq", "tau", "kp", "kd"]))
def test_a_command_that_was_changed_on_the_way_is_ignored(joint: int, field: str) -> None:
    low = command(LYING_RAD)
    setattr(low.motor_cmd[joint], field, 3.5)
    assert motor_targets(low) is None


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_command_with_a_non_finite_number_is_ignored(value: float) -> None:
    low = command()
    low.motor_cmd[3].tau = value
    low.crc = low_command_crc(low)
    assert motor_targets(low) is None


@pytest.mark.parametrize(
    ("target", "torque"),
    [
        (MotorTarget(True, 0.5, 1.0, 2.0, 10.0, 0.5), 2.0 + 10 * 0.5 + 0.5 * 1.0),
        (MotorTarget(True, POSITION_STOP_RAD, 1.0, 2.0, 10.0, 0.5), 2.0 + 0.5 * 1.0),
        (MotorTarget(True, 0.5, VELOCITY_STOP_RADPS, 2.0, 10.0, 0.5), 2.0 + 10 * 0.5),
        (MotorTarget(False, 0.5, 1.0, 2.0, 10.0, 0.5), 0.0),
    ],
)
def test_the_torque_is_the_makers_formula_without_terms_that_are_switched_off(
    target: MotorTarget, torque: float
) -> None:
    assert target.torque(0.0, 0.0) == pytest.approx(torque)


def test_no_motor_gives_more_than_it_has() -> None:
    low = LowLevel()
    low.take(command(tau=500.0), 0.0)
    assert low.torques(still(), 0.0) == TORQUE_LIMITS_NM * 4


def test_after_a_silence_the_joints_are_only_damped() -> None:
    low = LowLevel()
    low.take(command(tau=5.0), 0.0)
    assert low.torques(still(dq_radps=1.0), SILENCE_S) == pytest.approx((5.0,) * 12)
    assert low.torques(still(dq_radps=1.0), SILENCE_S + 0.01) == pytest.approx((-2.0,) * 12)


def test_damaged_commands_are_counted_and_the_last_good_one_stays() -> None:
    low = LowLevel()
    low.take(command(tau=5.0), 0.0)
    spoilt = command(tau=9.0)
    spoilt.crc ^= 1
    low.take(spoilt, 0.1)
    low.take(None, 0.1)
    assert low.rejected == 2
    assert low.torques(still(), 0.1) == pytest.approx((5.0,) * 12)


@pytest.mark.slow
def test_low_commands_stand_a_released_robot_up_and_without_them_it_sinks() -> None:
    simulation = Simulation(load_scene("corridor"), people=0, seed=0)
    robot = simulation.robot
    assert isinstance(robot, Go2)
    behaviour = Go2Behaviour(robot.sport, simulation.dt_s)
    robot.sport = behaviour  # type: ignore[assignment]
    behaviour.release()
    for step in range(1000):
        share = min(step / 700, 1.0)
        q = tuple(a + share * (b - a) for a, b in zip(LYING_RAD, STANDING, strict=True))
        if step % 5 == 0:
            behaviour.low_level.take(command(q, kp=90.0, kd=2.5), behaviour.time_s)
        simulation.step()
    assert simulation.pose()[0][2] > 0.25
    for _ in range(750):
        simulation.step()
    assert simulation.pose()[0][2] < 0.2
    simulation.close()
