"""A robot that is told to drive and does not come on steps back; nothing else ever reverses it."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.back_off import BACKING_OFF, BackOff, BackOffConfig
from edge.controller import VelocityCommand
from edge.geometry import SE2

CONFIG = BackOffConfig(vx_min_mps=-0.4)
HERE = SE2(1.0, 2.0, 0.5)
TICK_NS = 100_000_000
ON = VelocityCommand(0.4, 0.0, 0.2, SE2(0.4, 0.0, 0.0), "ok")


def wedged(back_off: BackOff, ticks: int, wanted: VelocityCommand = ON, pose: SE2 | None = HERE) -> VelocityCommand:
    """What is commanded in the last of so many ticks at one place."""
    for tick in range(ticks):
        command = back_off.step(wanted, pose, tick * TICK_NS)
    return command


def test_for_two_seconds_it_does_as_told() -> None:
    assert wedged(BackOff(CONFIG), 20) is ON


def test_then_it_steps_straight_back_slowly() -> None:
    command = wedged(BackOff(CONFIG), 21)
    assert (command.vx_mps, command.vy_mps, command.wz_radps, command.reason) == (-0.2, 0.0, 0.0, BACKING_OFF)


def test_a_turn_that_does_not_come_about_is_a_wedge_too() -> None:
    turning = VelocityCommand(0.0, 0.0, -0.5, None, "ok")
    assert wedged(BackOff(CONFIG), 21, turning).reason == BACKING_OFF


def test_who_is_told_to_stand_is_not_wedged() -> None:
    assert wedged(BackOff(CONFIG), 100, VelocityCommand(0.05, 0.0, 0.1, None, "ok")).reason == "ok"


@given(st.floats(0.15, 0.8), st.floats(-1.0, 1.0))
def test_who_comes_on_is_never_sent_back(speed_mps: float, wz_radps: float) -> None:
    back_off, pose = BackOff(CONFIG), HERE
    for tick in range(100):
        command = back_off.step(VelocityCommand(speed_mps, 0.0, wz_radps, None, "ok"), pose, tick * TICK_NS)
        assert command.reason == "ok"
        pose = pose @ SE2(speed_mps * 0.1, 0.0, wz_radps * 0.1)


def test_it_ends_where_it_has_gone_its_distance() -> None:
    back_off = BackOff(CONFIG)
    wedged(back_off, 21)
    assert back_off.step(ON, HERE @ SE2(-0.29, 0.0, 0.0), 21 * TICK_NS).reason == BACKING_OFF
    assert back_off.step(ON, HERE @ SE2(-0.31, 0.0, 0.0), 22 * TICK_NS) is ON


def test_it_ends_after_a_while_where_it_cannot_go_back_either_and_tries_again() -> None:
    said = []
    back_off = BackOff(CONFIG)
    for tick in range(100):
        said.append(back_off.step(ON, HERE, tick * TICK_NS).reason)
    assert said[20:45] == [BACKING_OFF] * 25 and said[45] == "ok"
    assert BACKING_OFF in said[46:]


@pytest.mark.parametrize("reason", ["stale-frame", "no-semantic-state", "thinking"])
def test_whatever_forces_zero_ends_it_at_once(reason: str) -> None:
    back_off = BackOff(CONFIG)
    wedged(back_off, 25)
    zero = VelocityCommand(0.0, 0.0, 0.0, None, reason)
    assert back_off.step(zero, HERE, 25 * TICK_NS) is zero
    assert back_off.step(ON, HERE, 26 * TICK_NS) is ON


def test_without_a_pose_nothing_is_known_of_a_wedge() -> None:
    assert wedged(BackOff(CONFIG), 50, pose=None) is ON


def test_it_keeps_to_the_share_of_speed_that_the_supervisor_leaves() -> None:
    back_off = BackOff(CONFIG)
    wedged(back_off, 21)
    assert back_off.step(ON, HERE, 21 * TICK_NS, speed_scale=0.5).vx_mps == pytest.approx(-0.1)
    assert back_off.step(ON, HERE, 22 * TICK_NS, speed_scale=float("nan")) is ON


def test_a_robot_that_may_not_reverse_never_does() -> None:
    assert wedged(BackOff(BackOffConfig(vx_min_mps=0.0)), 100) is ON
    assert wedged(BackOff(BackOffConfig(vx_min_mps=-0.05)), 21).vx_mps == pytest.approx(-0.05)


def test_numbers_that_make_no_sense_are_refused() -> None:
    with pytest.raises(ValueError, match="above 0"):
        replace(CONFIG, distance_m=0.0)
    with pytest.raises(ValueError, match="vx_min_mps"):
        replace(CONFIG, vx_min_mps=0.1)
