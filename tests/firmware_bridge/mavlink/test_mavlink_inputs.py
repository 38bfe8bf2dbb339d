"""Reports of an autopilot in the bridge's axes, by laws: forward, to the left and counterclockwise are positive."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from edge.core.geometry import SE2, wrap_angle
from firmware_bridge.mavlink.inputs import (
    Attitude,
    attitude_of,
    battery_of,
    battery_of_status,
    is_estimate_good,
    motion_of_odometry,
    motion_of_position,
)

NAN = math.nan
ANGLE = st.floats(-math.pi, math.pi)
SPEED = st.floats(-3.0, 3.0)
PLACE = st.floats(-100.0, 100.0)


def quaternion(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """w, x, y, z by multiplication of the three turns, in MAVLink's axes."""
    r, p, y = roll / 2, pitch / 2, yaw / 2
    a = (math.cos(y) * math.cos(p), -math.sin(y) * math.sin(p), math.cos(y) * math.sin(p), math.sin(y) * math.cos(p))
    c, s = math.cos(r), math.sin(r)
    return a[0] * c - a[1] * s, a[0] * s + a[1] * c, a[2] * c + a[3] * s, a[3] * c - a[2] * s


def odometry(**changes: object) -> object:
    values = {
        "time_usec": 5_000_000, "frame_id": 20, "child_frame_id": 12, "x": 1.0, "y": 2.0, "z": 0.0,
        "q": quaternion(0.0, 0.0, 0.0), "vx": 0.5, "vy": 0.0, "vz": 0.0, "rollspeed": 0.0, "pitchspeed": 0.0,
        "yawspeed": 0.1, "pose_covariance": [NAN] * 21, "velocity_covariance": [NAN] * 21, "reset_counter": 0,
        "estimator_type": 0, "quality": 0, **changes,
    }  # fmt: skip
    return dialect.MAVLink_odometry_message(*[values[name] for name in dialect.MAVLink_odometry_message.fieldnames])


@given(x=PLACE, y=PLACE, theta=ANGLE, v=st.floats(-2, 2), side=st.floats(-1, 1), w=SPEED)
@settings(max_examples=60, deadline=None)
def test_odometry_and_position_report_the_same_motion(
    x: float, y: float, theta: float, v: float, side: float, w: float
) -> None:
    """A rover at (x, y, theta) of the bridge's axes, seen through both messages of MAVLink, one with two frames."""
    yaw = -theta
    both = odometry(x=x, y=-y, q=quaternion(0.0, 0.0, yaw), vx=v, vy=-side, yawspeed=-w)
    north, east = v * math.cos(yaw) + side * math.sin(yaw), v * math.sin(yaw) - side * math.cos(yaw)
    position = dialect.MAVLink_local_position_ned_message(5000, x, -y, 0.0, north, east, 0.0)
    local = odometry(
        x=x, y=-y, q=quaternion(0.0, 0.0, yaw), frame_id=1, child_frame_id=1, vx=north, vy=east, yawspeed=-w
    )
    found = motion_of_odometry(both)
    split = motion_of_position(position, Attitude(0, 0.0, 0.0, theta, w))
    for motion in (found, split, motion_of_odometry(local)):
        assert motion is not None and motion.stamp_ns == 5_000_000_000
        assert motion.T_odom_base[:2] == pytest.approx((x, y))
        assert abs(wrap_angle(motion.T_odom_base[2] - theta)) < 1e-6
        assert (motion.vx_mps, motion.vy_mps, motion.wz_radps) == pytest.approx((v, side, w), abs=1e-6)


@given(
    roll=ANGLE, pitch=st.floats(-1.5, 1.5), yaw=ANGLE, v=SPEED, side=SPEED, down=SPEED, frame=st.sampled_from((1, 20))
)
@settings(max_examples=60, deadline=None)
def test_a_velocity_of_the_poses_frame_becomes_that_of_the_body_at_any_tilt(
    roll: float, pitch: float, yaw: float, v: float, side: float, down: float, frame: int
) -> None:
    """The velocity is turned by the three matrices of roll, pitch and yaw, which share nothing with a quaternion."""
    x, y, z = v, math.cos(roll) * side - math.sin(roll) * down, math.sin(roll) * side + math.cos(roll) * down
    x, z = math.cos(pitch) * x + math.sin(pitch) * z, math.cos(pitch) * z - math.sin(pitch) * x
    x, y = math.cos(yaw) * x - math.sin(yaw) * y, math.sin(yaw) * x + math.cos(yaw) * y
    q = quaternion(roll, pitch, yaw)
    motion = motion_of_odometry(odometry(q=q, frame_id=frame, child_frame_id=frame, vx=x, vy=y, vz=z))
    assert motion is not None
    assert (motion.vx_mps, motion.vy_mps) == pytest.approx((v, -side), abs=1e-6)


@given(yaw=ANGLE, north=SPEED, east=SPEED, size=st.floats(0.96, 1.04))
@settings(max_examples=60, deadline=None)
def test_the_turn_into_the_body_frame_keeps_the_speed(yaw: float, north: float, east: float, size: float) -> None:
    q = tuple(each * size for each in quaternion(0.0, 0.0, yaw))
    motion = motion_of_odometry(odometry(q=q, frame_id=1, child_frame_id=1, vx=north, vy=east))
    assert motion is not None
    assert math.hypot(motion.vx_mps, motion.vy_mps) == pytest.approx(math.hypot(north, east), abs=1e-9)


@given(theta=st.floats(-3.0, 3.0), v=st.floats(0.2, 1.0), w=st.floats(-1.0, 1.0))
@settings(max_examples=40, deadline=None)
def test_the_velocity_leads_to_the_next_pose(theta: float, v: float, w: float) -> None:
    """Poses that MAVLink's own kinematics produce agree with the bridge's pose, moved by the bridge's velocity."""
    step_s, yaw, yaw_rate = 1e-3, -theta, -w
    poses = []
    for north, east, heading in (
        (0.0, 0.0, yaw),
        (v * math.cos(yaw) * step_s, v * math.sin(yaw) * step_s, yaw + yaw_rate * step_s),
    ):
        motion = motion_of_odometry(odometry(x=north, y=east, q=quaternion(0.0, 0.0, heading), vx=v, yawspeed=yaw_rate))
        assert motion is not None
        poses.append(SE2(*motion.T_odom_base))
    moved = poses[0].inverse() @ poses[1]
    assert moved.x_m == pytest.approx(v * step_s, abs=1e-6) and moved.y_m == pytest.approx(0.0, abs=1e-6)
    assert moved.theta_rad == pytest.approx(w * step_s, abs=1e-6)


@given(roll=st.floats(-1.2, 1.2), pitch=st.floats(-1.2, 1.2), yaw=ANGLE)
@settings(max_examples=40, deadline=None)
def test_both_attitudes_agree(roll: float, pitch: float, yaw: float) -> None:
    motion = motion_of_odometry(odometry(q=quaternion(roll, pitch, yaw)))
    attitude = attitude_of(dialect.MAVLink_attitude_message(1, roll, pitch, yaw, 0.0, 0.0, 0.25))
    assert motion is not None and attitude is not None and attitude.wz_radps == -0.25
    assert (motion.roll_rad, motion.pitch_rad) == pytest.approx((roll, -pitch), abs=1e-5)
    assert (attitude.roll_rad, attitude.pitch_rad) == pytest.approx((roll, -pitch), abs=1e-5)
    assert abs(wrap_angle(motion.T_odom_base[2] - attitude.yaw_rad)) < 1e-5


@pytest.mark.parametrize(
    "changes",
    [
        {"x": NAN}, {"vy": math.inf}, {"yawspeed": 1e9}, {"q": (0.0, 0.0, 0.0, 0.0)}, {"q": (NAN,) * 4},
        {"frame_id": 0}, {"child_frame_id": 1}, {"quality": -1}, {"z": -1e9}, {"time_usec": 2**63},
        {"frame_id": 1, "child_frame_id": 20}, {"frame_id": 1, "child_frame_id": 1, "vz": NAN}, {"child_frame_id": 0},
    ],
)  # fmt: skip
def test_an_impossible_report_is_dropped_whole(changes: dict[str, object]) -> None:
    assert motion_of_odometry(odometry(**changes)) is None


def test_the_battery_of_both_messages_is_the_same() -> None:
    status = dialect.MAVLink_sys_status_message(0, 0, 0, 0, 24000, 150, 73, 0, 0, 0, 0, 0, 0)
    cells = [8000, 8000, 8000] + [65535] * 7
    battery = dialect.MAVLink_battery_status_message(0, 0, 0, 0, cells, 150, -1, -1, 73)
    for found in (battery_of(battery, 7), battery_of_status(status, 7)):
        assert found is not None and (found.soc_percent, found.voltage_v, found.current_a) == (73, 24.0, 1.5)


def test_an_unknown_charge_is_no_battery_report() -> None:
    assert battery_of_status(dialect.MAVLink_sys_status_message(0, 0, 0, 0, 24000, -1, -1, 0, 0, 0, 0, 0, 0), 7) is None


@pytest.mark.parametrize(
    ("flags", "is_ekf", "good"),
    [(1 | 2 | 8, False, True), (1 | 2 | 16, True, True), (1 | 2, False, False), (2 | 8, False, False),
     (1 | 2 | 8 | 128, False, False), (1 | 2 | 8 | 1024, True, False), (1 | 2 | 8 | 1024, False, False),
     (1 | 2 | 8 | 2048, False, False), (1 | 2 | 8 | 32768, True, False), (1 | 2 | 8 | 2048, True, True)],
)  # fmt: skip
def test_an_estimate_needs_attitude_velocity_and_position_and_no_glitch(flags: int, is_ekf: bool, good: bool) -> None:
    assert is_estimate_good(flags, is_ekf=is_ekf) is good
