"""Walking people: to and fro along the scene's routes, giving way to the robot and to each other; no physics engine.

A simple social rule instead of a planner: keep to the route, slow down for whatever is close ahead, step aside to the
freer side (to the right when in doubt, so that two people who meet do not mirror each other), stop rather than push,
turn back when blocked for long. Velocities change smoothly; a person never enters the robot's or a wall's clearance.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from math import atan2, cos, hypot, pi, sin

import numpy as np
from numpy.typing import NDArray

from sim_hil.scene import Box, Route, Scene, Vec2

Array = NDArray[np.float64]
UPDATE_HZ = 30
PERSON_RADIUS_M = 0.22
PERSON_HEIGHT_M = 1.72
STRIDE_M = 1.35  # distance of one full gait cycle (two steps)
# x m, y m, heading rad, gait phase in [0, 1), swing amplitude in [0, 1], ground z m, sitting 0..1, gesture (GESTURES)
RENDER_FIELDS = 8
GESTURES = ("none", "talking", "phone")

_ROBOT_HALF_AXIS_M = 0.22  # the robot is a capsule of this half length around its heading
_ROBOT_CLEARANCE_M = 0.52
_WALL_CLEARANCE_M = 0.28
_PERSON_CLEARANCE_M = 0.55
_LOOK_AHEAD_M = 2.2
_BLOCKED_S = 4.0
_START_CLEAR_M = 2.5  # nobody starts closer to the robot than this


@dataclass(frozen=True)
class Appearance:
    """How a person looks: colours as RGB 0..255, and a scale of body height."""

    shirt: tuple[int, int, int]
    trousers: tuple[int, int, int]
    skin: tuple[int, int, int]
    hair: tuple[int, int, int]
    shoes: tuple[int, int, int]
    scale: float


_SHIRTS = ((188, 42, 40), (36, 88, 160), (232, 196, 70), (60, 130, 80), (235, 235, 230), (110, 60, 140), (225, 120, 40))
_TROUSERS = ((38, 44, 62), (70, 68, 64), (112, 92, 66), (28, 28, 30), (58, 82, 118))
_SKINS = ((241, 200, 170), (214, 160, 120), (160, 108, 74), (104, 68, 46))
_HAIRS = ((30, 24, 20), (86, 56, 30), (150, 110, 60), (120, 120, 122))


def appearances(count: int, seed: int, scene_name: str = "") -> list[Appearance]:
    """Looks of the first `count` people of a seed in a scene: the same in the physics and in the camera process."""
    rng = np.random.default_rng((seed, 11))
    shirts = rng.permutation(len(_SHIRTS))
    people = []
    for index in range(count):
        trousers, skin, hair = (int(rng.integers(len(pool))) for pool in (_TROUSERS, _SKINS, _HAIRS))
        shirt = _SHIRTS[int(shirts[index % len(_SHIRTS)])]
        scale = float(rng.uniform(0.93, 1.06))
        people.append(Appearance(shirt, _TROUSERS[trousers], _SKINS[skin], _HAIRS[hair], (24, 22, 22), scale))
    return people


class _Walker:
    """One person's motion."""

    def __init__(
        self, route: Route, along: float, forward: bool, speed_mps: float, lane_m: float, phase: float
    ) -> None:
        self.points = [_shift(route.points_m, index, lane_m) for index in range(len(route.points_m))]
        self.x, self.y, self.next = _place(self.points, along, forward)
        self.step = 1 if forward else -1
        self.speed_mps = speed_mps
        self.vx = self.vy = 0.0
        target = self.points[self.next]
        self.heading = atan2(target[1] - self.y, target[0] - self.x)
        self.phase = phase
        self.amplitude = 0.0
        self.blocked_s = 0.0
        self.side = 0.0  # the side chosen for passing what is ahead: +1 left, -1 right

    def turn_back(self) -> None:
        self.step = -self.step
        self.next = min(max(self.next + self.step, 0), len(self.points) - 1)
        self.blocked_s = 0.0


def _shift(points: tuple[Vec2, ...], index: int, lane_m: float) -> Vec2:
    """A route's point moved sideways: people on one route do not walk in single file."""
    before, after = points[max(index - 1, 0)], points[min(index + 1, len(points) - 1)]
    dx, dy = after[0] - before[0], after[1] - before[1]
    norm = hypot(dx, dy) or 1.0
    return (points[index][0] - dy / norm * lane_m, points[index][1] + dx / norm * lane_m)


def _place(points: list[Vec2], along: float, forward: bool) -> tuple[float, float, int]:
    """Position at the fraction `along` of the polyline, and the index of the point to walk to next."""
    lengths = [hypot(b[0] - a[0], b[1] - a[1]) for a, b in itertools.pairwise(points)]
    rest = along * sum(lengths)
    for index, length in enumerate(lengths):
        if rest <= length or index == len(lengths) - 1:
            share = min(rest / length, 1.0)
            a, b = points[index], points[index + 1]
            return a[0] + (b[0] - a[0]) * share, a[1] + (b[1] - a[1]) * share, index + 1 if forward else index
        rest -= length
    raise AssertionError("a route has at least one segment")


class People:
    """All walkers of a scene. Deterministic per seed; `step` once every 1/UPDATE_HZ seconds of simulation time."""

    def __init__(self, scene: Scene, count: int, seed: int) -> None:
        if count < 0:
            raise ValueError(f"people: expected 0 or more, found {count}")
        if count and not scene.routes:
            raise ValueError(f"people: scene {scene.name} has no routes to walk on")
        rng = np.random.default_rng((seed, 7))
        order = rng.permutation(len(scene.routes)) if scene.routes else []
        self._boxes = [box for _, box in scene.obstacles()]
        self._walkers: list[_Walker] = []
        for index in range(count):
            route = scene.routes[int(order[index % len(order)])]
            self._walkers.append(self._spawn(rng, scene, route))

    def _spawn(self, rng: np.random.Generator, scene: Scene, route: Route) -> _Walker:
        for _ in range(200):
            walker = _Walker(
                route,
                along=float(rng.uniform(0, 1)),
                forward=bool(rng.integers(2)),
                speed_mps=float(rng.uniform(0.8, 1.3)),
                lane_m=float(rng.uniform(-0.2, 0.2)),
                phase=float(rng.uniform(0, 1)),
            )
            far = hypot(walker.x - scene.start[0], walker.y - scene.start[1]) > _START_CLEAR_M
            alone = all(hypot(walker.x - o.x, walker.y - o.y) > 2 * _PERSON_CLEARANCE_M for o in self._walkers)
            if far and alone and self._wall_gap(walker.x, walker.y) > _WALL_CLEARANCE_M:
                return walker
        raise ValueError(f"people: no room for another person in scene {scene.name}")

    def __len__(self) -> int:
        return len(self._walkers)

    def poses(self) -> Array:
        """[n, 3]: x m, y m, heading rad."""
        return np.array([(w.x, w.y, w.heading) for w in self._walkers], dtype=np.float64).reshape(-1, 3)

    def render_rows(self) -> Array:
        """[n, RENDER_FIELDS]: what a renderer needs of each person."""
        rows = [(w.x, w.y, w.heading, w.phase, w.amplitude, 0.0, 0.0, 0.0) for w in self._walkers]
        return np.array(rows, dtype=np.float64).reshape(-1, RENDER_FIELDS)

    def step(self, robot_x_m: float, robot_y_m: float, robot_heading_rad: float) -> None:
        """Move everybody by 1/UPDATE_HZ s, given where the robot is."""
        dt = 1.0 / UPDATE_HZ
        ax, ay = cos(robot_heading_rad) * _ROBOT_HALF_AXIS_M, sin(robot_heading_rad) * _ROBOT_HALF_AXIS_M
        for walker in self._walkers:
            self._move(walker, (robot_x_m, robot_y_m), (ax, ay), dt)

    def _move(self, me: _Walker, robot: Vec2, axis: Vec2, dt: float) -> None:
        goal = me.points[me.next]
        gx, gy = goal[0] - me.x, goal[1] - me.y
        distance = hypot(gx, gy)
        if distance < 0.5:
            if not 0 <= me.next + me.step < len(me.points):
                me.step = -me.step
            me.next += me.step
            goal = me.points[me.next]
            gx, gy = goal[0] - me.x, goal[1] - me.y
            distance = hypot(gx, gy)
        dx, dy = gx / distance, gy / distance

        near_x, near_y = _nearest_on_robot(me.x, me.y, robot, axis)
        robot_gap = hypot(me.x - near_x, me.y - near_y)
        pace, aside = self._give_way(me, (dx, dy), (near_x, near_y))
        want_x = dx * me.speed_mps * pace - dy * aside
        want_y = dy * me.speed_mps * pace + dx * aside
        if robot_gap < 0.85:
            # Somebody whom the robot walks up to steps back, as far as there is room.
            back = 0.7 * (0.85 - robot_gap) / 0.35
            want_x += back * (me.x - near_x) / max(robot_gap, 1e-6)
            want_y += back * (me.y - near_y) / max(robot_gap, 1e-6)
        blend = min(dt / 0.25, 1.0)
        me.vx += (want_x - me.vx) * blend
        me.vy += (want_y - me.vy) * blend
        self._advance(me, robot, axis, robot_gap, dt)

        speed = hypot(me.vx, me.vy)
        if speed < 0.2:
            me.blocked_s += dt
            if me.blocked_s > _BLOCKED_S:
                me.turn_back()
        else:
            me.blocked_s = max(0.0, me.blocked_s - 0.5 * dt)
        if speed > 0.12:
            turn = (atan2(me.vy, me.vx) - me.heading + pi) % (2 * pi) - pi
            # Stepping back is not turning round: the body keeps facing where the person wants to go.
            if abs(turn) > 2.4 and robot_gap < 0.9:
                turn = 0.0
            me.heading += min(max(turn, -3.0 * dt), 3.0 * dt)
            me.heading = (me.heading + pi) % (2 * pi) - pi
        me.phase = (me.phase + speed * dt / STRIDE_M) % 1.0
        me.amplitude += (min(speed / 0.9, 1.0) - me.amplitude) * min(dt / 0.2, 1.0)

    def _give_way(self, me: _Walker, direction: Vec2, robot_point: Vec2) -> tuple[float, float]:
        """Share of the own pace, 0..1, and sideways velocity (left positive), m/s, for what is ahead."""
        dx, dy = direction
        pace, urgency, aside = 1.0, 0.0, 0.0
        others = [(w.x, w.y, 0.62, _PERSON_CLEARANCE_M) for w in self._walkers if w is not me]
        others.append((*robot_point, 0.75, _ROBOT_CLEARANCE_M))
        for ox, oy, width, stop in others:
            rx, ry = ox - me.x, oy - me.y
            ahead = rx * dx + ry * dy
            if not -0.1 < ahead < _LOOK_AHEAD_M:
                continue
            left = -rx * dy + ry * dx
            if abs(left) > width:
                continue
            gap = hypot(rx, ry)
            overlap = 1.0 - abs(left) / width
            pace = min(pace, max(0.0, min(1.0, (gap - stop) / 1.1 + (1.0 - overlap) * 0.5)))
            if overlap > urgency:
                urgency = overlap
                if me.side == 0.0 or abs(left) > 0.2:
                    me.side = -1.0 if left > -0.05 else 1.0
                aside = me.side * (0.25 + 0.45 * overlap)
        if urgency == 0.0:
            me.side = 0.0
        elif self._wall_gap(me.x - dy * me.side * 0.35, me.y + dx * me.side * 0.35) < _WALL_CLEARANCE_M:
            # No room on this side: try the other one.
            me.side = -me.side
            aside = 0.0
        return pace, aside

    def _advance(self, me: _Walker, robot: Vec2, axis: Vec2, robot_gap: float, dt: float) -> None:
        """Move, dropping whatever would come too near a wall, the robot or another person."""
        here = self._wall_gap(me.x, me.y)
        for share_x, share_y in ((1.0, 1.0), (1.0, 0.0), (0.0, 1.0)):
            x, y = me.x + me.vx * share_x * dt, me.y + me.vy * share_y * dt
            wall = self._wall_gap(x, y)
            if wall < _WALL_CLEARANCE_M and wall < here:
                continue
            px, py = _nearest_on_robot(x, y, robot, axis)
            gap = hypot(x - px, y - py)
            if gap < _ROBOT_CLEARANCE_M and gap < robot_gap:
                continue
            if any(
                w is not me and hypot(x - w.x, y - w.y) < min(_PERSON_CLEARANCE_M - 0.05, hypot(me.x - w.x, me.y - w.y))
                for w in self._walkers
            ):
                continue
            me.x, me.y = x, y
            me.vx, me.vy = me.vx * share_x, me.vy * share_y
            return
        me.vx = me.vy = 0.0

    def _wall_gap(self, x: float, y: float) -> float:
        """Distance to the nearest wall or solid object, m (capped at 1)."""
        best = 1.0
        for box in self._boxes:
            gap = _box_gap(box, x, y)
            if gap < best:
                best = gap
        return best


def _box_gap(box: Box, x: float, y: float) -> float:
    rx, ry = x - box.centre_m[0], y - box.centre_m[1]
    c, s = box.axis
    u = abs(rx * c + ry * s) - box.size_m[0] / 2
    v = abs(-rx * s + ry * c) - box.size_m[1] / 2
    if u <= 0:
        return v if v > 0 else 0.0
    return u if v <= 0 else hypot(u, v)


def _nearest_on_robot(x: float, y: float, robot: Vec2, axis: Vec2) -> Vec2:
    length2 = axis[0] * axis[0] + axis[1] * axis[1]
    share = ((x - robot[0]) * axis[0] + (y - robot[1]) * axis[1]) / length2
    share = min(max(share, -1.0), 1.0)
    return (robot[0] + axis[0] * share, robot[1] + axis[1] * share)
