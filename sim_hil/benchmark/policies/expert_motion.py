"""Local planner of the expert: simulate many short motions along the route among people, and begin the best one.

Each candidate ("future") follows the route at one speed, shifted sideways by some distance, or turns, waits or backs
off. People are predicted at constant velocity. The cost rates progress, distance to people and walls, and changes of
the command. The method combines Fox's dynamic window with van den Berg's velocity obstacles.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, exp, pi
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.core.geometry import wrap_angle
from sim_hil.benchmark.policies.expert_route import SPACING_M
from sim_hil.crowd.people import PERSON_RADIUS_M
from sim_hil.scene.nav_grid import NavGrid

Array = NDArray[np.float64]
STEP_S: Final = 0.2
STEPS: Final = 20
CONTROL_S: Final = 0.1
PERSON_M: Final = 0.5  # the benchmark's collision distance between robot and person, centre to centre
_SHIFTS_M: Final = (0.0, 0.18, -0.18, 0.4, -0.4, 0.7, -0.7, 1.1, -1.1, 1.6, -1.6)
_SIDES: Final = np.array(_SHIFTS_M)
_PACES: Final = (1.0, 0.75, 0.5, 0.25)
# Candidates that do not follow the route: share of the top speed, share of the top turning rate.
_FIXED: Final = ((0.0, 0.0), (0.0, 0.7), (0.0, -0.7), (-0.25, 0.0), (-0.25, 0.4), (-0.25, -0.4))
_AIM_M, _AIM_S = 0.45, 0.45  # the robot aims at the route this far ahead, and this long at its speed

ABOUT_RAD: Final = 2.0
"""Bearing of the route beyond which a robot turns about."""


@dataclass(frozen=True)
class Driving:
    """Driving parameters of a robot: comfortable limits and distances; m, s, rad."""

    speed_mps: float = 1.0
    turn_radps: float = 1.0
    accel_mps2: float = 1.0
    brake_mps2: float = 1.6
    turn_accel_radps2: float = 3.0
    body_radius_m: float = 0.27
    body_reach_m: float = 0.1
    margin_m: float = 0.15  # beyond the collision distance
    comfort_m: float = 0.55

    def __post_init__(self) -> None:
        if min(self.speed_mps, self.turn_radps, self.accel_mps2, self.brake_mps2, self.turn_accel_radps2) <= 0:
            raise ValueError("expert: every limit must be positive")


@dataclass(frozen=True)
class Choice:
    """The chosen velocity and the predicted motion that it begins.

    `future` [STEPS, 2], m in the world frame, and `headings_rad` [STEPS], at STEP_S, 2 STEP_S, ... from now.
    """

    vx_mps: float
    wz_radps: float
    future: Array
    headings_rad: Array
    shift_m: float
    cost: float
    """Negative: the robot makes progress; far above zero: the route is blocked."""


class Motion:
    """Local planner that chooses a velocity every CONTROL_S and keeps the last one for smoothness."""

    def __init__(self, grid: NavGrid, driving: Driving, *, about_left: bool = False) -> None:
        """`about_left`: turn about to the left, also where the right is nearer: a student cannot see which one is."""
        self._about_left = about_left
        self._grid = grid
        self._driving = driving
        self._speed, self._turn, self._shift = 0.0, 0.0, 0.0
        pairs = [(pace, shift) for pace in _PACES for shift in _SHIFTS_M] + [(0.0, 0.0)]
        follow = len(pairs)
        self._pace = np.array([pace for pace, _ in pairs] + [0.0] * len(_FIXED)) * driving.speed_mps
        self._side = np.array([shift for _, shift in pairs] + [0.0] * len(_FIXED))
        rows = [_SHIFTS_M.index(shift) for _, shift in pairs] + [0] * len(_FIXED)
        self._side_row = np.array(rows, dtype=np.int64)
        self._is_fixed = np.arange(follow + len(_FIXED)) >= follow
        self._fixed_v = np.array([0.0] * follow + [v for v, _ in _FIXED]) * driving.speed_mps
        self._fixed_w = np.array([0.0] * follow + [w for _, w in _FIXED]) * driving.turn_radps
        self._waits = (self._pace == 0.0) & ~self._is_fixed
        self._times = (np.arange(STEPS) + 1) * STEP_S
        self._near_term = np.array([exp(-time / 2.5) for time in self._times])

    def choose(
        self,
        pose: tuple[float, float, float],
        speed_mps: float,
        route: Array,
        people: Array,
        velocities: Array,
        *,
        patience: float = 1.0,
    ) -> Choice:
        """Choose the velocity for the next control period.

        `pose`: x m, y m, heading rad. `speed_mps`: measured. `route` [n, 2]: points ahead, SPACING_M apart. `people`
        [k, 2] m, `velocities` [k, 2] m/s. A `patience` below 1 permits passing people closer than is comfortable.
        """
        # If something blocks the robot, its real speed differs from the commanded one: stay close to the measurement.
        self._speed = min(max(self._speed, speed_mps - 0.35), speed_mps + 0.35)
        about = self._about_left and abs(self._bearing_rad(pose, route)) > ABOUT_RAD
        x, y, v, turned, wanted_v, wanted_w = self._drive(pose, route, about=about)
        cost = self._progress(x, y, route) + self._walls(x, y, turned)
        if about:
            cost[0] -= 1.0  # it turns to the route itself, unless a wall or a person is near: no progress pays for that
        if len(people):
            cost = cost + self._people(x, y, v, turned, people, velocities, patience)
        cost = cost + 0.06 * np.abs(wanted_v - self._speed) + 0.03 * np.abs(wanted_w - self._turn)
        cost = cost + 0.06 * np.abs(self._side - self._shift) + 0.03 * np.abs(self._side)
        best = int(np.argmin(cost))
        driving = self._driving
        self._speed = _slew(
            self._speed, float(wanted_v[best]), driving.brake_mps2 * CONTROL_S, driving.accel_mps2 * CONTROL_S
        )
        turn_step = driving.turn_accel_radps2 * CONTROL_S
        self._turn = _slew(self._turn, float(wanted_w[best]), turn_step, turn_step)
        self._shift = float(self._side[best])
        future = np.stack((x[:, best], y[:, best]), axis=1)
        return Choice(self._speed, self._turn, future, turned[:, best].copy(), self._shift, float(cost[best]))

    def stand(self, pose: tuple[float, float, float], speed_mps: float) -> Choice:
        """Brake and stand, regardless of people: for a robot at its goal. `speed_mps`: measured."""
        driving = self._driving
        v = _stopping(speed_mps, driving.brake_mps2, self._times)
        w = _stopping(self._turn, driving.turn_accel_radps2, self._times)
        headings = pose[2] + np.cumsum(w) * STEP_S
        ways = np.stack((np.cos(headings), np.sin(headings)), axis=1) * v[:, None] * STEP_S
        self._speed = float(_stopping(speed_mps, driving.brake_mps2, np.array(CONTROL_S)))
        self._turn = float(_stopping(self._turn, driving.turn_accel_radps2, np.array(CONTROL_S)))
        self._shift = 0.0
        return Choice(self._speed, self._turn, np.array(pose[:2]) + np.cumsum(ways, axis=0), headings, 0.0, 0.0)

    def _bearing_rad(self, pose: tuple[float, float, float], route: Array) -> float:
        """Return the bearing of the point of the route that the robot aims at."""
        nearest = int(np.argmin(np.hypot(route[:15, 0] - pose[0], route[:15, 1] - pose[1])))
        x, y = route[min(nearest + int((_AIM_M + _AIM_S * abs(self._speed)) / SPACING_M), len(route) - 1)]
        return wrap_angle(atan2(y - pose[1], x - pose[0]) - pose[2])

    def _drive(
        self, pose: tuple[float, float, float], route: Array, *, about: bool
    ) -> tuple[Array, Array, Array, Array, Array, Array]:
        """Simulate all candidates: x, y, v, heading [STEPS, candidates], and the first commanded v and w of each."""
        driving, count = self._driving, len(self._pace)
        line, left = _line_and_left(route)
        last = len(line) - 1
        # The route shifted to each side, flattened, so that a candidate's target point is one look-up.
        aims_x = (line[:, 0] + _SIDES[:, None] * left[:, 0]).ravel()
        aims_y = (line[:, 1] + _SIDES[:, None] * left[:, 1]).ravel()
        row = self._side_row * (last + 1)
        x, y, heading = (np.full(count, value) for value in pose)
        c, s = np.cos(heading), np.sin(heading)
        v, w = np.full(count, self._speed), np.full(count, self._turn)
        # The robot's position along the route: the nearest of the first points.
        gaps = np.hypot(line[:15, 0] - pose[0], line[:15, 1] - pose[1])
        along = np.full(count, float(np.argmin(gaps)) * SPACING_M)
        out = np.empty((4, STEPS, count))
        first: tuple[Array, Array] = (v, w)
        top, turn_step = driving.turn_radps, driving.turn_accel_radps2 * STEP_S
        brake, accel = driving.brake_mps2 * STEP_S, driving.accel_mps2 * STEP_S
        leftwards = np.full(count, about)
        for step in range(STEPS):
            ahead = ((along + _AIM_M + _AIM_S * np.abs(v)) * (1.0 / SPACING_M)).astype(np.int64)
            at = row + np.minimum(ahead, last)
            dx, dy = aims_x[at] - x, aims_y[at] - y
            fore, side = c * dx + s * dy, c * dy - s * dx
            error = np.arctan2(side, fore)
            error = np.where(leftwards & (error < 0.0), error + 2 * pi, error)
            leftwards &= error > pi / 2
            aimed = np.maximum(fore, 0.0) / np.maximum(np.sqrt(fore * fore + side * side), 1e-6)
            want_v = np.where(self._is_fixed, self._fixed_v, self._pace * aimed * aimed)
            turning = np.minimum(np.maximum(1.8 * error, -top), top)
            # A waiting robot stands still unless the route lies to one side.
            turning = np.where(self._waits & (np.abs(error) < 0.5), 0.0, turning)
            want_w = np.where(self._is_fixed, self._fixed_w, turning)
            if step == 0:
                first = (want_v, want_w)
            v = v + np.minimum(np.maximum(want_v - v, -brake), accel)
            w = w + np.minimum(np.maximum(want_w - w, -turn_step), turn_step)
            heading = heading + w * STEP_S
            c, s = np.cos(heading), np.sin(heading)
            x = x + v * c * STEP_S
            y = y + v * s * STEP_S
            along = along + np.maximum(v * aimed, 0.0) * STEP_S
            out[0, step], out[1, step], out[2, step], out[3, step] = x, y, v, heading
        return out[0], out[1], out[2], out[3], *first

    def _progress(self, x: Array, y: Array, route: Array) -> Array:
        """Return the progress cost [candidates]: minus the distance along the route, relative to that at top speed."""
        end = np.stack((x[-1], y[-1]), axis=1)
        gaps = np.hypot(end[:, None, 0] - route[None, :, 0], end[:, None, 1] - route[None, :, 1])
        nearest = np.argmin(gaps, axis=1)
        behind = np.where(nearest == 0, gaps[:, 0], 0.0)
        reach = self._driving.speed_mps * STEPS * STEP_S
        off = np.maximum(gaps[np.arange(len(end)), nearest] - 1.2, 0.0)
        return np.asarray(-(nearest * SPACING_M - behind - off) / reach)

    def _walls(self, x: Array, y: Array, heading: Array) -> Array:
        """Return the cost of approaching obstacles [candidates]."""
        driving = self._driving
        dx, dy = driving.body_reach_m * np.cos(heading), driving.body_reach_m * np.sin(heading)
        nose = self._grid.clearances_at(np.stack((x + dx, y + dy), axis=-1))
        tail = self._grid.clearances_at(np.stack((x - dx, y - dy), axis=-1))
        room = np.minimum(nose, tail) - driving.body_radius_m
        # The robot may always leave its current place, even if that is too narrow.
        here = float(np.min(room[0])) if len(room) else 0.0
        hit = _within((min(0.08, here) - room) / 0.1, 2.0)
        tight = _within(1.0 - room / 0.25, 1.0)
        return np.asarray(9.0 * np.max(hit * self._near_term[:, None], axis=0) + 0.25 * np.mean(tight * tight, axis=0))

    def _people(
        self, x: Array, y: Array, v: Array, heading: Array, people: Array, velocities: Array, patience: float
    ) -> Array:
        """Return the cost of passing near people [candidates]."""
        times = np.minimum(self._times, 3.0)
        px = people[:, 0] + velocities[:, 0] * times[:, None]
        py = people[:, 1] + velocities[:, 1] * times[:, None]
        driving = self._driving
        dx, dy = x[:, None, :] - px[:, :, None], y[:, None, :] - py[:, :, None]
        # At the robot's centre the benchmark's collision distance applies, at its front physical contact.
        reach_x, reach_y = driving.body_reach_m * np.cos(heading), driving.body_reach_m * np.sin(heading)
        nose = np.sqrt((dx + reach_x[:, None, :]) ** 2 + (dy + reach_y[:, None, :]) ** 2)
        gaps = np.minimum(np.sqrt(dx * dx + dy * dy) - PERSON_M, nose - (driving.body_radius_m + PERSON_RADIUS_M))
        # Predictions are uncertain, more so for fast walkers.
        unsure = 0.05 * self._times[:, None] * np.minimum(np.hypot(velocities[:, 0], velocities[:, 1]), 1.5)
        # The robot may pass closer at low speed and after a long wait.
        margin_m = driving.margin_m * max(patience, 0.4) * (0.4 + 0.6 * _within(np.abs(v) / 0.8, 1.0))
        room = gaps - margin_m[:, None, :] - np.minimum(unsure, 0.25)[:, :, None]
        hit = _within(-room / 0.25, 2.5)
        near = _within(1.0 - room / (driving.comfort_m * patience), 1.0)
        # People avoid a standing robot, so contact then is mostly their responsibility; less so if the robot moves.
        blame = (0.3 + 0.7 * _within(np.abs(v) / 0.35, 1.0))[:, None, :]
        weights = self._near_term[:, None, None] * blame
        worst = np.max(hit * weights, axis=0)
        return np.asarray(
            4.0 * np.max(worst, axis=0)
            + 1.0 * np.sum(np.mean(hit * weights, axis=0), axis=0)
            + 0.7 * np.sum(np.mean(near * near * weights, axis=0), axis=0)
        )


def _line_and_left(route: Array) -> tuple[Array, Array]:
    """Return the route with at least two points, and the unit vector to its left at each point."""
    if len(route) < 2:
        route = np.vstack((route, route + np.array((1e-3, 0.0))))
    ways = np.diff(route, axis=0, append=2 * route[-1:] - route[-2:-1])
    lengths = np.maximum(np.hypot(ways[:, 0], ways[:, 1]), 1e-9)
    return route, np.stack((-ways[:, 1] / lengths, ways[:, 0] / lengths), axis=1)


def _stopping(value: float, rate: float, times_s: NDArray[np.floating]) -> Array:
    """Return a value at the given times while it is reduced to zero at a constant rate."""
    return np.asarray(np.sign(value) * np.maximum(abs(value) - rate * times_s, 0.0))


def _slew(value: float, target: float, down: float, up: float) -> float:
    return value + min(max(target - value, -down), up)


def _within(values: Array, top: float) -> Array:
    """Clip to 0..top; faster than numpy.clip for small arrays."""
    return np.minimum(np.maximum(values, 0.0), top)
