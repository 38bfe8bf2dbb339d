"""Odometry frame of a Go2: exact, or drifting from the true pose as with slipping legs."""

from __future__ import annotations

import math
from typing import Any

from edge.core.geometry import SE2
from sim_hil.robots.go2.body import RobotTruth
from sim_hil.robots.odometry_noise import OdometryNoise


class OdometryFrame:
    """Frame in which a Go2 reports its pose: position and heading at switch-on."""

    def __init__(self, start: tuple[float, float, float]) -> None:
        """Create the frame; `start`: T_world_odom as (x_m, y_m, theta_rad)."""
        self._x_m, self._y_m, self._theta_rad = start
        self._cos, self._sin = math.cos(start[2]), math.sin(start[2])

    def rotate(self, vector: Any) -> list[float]:
        """Rotate a world vector [3] into the odometry frame."""
        x, y, z = (float(v) for v in vector)
        return [self._cos * x + self._sin * y, self._cos * y - self._sin * x, z]

    def position(self, position_m: Any) -> list[float]:
        """Transform a world position [3], m, into the odometry frame."""
        x, y, z = (float(v) for v in position_m)
        return self.rotate((x - self._x_m, y - self._y_m, z))

    def rpy(self, rpy_rad: Any) -> list[float]:
        """Transform roll, pitch and yaw [3], rad, into the odometry frame; yaw in (-pi, pi]."""
        roll, pitch, yaw = (float(v) for v in rpy_rad)
        turned = yaw - self._theta_rad
        return [roll, pitch, math.atan2(math.sin(turned), math.cos(turned))]

    def quaternion(self, wxyz: Any) -> list[float]:
        """Transform an orientation (w, x, y, z) into the odometry frame."""
        return turned_quaternion([float(v) for v in wxyz], -self._theta_rad)

    def velocity(self, vector: object) -> list[float]:
        """Return a world velocity [3] as the robot reports it, m/s, in the odometry frame."""
        return self.rotate(vector)

    def yaw_speed(self, wz_radps: float) -> float:
        """Return a yaw rate as the robot reports it, rad/s."""
        return wz_radps

    def update(self, truth: RobotTruth) -> None:
        """Advance the drift to a new instant, before its messages are built. Exact odometry has no drift."""


def turned_quaternion(wxyz: list[float], yaw_rad: float) -> list[float]:
    """Rotate an orientation (w, x, y, z) by a yaw angle about the frame's z axis."""
    w, x, y, z = wxyz
    c, s = math.cos(yaw_rad / 2), math.sin(yaw_rad / 2)
    return [c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w]


class DriftingOdometry(OdometryFrame):
    """Odometry frame with drift from `OdometryNoise`; gyroscope and other sensors remain exact."""

    def __init__(self, start: tuple[float, float, float], noise: OdometryNoise) -> None:
        """Create the frame; `start`: T_world_odom as (x_m, y_m, theta_rad). The noise starts at the origin."""
        super().__init__(start)
        self._noise = noise
        self._true: SE2 | None = None
        self._true_s = 0.0
        self._correction = SE2(0.0, 0.0, 0.0)  # reported pose = correction @ true pose
        self._error = (0.0, 0.0, 0.0)  # error of the body velocity, m/s, m/s, rad/s

    def update(self, truth: RobotTruth) -> None:
        """Advance the drift by the robot's motion since the last update."""
        x, y, _ = super().position(truth.position_m)
        now = SE2(x, y, super().rpy(truth.rpy_rad)[2])
        before, self._true = self._true, now
        elapsed_s, self._true_s = truth.time_s - self._true_s, truth.time_s
        if before is None:
            self._correction = self._noise.pose @ now.inverse()
            return
        if elapsed_s <= 0:
            return
        moved = before.inverse() @ now
        report = self._noise.step(moved, elapsed_s)
        self._correction = report.T_odom_base @ now.inverse()
        true_mps = (moved.x_m / elapsed_s, moved.y_m / elapsed_s, moved.theta_rad / elapsed_s)
        vx, vy, wz = (a - b for a, b in zip((report.vx_mps, report.vy_mps, report.wz_radps), true_mps, strict=True))
        self._error = (vx, vy, wz)

    def position(self, position_m: object) -> list[float]:
        """Return a world position [3] as reported, m."""
        x, y, z = super().position(position_m)
        moved = self._correction @ SE2(x, y, 0.0)
        return [moved.x_m, moved.y_m, z]

    def rpy(self, rpy_rad: object) -> list[float]:
        """Return roll, pitch and yaw [3] as reported, rad."""
        roll, pitch, yaw = super().rpy(rpy_rad)
        turned = yaw + self._correction.theta_rad
        return [roll, pitch, math.atan2(math.sin(turned), math.cos(turned))]

    def quaternion(self, wxyz: object) -> list[float]:
        """Return an orientation (w, x, y, z) as reported."""
        return turned_quaternion(super().quaternion(wxyz), self._correction.theta_rad)

    def velocity(self, vector: object) -> list[float]:
        """Return a world velocity [3] as reported, m/s, in the odometry frame; consistent with the reported pose."""
        x, y, z = super().velocity(vector)
        c, s = math.cos(self._correction.theta_rad), math.sin(self._correction.theta_rad)
        heading = self._noise.pose.theta_rad
        ex, ey, _ = self._error
        ch, sh = math.cos(heading), math.sin(heading)
        return [c * x - s * y + ch * ex - sh * ey, s * x + c * y + sh * ex + ch * ey, z]

    def yaw_speed(self, wz_radps: float) -> float:
        """Return a yaw rate as reported, rad/s."""
        return wz_radps + self._error[2]
