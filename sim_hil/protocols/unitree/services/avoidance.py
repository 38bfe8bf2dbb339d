"""Obstacle avoidance of the simulated Go2: distance to the next obstacle, and the speed allowed towards it. Pure.

The range finder casts rays along the direction of travel over the robot's width. Obstacles are boxes of the scene at
the height of body and feet, and people. It uses ground truth in place of the robot's lidar.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.core.geometry import SE2
from firmware_bridge.unitree.messages import ids
from sim_hil.crowd.people import PERSON_RADIUS_M
from sim_hil.protocols.unitree.services.service import Answer, parse_flag, parse_numbers, parse_table
from sim_hil.scene.scene import Box

Vec3 = tuple[float, float, float]

OBSTACLES_AVOID_VERSION: Final = "1.0.0.2"
RANGE_M: Final = 4.0
# Our choices: half the width that must be free; stopping distance from the body's centre (half its length plus a
# margin); deceleration of the trot.
HALF_WIDTH_M: Final = 0.28
STOP_M: Final = 0.60
BRAKE_MPS2: Final = 0.6
REACTION_S: Final = 0.25
_LOW_M, _HIGH_M = 0.05, 0.50  # range of heights: the robot steps on lower boxes and passes under higher ones
_RAYS: Final = np.linspace(-HALF_WIDTH_M, HALF_WIDTH_M, 7)
_SWITCH_SET, _SWITCH_GET, _MOVE, _USE_API = 1001, 1002, 1003, 1004
_VELOCITY, _BY, _TO = 0, 1, 2  # "mode" of a Move


class RangeFinder:
    """Range finder: free distance from the robot's centre in any direction, for static boxes and moving people."""

    def __init__(self, boxes: Sequence[Box]) -> None:
        relevant = [
            box
            for box in boxes
            if box.centre_m[2] - box.size_m[2] / 2 < _HIGH_M and box.centre_m[2] + box.size_m[2] / 2 > _LOW_M
        ]
        self._centres = np.array([box.centre_m[:2] for box in relevant]).reshape(-1, 2)
        self._axes = np.array([box.axis for box in relevant]).reshape(-1, 2)
        self._halves = np.array([(box.size_m[0] / 2, box.size_m[1] / 2) for box in relevant]).reshape(-1, 2)

    def free_m(self, x_m: float, y_m: float, direction_rad: float, people: NDArray[np.float64]) -> float:
        """Return the free distance over the robot's width, m, at most RANGE_M; `people` [n, >= 2]: positions, m."""
        c, s = math.cos(direction_rad), math.sin(direction_rad)
        starts = np.stack((x_m - s * _RAYS, y_m + c * _RAYS), axis=1)
        nearest = RANGE_M
        if len(self._centres):
            nearest = min(nearest, self._boxes(starts, np.array((c, s))))
        if len(people):
            nearest = min(nearest, _circles(np.array((x_m, y_m)), np.array((c, s)), people[:, :2]))
        return nearest

    def _boxes(self, starts: NDArray[np.float64], direction: NDArray[np.float64]) -> float:
        """Return the distance to the first box along parallel rays (slab method in each box's own frame)."""
        ax, ay = self._axes[:, 0], self._axes[:, 1]
        gap = starts[:, None, :] - self._centres[None, :, :]
        local = np.stack((gap[..., 0] * ax + gap[..., 1] * ay, gap[..., 1] * ax - gap[..., 0] * ay), axis=-1)
        along = np.stack((direction[0] * ax + direction[1] * ay, direction[1] * ax - direction[0] * ay), axis=-1)
        along = np.where(np.abs(along) < 1e-9, 1e-9, along)
        first = (-self._halves - local) / along
        second = (self._halves - local) / along
        enter = np.minimum(first, second).max(axis=-1)
        leave = np.maximum(first, second).min(axis=-1)
        hits = (leave >= np.maximum(enter, 0.0)) & (leave > 0.0)
        return float(np.where(hits, np.maximum(enter, 0.0), RANGE_M).min())


def _circles(start: NDArray[np.float64], direction: NDArray[np.float64], people: NDArray[np.float64]) -> float:
    gap = people - start
    ahead = gap @ direction
    beside = gap[:, 1] * direction[0] - gap[:, 0] * direction[1]
    reach = PERSON_RADIUS_M + HALF_WIDTH_M
    hits = (ahead > 0.0) & (np.abs(beside) < reach)
    return float(np.where(hits, np.maximum(ahead - PERSON_RADIUS_M, 0.0), RANGE_M).min())


def allowed_mps(free_m: float) -> float:
    """Return the speed from which braking (BRAKE_MPS2, after REACTION_S) ends STOP_M before an obstacle at `free_m`."""
    room_m = max(free_m - STOP_M, 0.0)
    pause = BRAKE_MPS2 * REACTION_S
    return math.sqrt(pause * pause + 2.0 * BRAKE_MPS2 * room_m) - pause


def slowed(velocity: Vec3, free_m: float) -> Vec3:
    """Reduce a velocity (m/s, m/s, rad/s) to the speed allowed at a free distance; turning is not limited."""
    vx, vy, wz = velocity
    speed_mps = math.hypot(vx, vy)
    share = min(1.0, allowed_mps(free_m) / speed_mps) if speed_mps > 0.0 else 1.0
    return (share * vx, share * vy, wz)


def towards(pose: SE2, goal: SE2) -> Vec3 | None:
    """Return the velocity from `pose` towards `goal`, both in one frame; None at the goal."""
    left = pose.inverse() @ goal
    turn = math.atan2(math.sin(left.theta_rad), math.cos(left.theta_rad))
    distance_m = math.hypot(left.x_m, left.y_m)
    if distance_m < 0.06 and abs(turn) < 0.06:
        return None
    share = min(1.0, 0.4 / distance_m) if distance_m > 0 else 0.0
    return (share * left.x_m, max(-0.3, min(0.3, share * left.y_m)), max(-0.6, min(0.6, 1.2 * turn)))


class Pilot:
    """Common path of all services' velocities to the robot: slows down before obstacles and drives to goals.

    Call `step` at about 20 Hz with the robot's clock. A velocity is valid for `hold_s`, as on the robot.
    """

    def __init__(
        self,
        command: Callable[[float, float, float], None],
        free_m: Callable[[float], float],
        *,
        hold_s: float = 1.0,
    ) -> None:
        """Create the pilot; `command` drives the robot, `free_m` returns the free distance in a body direction, rad."""
        self.avoids = False
        self._command = command
        self._free_m = free_m
        self._hold_s = hold_s
        self._now_s = 0.0
        self._wanted: Vec3 | None = None
        self._until_s = 0.0
        self._goal: SE2 | None = None

    def move(self, vx_mps: float, vy_mps: float, wz_radps: float, /, *, avoiding: bool) -> None:
        """Command a velocity in the body frame; it cancels a goal."""
        self._goal = self._wanted = None
        if not avoiding:
            self._command(vx_mps, vy_mps, wz_radps)
            return
        self._wanted, self._until_s = (vx_mps, vy_mps, wz_radps), self._now_s + self._hold_s
        self._drive(self._wanted)

    def go_to(self, goal: SE2) -> None:
        """Drive to a pose in the odometry frame, slowing down before obstacles."""
        self._goal, self._wanted = goal, None

    def stop(self) -> None:
        """Discard velocity and goal; the caller stops the robot."""
        self._goal = self._wanted = None

    def step(self, now_s: float, pose: Callable[[], SE2]) -> None:
        """Adapt the speed to the free distance; `pose` returns the reported T_odom_base."""
        self._now_s = now_s
        if self._goal is not None:
            velocity = towards(pose(), self._goal)
            if velocity is None:
                self._goal = None
            self._drive(velocity if velocity is not None else (0.0, 0.0, 0.0))
        elif self._wanted is not None:
            if now_s >= self._until_s:
                self._wanted = None
                self._command(0.0, 0.0, 0.0)
            else:
                self._drive(self._wanted)

    def _drive(self, velocity: Vec3) -> None:
        vx, vy, _ = velocity
        free_m = self._free_m(math.atan2(vy, vx)) if vx or vy else RANGE_M
        self._command(*slowed(velocity, free_m))


class ObstaclesAvoid:
    """Service obstacles_avoid; its Move is obeyed only after UseRemoteCommandFromApi(true)."""

    def __init__(self, pilot: Pilot, pose: Callable[[], SE2]) -> None:
        """Create the service; `pose` returns the reported T_odom_base."""
        self.enabled = True
        self._from_api = False
        self._pilot = pilot
        self._pose = pose

    def switch(self, on: bool | None) -> bool:
        """Switch avoidance on or off, None: no change; return the resulting state."""
        if on is not None:
            self.enabled = on
        return self.enabled

    def handle(self, api_id: int, parameter: str) -> Answer:
        """Handle one request."""
        if api_id == _MOVE:
            return self._move(parameter), ""
        if api_id == _SWITCH_GET:
            return ids.OK, json.dumps({"enable": self.enabled})
        if api_id not in (_SWITCH_SET, _USE_API):
            return ids.ERROR_NOT_IMPLEMENTED, ""
        flag = parse_flag(parameter, "enable" if api_id == _SWITCH_SET else "is_remote_commands_from_api")
        if flag is None:
            return ids.ERROR_PARAMETER, ""
        if api_id == _SWITCH_SET:
            self.enabled = flag
        else:
            self._from_api = flag
        return ids.OK, ""

    def _move(self, parameter: str) -> int:
        values = parse_numbers(parameter, "x", "y", "yaw")
        mode = (parse_table(parameter) or {}).get("mode", _VELOCITY)
        if values is None or mode not in (_VELOCITY, _BY, _TO):
            return ids.ERROR_PARAMETER
        if not self._from_api:
            return ids.OK
        if mode == _VELOCITY:
            self._pilot.move(*values, avoiding=self.enabled)
        else:
            goal = SE2(*values)
            self._pilot.go_to(self._pose() @ goal if mode == _BY else goal)
        return ids.OK
