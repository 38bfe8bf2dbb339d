"""Activities of people: destinations, waiting, sitting, queues and groups, and the resulting preferred velocities."""

from __future__ import annotations

from math import atan2, hypot

import numpy as np
from numpy.typing import NDArray

from sim_hil.crowd.courtesy import Courtesy, Jams
from sim_hil.crowd.groups import Groups
from sim_hil.crowd.senses import ObservedRobot
from sim_hil.crowd.spots import Destinations, Start
from sim_hil.crowd.state import Activity, Crowd
from sim_hil.scene.scene import Scene, Vec2

TALKING, PHONE = 1.0, 2.0
_WEIGHTS = {"way": 1.0, "stand": 1.6, "queue": 1.6, "sit": 1.2, "door": 1.0}
_STAY_S = {"way": (8.0, 30.0), "stand": (15.0, 60.0), "door": (1.5, 3.0), "sit": (30.0, 120.0)}
_SERVED_S = (4.0, 10.0)
_NEAR_M, _AT_M, _PASSED_M = 1.3, 0.3, 0.9
_OPEN_M, _WALL_SIDE_M = 0.85, 0.5  # people stand at points with more clearance than the first or less than the second
_GIVE_WAY_M = 0.75  # distance from the robot's body axis within which a standing person gives way
_SEAT_S = 1.2
_PASSAGES = frozenset(("corridor", "aisle", "street", "crossing"))
_GROUP_GAP_M = 0.9  # least clearance of a spot for a group
_STEP_BACK_S = 8.0  # blocked time after which a person steps back to let others pass
_PROGRESS_M = 0.4  # progress below which a person counts as stuck


class Plans:
    """Decision making for all people; `update`, called at 10 Hz, sets preferred velocities and facing directions."""

    def __init__(self, scene: Scene, destinations: Destinations, crowd: Crowd, rng: np.random.Generator) -> None:
        self._ways, self._crowd, self._rng = destinations.ways, crowd, rng
        self._spots, self._routes = destinations.spots, destinations.routes
        self._spot_gaps = self._ways.gaps_at(*(np.array([spot.reach[axis] for spot in self._spots]) for axis in (0, 1)))
        self._stop = np.array([_may_stop(scene, *spot.reach) for spot in self._spots])
        self._ends = np.array([spot.kind != "way" for spot in self._spots])
        self._queues: dict[int, list[int]] = {k: [] for k, s in enumerate(self._spots) if s.kind == "queue"}
        self._taken: dict[tuple[int, int], int] = {}  # (spot, slot) -> person
        self._slot = np.full(crowd.n, -1, dtype=np.int64)
        self._route = np.zeros(crowd.n, dtype=np.int64)
        self._onwards = np.ones(crowd.n, dtype=np.int64)
        self._groups = Groups(crowd, rng, alone=bool(self._routes))
        self._courtesy = Courtesy(crowd.n)
        self._jams = Jams(crowd.n)

    # -- the beginning ---------------------------------------------------------------------------------------------

    def settle(self, scene: Scene, clear_m: float) -> None:
        """Place everybody, further than `clear_m` from the robot's start. Raises ValueError if there is no room."""
        crowd, rng = self._crowd, self._rng
        start = Start(scene, clear_m, self._ways, crowd, rng)
        for person in range(crowd.n):
            together = int(self._groups.size[person]) > 1
            if crowd.leader[person] >= 0:
                start.beside(person, int(crowd.leader[person]))
            elif self._routes:
                self._start_on_route(person, start)
            elif together or rng.uniform() < 0.45 or not self._start_at_spot(person, start):
                start.anywhere(person)
                self._next(person)
                allowed = _may_stop(scene, float(crowd.x[person]), float(crowd.y[person]))
                if together and rng.uniform() < 0.45 and self._roomy(person, allowed):
                    self._hold(person, float(crowd.heading[person]), (5.0, 30.0))

    def _start_on_route(self, person: int, start: Start) -> None:
        crowd, rng = self._crowd, self._rng
        for _ in range(300):
            route = int(rng.integers(len(self._routes)))
            legs = self._routes[route]
            leg, share = int(rng.integers(len(legs) - 1)), float(rng.uniform())
            (ax, ay), (bx, by) = self._spots[legs[leg]].reach, self._spots[legs[leg + 1]].reach
            x, y = ax + (bx - ax) * share, ay + (by - ay) * share
            if start.fits(person, x, y):
                crowd.x[person], crowd.y[person] = x, y
                self._route[person], self._onwards[person] = route, 1 if rng.integers(2) else -1
                ahead = leg + 1 if self._onwards[person] > 0 else leg
                self._go(person, legs[ahead])
                goal = self._spots[legs[ahead]].reach
                crowd.heading[person] = atan2(goal[1] - y, goal[0] - x)
                return
        raise start.no_room()

    def _start_at_spot(self, person: int, start: Start) -> bool:
        """Start a person at a free spot, as if it had arrived earlier; return False if none is found."""
        crowd, rng = self._crowd, self._rng
        for _ in range(6):
            spot = int(rng.integers(len(self._spots)))
            what = self._spots[spot]
            if what.kind in ("way", "door"):
                continue
            slot = self._free_slot(spot)
            if slot < 0:
                continue
            x, y = what.slots[slot]
            if not start.fits(person, x, y, apart_m=0.6):
                continue
            crowd.x[person], crowd.y[person], crowd.heading[person] = x, y, what.heading_rad
            self._go(person, spot)
            self._arrive(person)
            if what.kind == "sit":
                crowd.sitting[person] = 1.0
            crowd.until_s[person] *= rng.uniform(0.2, 1.0)
            return True
        return False

    # -- single decisions ------------------------------------------------------------------------------------------

    def _go(self, person: int, spot: int) -> None:
        crowd = self._crowd
        self._leave(person)
        crowd.spot[person], crowd.activity[person] = spot, Activity.WALK
        crowd.facing[person], crowd.stuck_s[person] = np.nan, 0.0
        crowd.gesture[person] = PHONE if crowd.inattentive[person] else 0.0
        what = self._spots[spot]
        target = what.reach
        if what.kind in ("stand", "door"):
            slot = self._free_slot(spot)
            if slot >= 0:
                self._taken[spot, slot], self._slot[person] = person, slot
                target = what.slots[slot]
        crowd.target_x[person], crowd.target_y[person] = target

    def _leave(self, person: int) -> None:
        spot = int(self._crowd.spot[person])
        if spot in self._queues and person in self._queues[spot]:
            self._queues[spot].remove(person)
        if self._slot[person] >= 0:
            self._taken.pop((spot, int(self._slot[person])), None)
            self._slot[person] = -1

    def _free_slot(self, spot: int) -> int:
        """Return a free slot of a spot; -1 if it is full."""
        slots = self._spots[spot].slots
        if spot in self._queues:
            return len(self._queues[spot]) if len(self._queues[spot]) < len(slots) else -1
        return next((k for k in range(len(slots)) if (spot, k) not in self._taken), -1)

    def _next(self, person: int, away_from: Vec2 | None = None) -> None:
        """Choose the next destination; `away_from` is a blocked direction (unit x, y)."""
        crowd, rng = self._crowd, self._rng
        if self._routes:
            legs = self._routes[int(self._route[person])]
            at = legs.index(int(crowd.spot[person]))
            if away_from is not None or not 0 <= at + self._onwards[person] < len(legs):
                self._onwards[person] = -self._onwards[person]
            self._go(person, legs[min(max(at + int(self._onwards[person]), 0), len(legs) - 1)])
            return
        x, y = float(crowd.x[person]), float(crowd.y[person])
        costs = self._ways.ways_m(x, y)
        weights = np.zeros(len(self._spots))
        together = int(self._groups.size[person]) > 1
        for k, spot in enumerate(self._spots):
            if k == crowd.spot[person] or not 3.0 < costs[k] < np.inf:
                continue
            if spot.kind != "way" and (together or self._free_slot(k) < 0):
                continue
            if together and self._spot_gaps[k] < _GROUP_GAP_M:
                continue
            weights[k] = _WEIGHTS[spot.kind] / (1.0 + (costs[k] / 30.0) ** 2)
        weights /= self._jams.prices(self._ways, len(self._spots), x, y)
        if away_from is not None:
            everywhere = np.arange(len(self._spots))
            tx, ty = self._ways.ahead(everywhere, np.full(len(everywhere), x), np.full(len(everywhere), y))
            blocked = (tx - x) * away_from[0] + (ty - y) * away_from[1] > 0.3 * np.hypot(tx - x, ty - y)
            weights[blocked] *= 0.02
        total = float(weights.sum())
        if not total > 0:
            weights = np.where(self._ends, 0.01, 1.0)
            total = float(weights.sum())
        chosen = int(rng.choice(len(weights), p=weights / total))
        self._go(person, chosen)

    def _hold(self, person: int, heading: float, stay_s: tuple[float, float]) -> None:
        crowd, rng = self._crowd, self._rng
        crowd.activity[person] = Activity.HOLD
        crowd.target_x[person], crowd.target_y[person] = crowd.x[person], crowd.y[person]
        crowd.facing[person] = heading
        crowd.until_s[person] = crowd.now_s + float(rng.uniform(*stay_s))
        if int(self._groups.size[person]) > 1:
            crowd.gesture[person] = TALKING
        else:
            crowd.gesture[person] = PHONE if rng.uniform() < 0.4 else 0.0

    def _arrive(self, person: int) -> None:
        """Start the activity of the reached spot."""
        crowd, rng = self._crowd, self._rng
        spot = int(crowd.spot[person])
        what = self._spots[spot]
        if what.kind == "sit" and (spot, 0) not in self._taken:
            self._taken[spot, 0], self._slot[person] = person, 0
            crowd.activity[person] = Activity.SIT
            crowd.facing[person] = what.heading_rad
            crowd.gesture[person] = PHONE if rng.uniform() < 0.4 else 0.0
            crowd.until_s[person] = crowd.now_s + float(rng.uniform(*_STAY_S["sit"]))
        elif what.kind == "queue" and self._free_slot(spot) >= 0:
            self._queues[spot].append(person)
            crowd.activity[person], crowd.until_s[person] = Activity.QUEUE, np.inf
            crowd.gesture[person] = PHONE if rng.uniform() < 0.3 else 0.0
        elif what.kind in ("stand", "door") and self._slot[person] >= 0:
            self._hold(person, what.heading_rad, _STAY_S[what.kind])
        elif (
            what.kind == "way"
            and not self._routes
            and rng.uniform() < 0.35
            and self._roomy(person, bool(self._stop[spot]))
        ):
            self._hold(person, float(crowd.heading[person]), _STAY_S["way"])
        else:
            self._next(person)

    def _roomy(self, person: int, area_allows: bool) -> bool:
        """Return whether a person may stand here: in the open, or alone next to a wall."""
        at = self._crowd.x[person : person + 1], self._crowd.y[person : person + 1]
        gap = float(self._ways.gaps_at(*at)[0])
        return (area_allows and gap > _OPEN_M) or (int(self._groups.size[person]) == 1 and gap < _WALL_SIDE_M)

    # -- ten times a second ----------------------------------------------------------------------------------------

    def update(self, now_s: float, dt: float, robot: ObservedRobot) -> None:
        """Take the decisions that are due and set everybody's preferred velocity."""
        crowd = self._crowd
        crowd.now_s = now_s
        walking = crowd.activity == Activity.WALK
        dx, dy = crowd.target_x - crowd.x, crowd.target_y - crowd.y
        distance = np.sqrt(dx * dx + dy * dy)
        for person in np.flatnonzero(walking & (distance < 3.0)):
            self._approach(int(person), float(distance[person]))
        for person in np.flatnonzero((now_s > crowd.until_s) & (crowd.activity >= Activity.HOLD)):
            if crowd.activity[person] != Activity.SIT or crowd.sitting[person] > 0.99:
                self._get_up(int(person))
        for spot, line in self._queues.items():
            if line:
                self._advance(spot, line)
        self._unstick(dt)
        self._jams.update(crowd, dt)
        if not self._routes:
            for person in self._jams.turn_round(crowd, self._ways, self._rng):
                self._next(int(person))
        self._courtesy.update(crowd, self._ways, robot, dt)
        self._set_preferred(robot)
        self._sit(dt)

    def _approach(self, person: int, distance: float) -> None:
        what = self._spots[int(self._crowd.spot[person])]
        if what.kind == "way":
            reached = distance < _PASSED_M
        elif what.kind == "queue":
            # A person joins a queue at its current tail.
            tail = self._free_slot(int(self._crowd.spot[person]))
            x, y = what.slots[tail]
            gap = hypot(self._crowd.x[person] - x, self._crowd.y[person] - y)
            reached = tail < 0 or gap < 1.6
        else:
            reached = distance < (0.5 if what.kind == "sit" else _AT_M)
        if reached:
            self._arrive(person)

    def _get_up(self, person: int) -> None:
        crowd = self._crowd
        if crowd.activity[person] == Activity.SIT:
            what = self._spots[int(crowd.spot[person])]
            near = np.hypot(crowd.x - what.reach[0], crowd.y - what.reach[1]) < 0.55
            near[person] = False
            if near.any():  # the space in front of the chair is occupied
                crowd.until_s[person] = crowd.now_s + 1.0
                return
            crowd.until_s[person] = -1.0  # getting up; _sit does the rest
            return
        self._next(person)

    def _advance(self, spot: int, line: list[int]) -> None:
        crowd, what = self._crowd, self._spots[spot]
        for place, person in enumerate(line):
            x, y = what.slots[place]
            ahead = what.slots[place - 1] if place else None
            crowd.target_x[person], crowd.target_y[person] = x, y
            crowd.facing[person] = atan2(ahead[1] - y, ahead[0] - x) if ahead else what.heading_rad
        first = line[0]
        if (
            crowd.until_s[first] == np.inf
            and hypot(crowd.x[first] - what.slots[0][0], crowd.y[first] - what.slots[0][1]) < 0.4
        ):
            crowd.until_s[first] = crowd.now_s + float(self._rng.uniform(*_SERVED_S))

    def _unstick(self, dt: float) -> None:
        """Update the blocked times; a person without progress squeezes through, turns back, or stays here."""
        crowd = self._crowd
        wants = crowd.preferred_vx * crowd.preferred_vx + crowd.preferred_vy * crowd.preferred_vy > 0.02
        got_on = np.hypot(crowd.x - crowd.anchor_x, crowd.y - crowd.anchor_y) > _PROGRESS_M
        fresh = got_on | ~wants
        crowd.anchor_x = np.where(fresh, crowd.x, crowd.anchor_x)
        crowd.anchor_y = np.where(fresh, crowd.y, crowd.anchor_y)
        crowd.stuck_s = np.where(fresh, 0.0, crowd.stuck_s + dt)
        crowd.blocked_s = np.where(fresh, 0.0, crowd.blocked_s + dt)
        crowd.squeeze_s -= dt
        for person in np.flatnonzero(crowd.stuck_s > crowd.patience_s):
            self._lose_patience(int(person))

    def _lose_patience(self, person: int) -> None:
        crowd = self._crowd
        crowd.stuck_s[person] = 0.0
        crowd.squeeze_s[person] = 3.0
        if crowd.blocked_s[person] > _STEP_BACK_S and crowd.activity[person] in (Activity.WALK, Activity.QUEUE):
            self._courtesy.step_back(person, crowd, self._ways)
        if crowd.activity[person] == Activity.WALK:
            spot = self._spots[int(crowd.spot[person])]
            left = hypot(crowd.target_x[person] - crowd.x[person], crowd.target_y[person] - crowd.y[person])
            if left < 1.2 and spot.kind == "stand":
                self._hold(person, float(crowd.heading[person]), (3.0, 8.0))
                return
            norm = hypot(crowd.preferred_vx[person], crowd.preferred_vy[person]) or 1.0
            self._next(person, away_from=(crowd.preferred_vx[person] / norm, crowd.preferred_vy[person] / norm))
        elif crowd.activity[person] == Activity.QUEUE and crowd.blocked_s[person] > _STEP_BACK_S:
            self._next(person)  # cannot reach the next place of the queue: leave it
        elif crowd.activity[person] == Activity.FOLLOW:
            self._groups.lose_patience(crowd, person)
        elif crowd.activity[person] == Activity.HOLD:
            crowd.target_x[person], crowd.target_y[person] = crowd.x[person], crowd.y[person]

    def _set_preferred(self, robot: ObservedRobot) -> None:
        crowd, ways = self._crowd, self._ways
        walking = np.flatnonzero(crowd.activity == Activity.WALK)
        preferred_vx, preferred_vy = np.zeros(crowd.n), np.zeros(crowd.n)
        if len(walking):
            preferred_vx[walking], preferred_vy[walking] = self._on_the_way(walking)
        standing = np.flatnonzero((crowd.activity == Activity.HOLD) | (crowd.activity == Activity.QUEUE))
        if len(standing):
            preferred_vx[standing], preferred_vy[standing] = self._stay_put(standing, robot)
        self._groups.set_preferred(crowd, ways, preferred_vx, preferred_vy)
        self._courtesy.override(crowd, preferred_vx, preferred_vy)
        crowd.preferred_vx, crowd.preferred_vy = preferred_vx, preferred_vy

    def _on_the_way(self, who: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        crowd, ways = self._crowd, self._ways
        x, y = crowd.x[who], crowd.y[who]
        tx, ty = ways.ahead(crowd.spot[who], x, y)
        fx, fy = crowd.target_x[who] - x, crowd.target_y[who] - y
        left = np.sqrt(fx * fx + fy * fy)
        dx, dy = tx - x, ty - y
        norm = np.sqrt(dx * dx + dy * dy) + 1e-9
        # Keep to the right of the route where there is room.
        lane = crowd.lane_m[who]
        sx, sy = tx + dy / norm * lane, ty - dx / norm * lane
        roomy = ways.gaps_at(sx, sy) > 0.5
        near = left < _NEAR_M
        dx = np.where(near, fx, np.where(roomy, sx - x, dx))
        dy = np.where(near, fy, np.where(roomy, sy - y, dy))
        norm = np.sqrt(dx * dx + dy * dy) + 1e-9
        pace = crowd.free_mps[who] * self._groups.patience()[who]
        ends = self._ends[crowd.spot[who]]
        pace = np.where(near & ends, np.minimum(pace, 0.35 + 0.6 * left), pace)
        return dx / norm * pace, dy / norm * pace

    def _stay_put(
        self, who: NDArray[np.int64], robot: ObservedRobot
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return standing people to their spots when pushed away, or slowly aside from an approaching robot."""
        crowd = self._crowd
        dx, dy = crowd.target_x[who] - crowd.x[who], crowd.target_y[who] - crowd.y[who]
        left = np.sqrt(dx * dx + dy * dy) + 1e-9
        rx, ry, gap = robot.nearest(crowd.x[who], crowd.y[who])
        pace = np.where((left > 0.22) & (gap > _GIVE_WAY_M + 0.3), np.minimum(0.75, 0.25 + left), 0.0)
        aside = crowd.aware[who] & (gap < _GIVE_WAY_M)
        back = 0.3 + 0.5 * (_GIVE_WAY_M - gap)
        preferred_vx = np.where(aside, rx / (gap + 1e-9) * back, dx / left * pace)
        preferred_vy = np.where(aside, ry / (gap + 1e-9) * back, dy / left * pace)
        return preferred_vx, preferred_vy

    def _sit(self, dt: float) -> None:
        """Advance sitting down and getting up, which ignore other people."""
        crowd = self._crowd
        for person in np.flatnonzero(crowd.activity == Activity.SIT):
            what = self._spots[int(crowd.spot[person])]
            down = crowd.until_s[person] >= 0.0
            crowd.sitting[person] = min(max(crowd.sitting[person] + (dt if down else -dt) / _SEAT_S, 0.0), 1.0)
            if not down and crowd.sitting[person] == 0.0:
                self._next(int(person))
                continue
            crowd.target_x[person], crowd.target_y[person] = what.slots[0] if down else what.reach


def _may_stop(scene: Scene, x: float, y: float) -> bool:
    """Return whether people may stand at a point: not in passages."""
    area = scene.area_at(x, y)
    return area is not None and area.kind not in _PASSAGES
