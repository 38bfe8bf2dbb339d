"""What a robot should say of an instant, from the world's truth: only what its camera really sees."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from math import atan2, cos, hypot, radians, sin
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from edge.geometry import SE2, wrap_angle
from edge.reasoning_text import Progress, format_waypoints
from sim_hil.benchmark.openings import LINEAR, Frame, bounds_of
from sim_hil.benchmark.route import Step
from sim_hil.benchmark.sights import MIN_PIXELS, RANGE_INDOORS_M, RANGE_OUTDOORS_M
from sim_hil.benchmark.visibility import EYE_M, HFOV_RAD
from sim_hil.scene import SceneObject
from tools.train import trace_words as words
from tools.train.progress_labels import RouteProgress
from tools.train.scenarios import Scenario

Array = NDArray[np.float64]

MAX_THINGS: Final = 3
MAX_PEOPLE: Final = 2
PEOPLE_M: Final = 6.0  # nobody further away is spoken of
_MANY: Final = (1, 4)  # people in view within PEOPLE_M: few, many
_AHEAD_RAD: Final = radians(15.0)
_STANDING_MPS: Final = 0.2
_ALONG: Final = cos(radians(30.0))
_BODY_M: Final = (0.35, 0.5, 1.7)  # a person: depth, width, height
_WAIT_M: Final = 0.5  # who means to get no further in three seconds waits
_WAIT_FOR_M: Final = 2.5


@dataclass(frozen=True)
class Trace:
    """The five aspects of one instant (paper appendix B), each in canonical words without its head and full stop."""

    situation: str
    objects: str
    motion: str
    progress: Progress
    plan: str

    def __post_init__(self) -> None:
        if (count := len(self.reasoning().split())) > words.MAX_WORDS:
            raise ValueError(f"trace: expected at most {words.MAX_WORDS} words, found {count}")

    def reasoning(self) -> str:
        """The five lines."""
        return words.lines(self.situation, self.objects, self.motion, self.progress, self.plan)

    def text(self, waypoints: Sequence[tuple[float, float]]) -> str:
        """The five lines and the waypoints' (x, y), m, at 3, 6 and 9 s: what the model is to answer."""
        return f"{self.reasoning()}\n{format_waypoints(tuple(waypoints))}"

    def to_json(self) -> dict[str, Any]:
        """For a drive's header."""
        return asdict(self)

    @classmethod
    def from_json(cls, table: Mapping[str, Any]) -> Trace:
        """What `to_json` wrote; other keys (a frame's number) are left alone. Raises ValueError, KeyError."""
        said = {name: str(table[name]) for name in ("situation", "objects", "motion", "plan")}
        return cls(**said, progress=Progress(**table["progress"]))


class Tracer:
    """Traces of one scenario's instants."""

    def __init__(self, scenario: Scenario, progress: RouteProgress | None = None) -> None:
        self._scene, self._lines, told = scenario.scene, scenario.site.lines, scenario.told
        self.progress = RouteProgress(scenario) if progress is None else progress
        self._range_m = RANGE_OUTDOORS_M if scenario.site.outdoors else RANGE_INDOORS_M
        along = [thing.label for step in told.steps for thing in (*step.near, *step.passed)]
        self._named = (told.goal_label, *along, *(thing.label for thing in told.passed))
        # Those that an instruction may name come first, then whatever is nearest.
        self._things = [thing for thing in self._scene.objects if thing.landmark]

    def trace(
        self, pose: SE2, people: Array, velocities: Array, plan_xy: Sequence[Sequence[float]] | None = None
    ) -> Trace:  # fmt: skip
        """Of a true pose, people [n, 2 or 3] (x m, y m, ...) and their velocities [n, 2], m/s, in the world.

        `plan_xy`: where the robot means to be in 3 s (and later), m in its own frame; without it nobody waits.
        """
        crowd = self._people_in_view(pose, people)
        progress, step = self.progress.at(pose), self.progress.next_step(pose)
        left_m = self.progress.to_next_m(pose)
        plan = words.stop(left_m) if step is None else words.turn(step.side, step.kind, left_m)
        ahead = [index for index, gap in crowd if gap < _WAIT_FOR_M and _side(pose, people[index]) == "ahead"]
        if ahead and plan_xy is not None and hypot(*plan_xy[0][:2]) < _WAIT_M:
            plan = words.WAIT + plan
        situation = self._situation(pose, len(crowd))
        motion = [self._motion(pose, people[i], velocities[i], gap) for i, gap in crowd[:MAX_PEOPLE]]
        objects = self._objects(pose, step, people, crowd)
        while len(self._made(situation, objects, motion, progress, plan).split()) > words.MAX_WORDS:
            objects = objects[:-1]
        return Trace(
            situation, ", ".join(objects) or words.NOTHING, ", ".join(motion) or words.NOBODY, progress, plan
        )  # fmt: skip

    @staticmethod
    def _made(situation: str, objects: list[str], motion: list[str], progress: Progress, plan: str) -> str:
        return words.lines(situation, ", ".join(objects) or "none", ", ".join(motion) or "nobody", progress, plan)

    def _situation(self, pose: SE2, near: int) -> str:
        area = self._scene.area_at(pose.x_m, pose.y_m)
        place = words.AREAS.get(area.kind, words.NO_AREA) if area is not None else words.NO_AREA
        return place + words.CROWDS[sum(near >= least for least in _MANY)]

    def _people_in_view(self, pose: SE2, people: Array) -> list[tuple[int, float]]:
        """Indices and distances, m, of those that are seen within PEOPLE_M, nearest first."""
        gaps = np.hypot(people[:, 0] - pose.x_m, people[:, 1] - pose.y_m) if len(people) else np.zeros(0)
        near = [int(index) for index in np.argsort(gaps, kind="stable") if gaps[index] < PEOPLE_M]
        found: list[tuple[int, float]] = []
        for index in near:
            body = _body(people[index])
            if self._pixels(pose, body, PEOPLE_M + 1.0) >= MIN_PIXELS and not self._behind(pose, body, people, found):
                found.append((index, float(gaps[index])))
        return found

    def _pixels(self, pose: SE2, thing: SceneObject, range_m: float) -> float:
        ground = self._scene.ground_height_m(pose.x_m, pose.y_m)
        return self._lines.pixels((pose.x_m, pose.y_m, ground + EYE_M), pose.theta_rad, thing, range_m)

    def _behind(self, pose: SE2, thing: SceneObject, people: Array, nearer: list[tuple[int, float]]) -> bool:
        """Whether somebody nearer covers a thing's whole width."""
        gap = hypot(thing.position_m[0] - pose.x_m, thing.position_m[1] - pose.y_m)
        low, high = _bearings(pose, thing)
        for index, distance_m in nearer:
            if distance_m < gap - 0.3:
                left, right = _bearings(pose, _body(people[index]))
                if left <= low and high <= right:
                    return True
        return False

    def _objects(self, pose: SE2, step: Step | None, people: Array, crowd: list[tuple[int, float]]) -> list[str]:
        found: list[tuple[int, float, str]] = []
        if step is not None and (opening := self._next_opening(pose, step)) is not None:
            found.append((1, *opening))
        for thing in self._things:
            at = np.array(thing.position_m[:2])
            gap = hypot(at[0] - pose.x_m, at[1] - pose.y_m)
            if self._pixels(pose, thing, self._range_m) < MIN_PIXELS or self._behind(pose, thing, people, crowd):
                continue
            order = 0 if thing.label == self._named[0] else 2 if thing.label in self._named else 3
            found.append((order, gap, words.seen(thing.landmark, _side(pose, at), gap)))
        said: list[str] = []
        for _, _, text in sorted(found):
            if text not in said:
                said.append(text)
        return said[:MAX_THINGS]

    def _next_opening(self, pose: SE2, step: Step) -> tuple[float, str] | None:
        """Distance, m, and words of the nearest opening ahead that counts for a step and is in view."""
        frame = Frame(step.ahead)
        here, own = frame.along((pose.x_m, pose.y_m)), frame.across((pose.x_m, pose.y_m))
        for opening in step.counted:
            if opening.middle_m <= here:
                continue
            (_, _), (right, left) = frame.span(bounds_of(opening.area))
            # The border nearest to the robot; an area that the corridor runs across opens a metre to the side.
            across = right if opening.side == "left" else left
            if opening.area.kind in LINEAR and right < own < left:
                across = own + (1.0 if opening.side == "left" else -1.0)
            point = np.array(frame.point(opening.middle_m, across))
            gap = hypot(point[0] - pose.x_m, point[1] - pose.y_m)
            if gap < self._range_m and self._in_sight(pose, point):
                # Along the corridor it is on the side on which it counts, however small the angle.
                along = cos(pose.theta_rad) * step.ahead[0] + sin(pose.theta_rad) * step.ahead[1] > _ALONG
                side = opening.side if along else _side(pose, point)
                return gap, words.seen(words.opening(opening.area.kind), side, gap)
        return None

    def _in_sight(self, pose: SE2, point: Array) -> bool:
        """Whether a post as high as the eye would be seen at a point."""
        bearing = wrap_angle(atan2(point[1] - pose.y_m, point[0] - pose.x_m) - pose.theta_rad)
        if abs(bearing) > HFOV_RAD / 2:
            return False
        post = SceneObject("post", "column", (point[0], point[1], 0.0), 0.0, (0.1, 0.1, 0.8), (0, 0, 0), "")
        return self._pixels(pose, post, self._range_m + 1.0) > 0

    def _motion(self, pose: SE2, at: Array, velocity: Array, gap: float) -> str:
        return words.person(_side(pose, at), gap, _way(pose, at, velocity))


def _side(pose: SE2, at: Array) -> str:
    bearing = wrap_angle(atan2(at[1] - pose.y_m, at[0] - pose.x_m) - pose.theta_rad)
    return "ahead" if abs(bearing) <= _AHEAD_RAD else "left" if bearing > 0 else "right"


def _way(pose: SE2, at: Array, velocity: Array) -> str:
    """How somebody moves over the ground, seen from the robot."""
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
    """Somebody as a thing to look at."""
    heading = float(at[2]) if len(at) > 2 else 0.0
    return SceneObject("person", "column", (float(at[0]), float(at[1]), 0.0), heading, _BODY_M, (0.5, 0.5, 0.5), "")


def _bearings(pose: SE2, thing: SceneObject) -> tuple[float, float]:
    """Directions of a thing's right and left edges from the robot's heading, rad."""
    bearings = []
    c, s = cos(thing.heading_rad), sin(thing.heading_rad)
    depth, width = thing.size_m[0] / 2, thing.size_m[1] / 2
    for u, v in ((depth, width), (depth, -width), (-depth, width), (-depth, -width)):
        x, y = thing.position_m[0] + c * u - s * v, thing.position_m[1] + s * u + c * v
        bearings.append(wrap_angle(atan2(y - pose.y_m, x - pose.x_m) - pose.theta_rad))
    return min(bearings), max(bearings)
