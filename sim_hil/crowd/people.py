"""People of a scene: they walk to places, stand, sit, queue, walk in groups, and avoid each other and the robot.

At 30 Hz everybody accelerates towards the chosen velocity and is kept out of walls, other people and the robot. At
10 Hz people perceive, decide and choose a velocity. There is no physics engine.
"""

from __future__ import annotations

from math import hypot, pi
from typing import Final

import numpy as np

from sim_hil.crowd.looks import Appearance, appearances
from sim_hil.crowd.plans import Plans
from sim_hil.crowd.senses import ObservedRobot, RobotWatch, notice
from sim_hil.crowd.spots import Destinations
from sim_hil.crowd.state import Activity, Array, Crowd, Ints
from sim_hil.crowd.steering import Nearby, choose
from sim_hil.crowd.walkable_map import BODY_RADIUS_M
from sim_hil.scene.scene import Scene

__all__ = [
    "GESTURES", "PERSON_HEIGHT_M", "PERSON_RADIUS_M", "RENDER_FIELDS", "UPDATE_HZ", "Appearance", "People",
    "appearances",
]  # fmt: skip

UPDATE_HZ = 30
PERSON_RADIUS_M = BODY_RADIUS_M
PERSON_HEIGHT_M = 1.72
# x m, y m, heading rad, gait phase in [0, 1), swing amplitude, ground z m, sitting 0..1, gesture (index of GESTURES)
RENDER_FIELDS = 8
GESTURES = ("none", "talking", "phone")

_DECIDE_EVERY = 3  # steps
_STAGGER_FROM = 40  # with more people than this, a third of them decides in each step
_START_CLEAR_M = 2.5  # least distance from the robot's start to a person's
_NEIGHBOURS, _NEIGHBOURS_M = 8, 5.0
_TOUCH_M, _CLOSE_M = 0.50, 0.85  # centre distance of two people: least when steering, and preferred
_MATES_TOUCH_M, _MATES_CLOSE_M = 0.48, 0.60
_SQUEEZE_TOUCH_M, _SQUEEZE_CLOSE_M = 0.45, 0.55
_BODIES_M = 0.45  # least centre distance of two people
_ROBOT_AXIS_M = 0.22  # the robot is a capsule of this half length around its heading
_ROBOT_TOUCH_M, _ROBOT_BODY_M = 0.62, 0.56  # distance from its axis: least when steering, and limit of own motion
_ROBOT_TOUCHED_M = 0.40  # distance at which bodies touch; a person unaware of the robot walks up to it
_ROBOT_STANDS_MPS = 0.15
_PUSHED: Final = np.array((1.0, 1.0, 0.15, 0.3, 0.0))  # mobility when pushed, by activity
_WALL_M = 0.22
_HURRY_PER_S = 0.3  # see steering.choose
_SPEED_UP_MPS2, _BRAKE_MPS2 = 1.8, 3.5
_FASTEST_MPS, _SIT_DOWN_MPS = 1.9, 0.6
_TURN_RADPS, _TURN = 2.8, 2 * pi
_STEP_PER_ROOT_SPEED = 0.6245  # step length m = this * sqrt(speed): a walk ratio of 0.0065 m min (Sekiya et al. 1996)
_FULL_STEP_M = 0.71  # step length at swing amplitude 1


class People:
    """All people of a scene; deterministic per seed. Call `step` every 1/UPDATE_HZ seconds of simulation time.

    Nobody starts within 2.5 m of the scene's start. Raises ValueError if the scene has no room for `count` people.
    """

    def __init__(self, scene: Scene, count: int, seed: int, destinations: Destinations | None = None) -> None:
        """`destinations`: those of the scene, computed before; None: they are drawn with the seed."""
        if count < 0:
            raise ValueError(f"people: expected 0 or more, found {count}")
        rng = np.random.default_rng((seed, 7))
        self._crowd = Crowd(count, rng)
        self._steps = 0
        self._watch = RobotWatch(_ROBOT_AXIS_M)
        if count:
            known = Destinations.of(scene, count, rng) if destinations is None else destinations
            self._ways = known.ways
            self._plans = Plans(scene, known, self._crowd, rng)
            self._plans.settle(scene, _START_CLEAR_M)
            nothing = np.zeros(0, dtype=np.int64)
            self._pairs = [(nothing, nothing)] * _DECIDE_EVERY

    def __len__(self) -> int:
        return self._crowd.n

    def poses(self) -> Array:
        """Return the poses [n, 3]: x m, y m, heading rad."""
        return np.stack((self._crowd.x, self._crowd.y, self._crowd.heading), axis=1)

    def velocities(self) -> Array:
        """Return the velocities [n, 2] in the world frame, m/s."""
        return np.stack((self._crowd.vx, self._crowd.vy), axis=1)

    def blocked_s(self) -> Array:
        """Return for how long each person has tried to move without getting 0.4 m further [n], s."""
        return self._crowd.blocked_s.copy()

    def render_rows(self) -> Array:
        """Return the render state of each person [n, RENDER_FIELDS]."""
        crowd = self._crowd
        ground = self._ways.heights_at(crowd.x, crowd.y) if crowd.n else np.zeros(0)
        columns = (crowd.x, crowd.y, crowd.heading, crowd.phase, crowd.swing, ground, crowd.sitting, crowd.gesture)
        return np.stack(columns, axis=1)

    def step(self, robot_x_m: float, robot_y_m: float, robot_heading_rad: float) -> None:
        """Advance everybody by 1/UPDATE_HZ s, given the robot's pose."""
        crowd = self._crowd
        if not crowd.n:
            return
        dt = 1.0 / UPDATE_HZ
        robot = self._watch.step(robot_x_m, robot_y_m, robot_heading_rad, dt)
        turn = self._steps % _DECIDE_EVERY
        if turn == 0:
            notice(crowd, self._ways, robot, dt * _DECIDE_EVERY)
            self._plans.update(self._steps * dt, dt * _DECIDE_EVERY, robot)
        if crowd.n > _STAGGER_FROM:
            self._decide(np.arange(turn, crowd.n, _DECIDE_EVERY), turn, robot)
        elif turn == 0:
            self._decide(np.arange(crowd.n), turn, robot)
        self._move(robot, dt)
        self._turn_and_stride(dt)
        self._steps += 1

    # -- picking a velocity ----------------------------------------------------------------------------------------

    def _decide(self, who: Ints, turn: int, robot: ObservedRobot) -> None:
        """Choose new velocities for these people."""
        crowd = self._crowd
        dx = crowd.x[None, :] - crowd.x[who, None]
        dy = crowd.y[None, :] - crowd.y[who, None]
        gap2 = dx * dx + dy * dy
        gap2[np.arange(len(who)), who] = np.inf
        mine, theirs = np.nonzero(gap2 < 1.0)
        self._pairs[turn] = (who[mine], theirs)

        active = np.flatnonzero((crowd.preferred_vx[who] != 0.0) | (crowd.preferred_vy[who] != 0.0))
        crowd.chosen_vx[who] = crowd.chosen_vy[who] = 0.0
        crowd.meet_s[who] = 1e3
        if not len(active):
            return
        me = who[active]
        gap2 = gap2[active]
        count = min(_NEIGHBOURS, crowd.n)
        near = np.argpartition(gap2, count - 1, axis=1)[:, :count] if crowd.n > count else np.tile(
            np.arange(crowd.n), (len(me), 1)
        )  # fmt: skip
        rows = np.arange(len(me))[:, None]
        nearby = self._around(me, near, dx[active[:, None], near], dy[active[:, None], near], gap2[rows, near], robot)
        preferred = crowd.preferred_vx[me], crowd.preferred_vy[me]
        pace = np.maximum(np.sqrt(preferred[0] * preferred[0] + preferred[1] * preferred[1]), 0.35)
        hurry = _HURRY_PER_S * np.minimum(crowd.stuck_s[me], 5.0)
        picked = choose(
            self._ways, (crowd.x[me], crowd.y[me]), (crowd.vx[me], crowd.vy[me]), preferred, pace, hurry, nearby
        )  # fmt: skip
        crowd.chosen_vx[me], crowd.chosen_vy[me], crowd.meet_s[me] = picked

    def _around(self, me: Ints, near: Ints, dx: Array, dy: Array, gap2: Array, robot: ObservedRobot) -> Nearby:
        crowd = self._crowd
        vx, vy = crowd.vx[near], crowd.vy[near]
        # Walking people share the avoidance; standing people are obstacles.
        walks = (crowd.preferred_vx[near] != 0.0) | (crowd.preferred_vy[near] != 0.0)
        mates = crowd.group[near] == crowd.group[me][:, None]
        squeeze = (crowd.squeeze_s[me] > 0.0)[:, None]
        touch = np.where(squeeze, _SQUEEZE_TOUCH_M, np.where(mates, _MATES_TOUCH_M, _TOUCH_M))
        close = np.where(squeeze, _SQUEEZE_CLOSE_M, np.where(mates, _MATES_CLOSE_M, _CLOSE_M))
        away = gap2 > _NEIGHBOURS_M * _NEIGHBOURS_M
        dx, dy = np.where(away, 1e3, dx), np.where(away, 1e3, dy)
        ux = np.where(walks, vx + crowd.vx[me][:, None], vx)
        uy = np.where(walks, vy + crowd.vy[me][:, None], vy)

        # The robot: three circles along its body. People do not rely on it to avoid them.
        aware = crowd.aware[me][:, None]
        along = np.array((-robot.axis_m, 0.0, robot.axis_m))
        rx = np.where(aware, robot.x + robot.c * along - crowd.x[me][:, None], 1e3)
        ry = np.where(aware, robot.y + robot.s * along - crowd.y[me][:, None], 1e3)
        shape = rx.shape
        personal = np.broadcast_to(np.where(squeeze, _ROBOT_TOUCH_M + 0.05, crowd.personal_m[me][:, None]), shape)
        return Nearby(
            x=np.concatenate((dx, rx), axis=1),
            y=np.concatenate((dy, ry), axis=1),
            ux=np.concatenate((ux, np.full(shape, robot.vx)), axis=1),
            uy=np.concatenate((uy, np.full(shape, robot.vy)), axis=1),
            share=np.concatenate((np.where(walks, 2.0, 1.0), np.ones(shape)), axis=1),
            touch=np.concatenate((touch, np.full(shape, _ROBOT_TOUCH_M)), axis=1),
            close=np.concatenate((close, personal), axis=1),
        )

    # -- moving ----------------------------------------------------------------------------------------------------

    def _move(self, robot: ObservedRobot, dt: float) -> None:
        crowd = self._crowd
        ax, ay = crowd.chosen_vx - crowd.vx, crowd.chosen_vy - crowd.vy
        size = np.sqrt(ax * ax + ay * ay) + 1e-9
        braking = (crowd.meet_s < 1.0) | (ax * crowd.vx + ay * crowd.vy < 0.0)
        limit = np.where(braking, _BRAKE_MPS2, _SPEED_UP_MPS2) * dt
        share = np.minimum(limit / size, 1.0)
        x = crowd.x + (crowd.vx + ax * share) * dt
        y = crowd.y + (crowd.vy + ay * share) * dt
        self._keep_apart(x, y)
        self._keep_off_robot(x, y, robot)
        self._keep_off_walls(x, y)

        sits = np.flatnonzero(crowd.activity == Activity.SIT)
        if len(sits):
            # Sitting down and getting up move the person at a fixed speed.
            dx, dy = crowd.target_x[sits] - crowd.x[sits], crowd.target_y[sits] - crowd.y[sits]
            share = np.minimum(_SIT_DOWN_MPS * dt / (np.sqrt(dx * dx + dy * dy) + 1e-9), 1.0)
            x[sits], y[sits] = crowd.x[sits] + dx * share, crowd.y[sits] + dy * share
        dx, dy = x - crowd.x, y - crowd.y
        most = _FASTEST_MPS * dt
        share = np.minimum(most / (np.sqrt(dx * dx + dy * dy) + 1e-9), 1.0)
        crowd.vx, crowd.vy = dx * (share / dt), dy * (share / dt)
        crowd.x, crowd.y = crowd.x + dx * share, crowd.y + dy * share

    def _keep_apart(self, x: Array, y: Array) -> None:
        """Push overlapping people apart; standing people move less than walking ones."""
        crowd = self._crowd
        turns = self._pairs if crowd.n > _STAGGER_FROM else self._pairs[:1]
        me = np.concatenate([pair[0] for pair in turns])
        if not len(me):
            return
        other = np.concatenate([pair[1] for pair in turns])
        dx, dy = x[me] - x[other], y[me] - y[other]
        gap = np.sqrt(dx * dx + dy * dy) + 1e-9
        over = np.flatnonzero(gap < _BODIES_M)
        if not len(over):
            return
        me, other = me[over], other[over]
        mine, theirs = _PUSHED[crowd.activity[me]], _PUSHED[crowd.activity[other]]
        push = (_BODIES_M - gap[over]) * mine / (mine + theirs + 1e-9) / gap[over]
        x += np.bincount(me, dx[over] * push, crowd.n)
        y += np.bincount(me, dy[over] * push, crowd.n)

    def _keep_off_robot(self, x: Array, y: Array, robot: ObservedRobot) -> None:
        """Keep people who are aware of the robot out of it, and push people whom it touches."""
        crowd = self._crowd
        if not (np.abs(x - robot.x) + np.abs(y - robot.y)).min() < 2.0:
            return
        rx, ry, gap = robot.nearest(x, y)
        close = np.flatnonzero((gap < _ROBOT_BODY_M) & (crowd.activity != Activity.SIT))
        stands = hypot(robot.vx, robot.vy) < _ROBOT_STANDS_MPS
        for k in close:
            if gap[k] > _ROBOT_TOUCHED_M and not crowd.aware[k]:
                continue
            nx, ny = rx[k] / (gap[k] + 1e-9), ry[k] / (gap[k] + 1e-9)
            inwards = (x[k] - crowd.x[k]) * nx + (y[k] - crowd.y[k]) * ny
            push = max(-inwards, 0.0)
            if gap[k] <= _ROBOT_TOUCHED_M:
                push += min(_ROBOT_TOUCHED_M - gap[k], 0.03)
            elif stands:
                # People move away from a standing robot; a driving robot must keep its own distance.
                push += min(_ROBOT_BODY_M - gap[k], 0.02)
            x[k] += nx * push
            y[k] += ny * push

    def _keep_off_walls(self, x: Array, y: Array) -> None:
        """Keep people out of walls; they slide along them."""
        crowd = self._crowd
        gap, slope_x, slope_y = self._ways.slopes_at(x, y)
        near = np.flatnonzero((gap < _WALL_M) & (crowd.activity != Activity.SIT))
        if not len(near):
            return
        norm = np.sqrt(slope_x[near] ** 2 + slope_y[near] ** 2) + 1e-9
        push = np.minimum(_WALL_M - gap[near], 0.06) / norm
        x[near] += slope_x[near] * push
        y[near] += slope_y[near] * push
        after = self._ways.slopes_at(x[near], y[near])[0]
        before = self._ways.slopes_at(crowd.x[near], crowd.y[near])[0]
        stuck = near[(after < 0.16) & (after < before)]
        x[stuck], y[stuck] = crowd.x[stuck], crowd.y[stuck]

    def _turn_and_stride(self, dt: float) -> None:
        crowd = self._crowd
        speed = np.sqrt(crowd.vx * crowd.vx + crowd.vy * crowd.vy)
        walks = speed > 0.2
        off = np.where(walks, np.arctan2(crowd.vy, crowd.vx), crowd.facing) - crowd.heading
        off -= _TURN * np.rint(off * (1.0 / _TURN))
        # A step back or aside does not change the heading; neither does an undefined direction (NaN).
        turns = (np.abs(off) < 2.0) | (speed > 0.6) | ~walks
        off = np.where(turns & (off == off), off, 0.0) * (6.0 * dt)
        heading = crowd.heading + np.minimum(np.maximum(off, -_TURN_RADPS * dt), _TURN_RADPS * dt)
        crowd.heading = heading - _TURN * np.rint(heading * (1.0 / _TURN))
        walking = speed * (crowd.sitting == 0.0)
        root = np.sqrt(walking) * crowd.stride
        # One cycle is two steps: speed / (2 step). The phase also moves the hands of people who talk.
        rate = np.where(
            walking > 0.05, root * (dt / (2.0 * _STEP_PER_ROOT_SPEED)), (crowd.gesture == 1.0) * (0.35 * dt)
        )
        phase = crowd.phase + rate
        crowd.phase = phase - np.floor(phase)
        step = np.minimum(root * (_STEP_PER_ROOT_SPEED / _FULL_STEP_M), 1.2)
        crowd.swing += (step - crowd.swing) * (dt / 0.2)
