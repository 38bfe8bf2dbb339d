"""The reasoning text that is true of an instant, from the simulated world: only what the robot's camera sees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import atan2, cos, hypot, radians, sin, tan
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from edge.core.geometry import SE2, wrap_angle
from edge.state.reasoning_text import (
    AHEAD,
    AREAS,
    LEFT,
    OPEN_AREA,
    RIGHT,
    Plan,
    ReasoningText,
    SeenObject,
    SeenPerson,
    Situation,
    Stop,
    Turn,
    TurnBack,
)
from sim_hil.benchmark.language.openings import Frame, Opening, bounds_of
from sim_hil.benchmark.language.route import Step
from sim_hil.benchmark.language.task_checks import MIN_PIXELS, RANGE_INDOORS_M, RANGE_OUTDOORS_M
from sim_hil.benchmark.language.visibility import EYE_M, HFOV_RAD
from sim_hil.benchmark.policies.expert_motion import ABOUT_RAD
from sim_hil.scene.scene import SceneObject, Vec2, Vec3
from sim_hil.simulation.camera import MOUNTS
from tools.train.drives.progress_labels import RouteProgress
from tools.train.drives.scenarios import Scenario
from tools.train.drives.trace_sentences import (
    MAX_OBJECTS,
    MAX_PEOPLE,
    five_aspects,
    opening_name,
    plan_metres,
    whole_metres,
)

Array = NDArray[np.float64]

PEOPLE_M: Final = 6.0  # people farther away are not mentioned
_MANY: Final = (1, 4)  # least number of people in view within PEOPLE_M that count as few, many
_AHEAD_RAD: Final = radians(15.0)
_STANDING_MPS: Final = 0.2
_ALONG: Final = cos(radians(30.0))
_BODY_M: Final = (0.35, 0.5, 1.7)  # a person's depth, width, height
_SHOWN, _WHOLE_PX = 0.2, 4400.0  # least visible share of a person, and a whole person's pixels at 1 m
_SLEEVE_M: Final = 0.1  # a person whose centre is farther outside the image is not visible
_WAIT_M: Final = 0.5  # a planned position in 3 s within this distance counts as waiting
_WAIT_FOR_M: Final = 2.5  # the robot waits only for a person within this distance
_INSIDE_M: Final = 0.2  # depth inside an opening of the point whose visibility is tested
_BACK_M: Final = -0.3  # a planned x in 3 s below this counts as turning back
_ASIDE_RAD: Final = radians(60.0)  # off the route, so does a planned bearing beyond this that no near turn explains
_NEAR_TURN_M: Final = 3.0  # largest distance of a turn that explains it
_AGAINST: Final = -0.5  # cosine between a heading and a leg's direction below which the robot drives the leg backwards
_BESIDE_M: Final = 1.0  # up to this walking distance to the route, the robot drives beside it and is not off it
_HERE_M: Final = 0.05  # a planned position within this distance means staying
_ON_M: Final = 2.0  # x in 3 s that is assumed without a plan: the robot drives on
_EYES_M: Final = {"go2": EYE_M, "carter": MOUNTS["carter"].position_m[2]}  # camera height; the Go2's while standing


def turning_first(point: Vec2, turn_radps: float, speed_mps: float) -> Vec2:
    """Return the position in 3 s, m in the robot frame, of a robot that first turns to a point, as the expert does.

    A point far behind gives a position behind the robot, which means turning around.
    """
    bearing, gap_m = atan2(point[1], point[0]), hypot(*point)
    if gap_m < _HERE_M:
        return (_ON_M, 0.0)  # it stays, without waiting for a person
    if abs(bearing) > ABOUT_RAD:
        return (2.0 * _BACK_M, 0.0)
    gone_m = max(3.0 - abs(bearing) / turn_radps, 0.0) * speed_mps
    return gone_m * cos(bearing), gone_m * sin(bearing)


class Sight(Protocol):
    """Computes the visibility of objects (see `Sightlines`)."""

    def pixels(self, eye: Vec3, heading_rad: float, thing: SceneObject, range_m: float) -> float:
        """Return the visible pixels of an object in a 128 x 128 image."""
        ...


class Tracer:
    """Writes the reasoning texts of one scenario's instants."""

    def __init__(
        self, scenario: Scenario, progress: RouteProgress | None = None, lines: Sight | None = None
    ) -> None:  # fmt: skip
        """`lines`: sightlines to use instead of the site's."""
        self._scene, route = scenario.scene, scenario.route
        self._lines: Sight = scenario.site.lines if lines is None else lines
        self.progress = RouteProgress(scenario) if progress is None else progress
        self._range_m = RANGE_OUTDOORS_M if scenario.site.outdoors else RANGE_INDOORS_M
        self._eye_ahead_m = MOUNTS[scenario.episode.robot].position_m[0]
        self._eye_up_m = _EYES_M[scenario.episode.robot]
        along = [thing for step in route.steps for thing in (*step.near, *step.passed)]
        self._named = frozenset(thing.label for thing in (*along, *route.passed))
        self._goal = next(thing for thing in self._scene.objects if thing.label == route.goal_label)
        self._others = [thing for thing in self._scene.landmarks() if thing is not self._goal]

    def trace(
        self, pose: SE2, people: Array, velocities: Array, plan_xy: Sequence[Sequence[float]] | None = None,
        driven_m: float | None = None,
    ) -> ReasoningText:  # fmt: skip
        """Describe the scene at a true pose among people [n, 2 or 3] (x m, y m, ...) with world velocities [n, 2], m/s.

        `plan_xy`: planned positions in 3 s (and later), m in the robot frame (see `turning_first`); without them
        waiting is not detected. `driven_m`: distance to where the driver means to be in 3 s, if the plan's is another.
        """
        crowd = self._people_in_view(pose, people)
        progress, step = self.progress.at(pose), self.progress.next_step(pose)
        left_m = self.progress.to_next_m(pose)
        ahead = any(gap < _WAIT_FOR_M and _side(pose, people[index]) == AHEAD for index, gap in crowd)
        x_m, y_m = (_ON_M, 0.0) if plan_xy is None else plan_xy[0][:2]
        missed = step is not None and 0 < step.ordinal <= progress.passed
        backwards = step is not None and _drives_backwards(pose, step, missed=missed)
        plan = Plan(Stop(plan_metres(left_m)))
        if step is not None:
            plan = Plan(Turn(_seen_side(step, backwards=backwards), step.kind, plan_metres(left_m)))
        if x_m < _BACK_M or (missed and not backwards) or self._returns(pose, (x_m, y_m), plan):
            plan = Plan(TurnBack())
        elif ahead and (hypot(x_m, y_m) if driven_m is None else driven_m) < _WAIT_M:
            plan = replace(plan, waits=True)
        near = [
            SeenPerson(_side(pose, people[index]), whole_metres(gap), _motion(pose, people[index], velocities[index]))
            for index, gap in crowd[:MAX_PEOPLE]
        ]
        bodies = [_body(people[index]) for index, _ in crowd]
        area = self._scene.area_at(pose.x_m, pose.y_m)
        kind = area.kind if area is not None and area.kind in AREAS else OPEN_AREA
        situation = Situation(kind, sum(len(crowd) >= least for least in _MANY))
        objects = self._objects(pose, step, bodies, backwards=backwards)
        return five_aspects(situation, objects, near, progress, plan)

    def off_m(self, pose: SE2) -> float:
        """Return the walking distance to the route, m, rounded as a drive's header has it."""
        return round(self.progress.strayed_m(pose), 1)

    def _returns(self, pose: SE2, point: Vec2, plan: Plan) -> bool:
        """Return whether a robot off its route is to head back to it, which the plan does not say."""
        bearing_rad, action = atan2(point[1], point[0]), plan.action
        if abs(bearing_rad) <= _ASIDE_RAD or self.progress.strayed_m(pose) <= _BESIDE_M:
            return False
        if isinstance(action, TurnBack) or action.distance_m > _NEAR_TURN_M:
            return True
        return isinstance(action, Turn) and action.side != (LEFT if bearing_rad > 0 else RIGHT)

    def _people_in_view(self, pose: SE2, people: Array) -> list[tuple[int, float]]:
        """Return indices and distances, m, of people in view within PEOPLE_M, nearest first."""
        gaps = np.hypot(people[:, 0] - pose.x_m, people[:, 1] - pose.y_m) if len(people) else np.zeros(0)
        found: list[tuple[int, float]] = []
        nearer: list[SceneObject] = []
        for index in np.argsort(gaps, kind="stable"):
            if gaps[index] >= PEOPLE_M:
                break
            body = _body(people[index])
            least_px = max(MIN_PIXELS, _SHOWN * _WHOLE_PX / max(float(gaps[index]), 1.0) ** 2)
            if self._in_frame(pose, body, _SLEEVE_M) and self._seen(pose, body, nearer, least_px):
                found.append((int(index), float(gaps[index])))
                nearer.append(body)
        return found

    def _seen(
        self, pose: SE2, thing: SceneObject, bodies: Sequence[SceneObject], least_px: float = MIN_PIXELS
    ) -> bool:  # fmt: skip
        """Return whether enough of an object is in the image and no person covers it."""
        return self._pixels(pose, thing) >= least_px and not any(_covers(pose, body, thing) for body in bodies)

    def _pixels(self, pose: SE2, thing: SceneObject) -> float:
        """Return the visible pixels of an object in a 128 x 128 image."""
        reach_m = hypot(*thing.size_m[:2]) / 2
        if not self._in_frame(pose, thing, reach_m * (1.0 + tan(HFOV_RAD / 2))):
            return 0.0  # no need to cast rays
        eye = (*self._eye(pose), self._scene.ground_height_m(pose.x_m, pose.y_m) + self._eye_up_m)
        return self._lines.pixels(eye, pose.theta_rad, thing, self._range_m)

    def _eye(self, pose: SE2) -> Vec2:
        ahead = self._eye_ahead_m
        return (pose.x_m + ahead * cos(pose.theta_rad), pose.y_m + ahead * sin(pose.theta_rad))

    def _in_frame(self, pose: SE2, thing: SceneObject, margin_m: float) -> bool:
        """Return whether an object's centre is between the image's sides, or outside by at most the margin, m."""
        (x, y), c, s = self._eye(pose), cos(pose.theta_rad), sin(pose.theta_rad)
        dx, dy = thing.position_m[0] - x, thing.position_m[1] - y
        return abs(dy * c - dx * s) <= tan(HFOV_RAD / 2) * (dx * c + dy * s) + margin_m

    def _objects(
        self, pose: SE2, step: Step | None, bodies: Sequence[SceneObject], *, backwards: bool
    ) -> list[SeenObject]:  # fmt: skip
        """The goal, the next opening that counts, landmarks that the instruction names, then the nearest landmarks."""
        found = [self._object(pose, self._goal)] if self._seen(pose, self._goal, bodies) else []
        if step is not None and (opening := self._next_opening(pose, step, backwards=backwards)) is not None:
            found.append(opening)
        for thing in sorted(self._others, key=lambda thing: (thing.label not in self._named, _gap(pose, thing))):
            if len(found) == MAX_OBJECTS:
                break
            if (seen := self._object(pose, thing)) not in found and self._seen(pose, thing, bodies):
                found.append(seen)
        return found

    @staticmethod
    def _object(pose: SE2, thing: SceneObject) -> SeenObject:
        return SeenObject(thing.landmark, _side(pose, thing.position_m), whole_metres(_gap(pose, thing)))

    def _next_opening(self, pose: SE2, step: Step, *, backwards: bool) -> SeenObject | None:
        """The nearest opening ahead that counts for a step and is in view; None without any.

        `backwards`: the robot comes back to the opening that it has missed.
        """
        frame, xy = Frame(step.ahead), (pose.x_m, pose.y_m)
        here = frame.along(xy)
        for opening in (step.counted[step.ordinal - 1],) if backwards else step.counted:
            if opening.middle_m <= here and not backwards:
                continue
            left = opening.side == "left"
            across = self._border(frame, xy, opening) + (_INSIDE_M if left else -_INSIDE_M)
            point = frame.point(opening.middle_m, across)
            # Close to the wall, the opening's far end is visible first.
            if self._in_sight(pose, point) or self._in_sight(pose, frame.point(opening.high_m - _INSIDE_M, across)):
                # Along the corridor its side is the one on which it counts, however small the angle.
                side = opening.side if _along(pose, step) > _ALONG else _side(pose, point)
                metres = hypot(point[0] - pose.x_m, point[1] - pose.y_m)
                return SeenObject(opening_name(opening.area.kind), side, whole_metres(metres))
        return None

    def _border(self, frame: Frame, xy: Vec2, opening: Opening) -> float:
        """Return the lateral position at which an opening begins, m across the direction of travel."""
        low, high = frame.span(bounds_of(opening.area))[1]
        if not low < frame.across(xy) < high:
            return low if opening.side == "left" else high
        # The corridor runs into or across that area: the opening begins where the corridor's wall ends.
        own = self._scene.area_at(*xy)
        low, high = (frame.across(xy),) * 2 if own is None else frame.span(bounds_of(own))[1]
        return high if opening.side == "left" else low

    def _in_sight(self, pose: SE2, point: Vec2) -> bool:
        """Return whether a post of table height would be visible at a point."""
        post = SceneObject("post", "column", (*point, 0.0), 0.0, (0.1, 0.1, 0.8), (0.0, 0.0, 0.0), "")
        return self._pixels(pose, post) > 0


def _along(pose: SE2, step: Step) -> float:
    """Return the cosine between the robot's heading and the direction of the leg that ends with a step."""
    return cos(pose.theta_rad) * step.ahead[0] + sin(pose.theta_rad) * step.ahead[1]


def _drives_backwards(pose: SE2, step: Step, *, missed: bool) -> bool:
    """Return whether the robot comes back to a counted opening that it has driven past (`missed`): not heading on."""
    return step.ordinal > 0 and _along(pose, step) < (-_AGAINST if missed else _AGAINST)


def _seen_side(step: Step, *, backwards: bool) -> str:
    """Return the side of a step's turn for a robot that drives its leg forwards or backwards."""
    if step.side == "straight":
        return AHEAD
    return (RIGHT if step.side == LEFT else LEFT) if backwards else step.side


def _gap(pose: SE2, thing: SceneObject) -> float:
    return hypot(thing.position_m[0] - pose.x_m, thing.position_m[1] - pose.y_m)


def _side(pose: SE2, at: Sequence[float] | Array) -> str:
    bearing = wrap_angle(atan2(at[1] - pose.y_m, at[0] - pose.x_m) - pose.theta_rad)
    return AHEAD if abs(bearing) <= _AHEAD_RAD else LEFT if bearing > 0 else RIGHT


def _motion(pose: SE2, at: Array, velocity: Array) -> str:
    """How a person moves over the ground, seen from the robot."""
    speed = hypot(velocity[0], velocity[1])
    if speed < _STANDING_MPS:
        return "standing"
    dx, dy = at[0] - pose.x_m, at[1] - pose.y_m
    gap = max(hypot(dx, dy), 1e-6)
    away = (velocity[0] * dx + velocity[1] * dy) / (gap * speed)
    if abs(away) >= cos(radians(45.0)):
        return "leaving" if away > 0 else "coming"
    leftwards = (dx * velocity[1] - dy * velocity[0]) > 0
    return "crossing left" if leftwards else "crossing right"


def _body(at: Array) -> SceneObject:
    """Return a person as a scene object."""
    heading = float(at[2]) if len(at) > 2 else 0.0
    return SceneObject("person", "column", (float(at[0]), float(at[1]), 0.0), heading, _BODY_M, (0.5, 0.5, 0.5), "")


def _covers(pose: SE2, body: SceneObject, thing: SceneObject) -> bool:
    """Return whether a person covers an object's whole width."""
    if _gap(pose, body) > _gap(pose, thing) - 0.3:
        return False
    (low, high), (right, left) = _bearings(pose, thing), _bearings(pose, body)
    return right <= low and high <= left


def _bearings(pose: SE2, thing: SceneObject) -> tuple[float, float]:
    """Return the bearings of an object's right and left edges, rad."""
    bearings = [
        wrap_angle(atan2(y - pose.y_m, x - pose.x_m) - pose.theta_rad) for x, y in thing.box.corners()
    ]  # fmt: skip
    return min(bearings), max(bearings)
