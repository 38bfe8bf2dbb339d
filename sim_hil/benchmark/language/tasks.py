"""Random tasks of a scene: a start, a landmark as goal, and the described route; for episodes and training."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import atan2, cos, hypot, pi, sin

import numpy as np

from sim_hil.benchmark.language.instruction_words import AROUND
from sim_hil.benchmark.language.openings import LINEAR, bounds_of, dense
from sim_hil.benchmark.language.route import RouteDescription, RouteError, describe_route
from sim_hil.scene.nav_grid import NavGrid
from sim_hil.scene.scene import Area, Scene, SceneObject, Vec2, Vec3

GOAL_GAP_M = 0.95  # distance from a landmark's front to the goal, so that a robot does not touch it
_LYING = frozenset(("carpet",))
_STANDS_M = {"umbrella": 0.15, "umbrella_table": 0.5}  # half of what stands on the ground below the cloth
# Objects at which the robot stops where it arrives, regardless of their heading.
_FREE_STANDING = frozenset(
    ("forklift", "pallet_jack", "fountain", "umbrella", "umbrella_table", "kiosk", "statue", "drum", "traffic_cone",
     "box_stack", "wet_floor_sign", "meeting_table")
)  # fmt: skip
_NOT_GOALS = frozenset(("notice_board", "window", "trash_bin", "medical_cart", "clock", "planter"))


@dataclass(frozen=True)
class Task:
    """Task; `path`: shortest path from `start` to `goal`, m, for the grid's robot; `route`: its description."""

    start: Vec3
    goal: Vec2
    goal_label: str
    path: tuple[Vec2, ...]
    route: RouteDescription


def goal_before(grid: NavGrid, thing: SceneObject) -> Vec2 | None:
    """Return the free point in front of a landmark (or on a carpet) at which to stop; None if there is none."""
    x, y, _ = thing.position_m
    if thing.kind in _LYING:
        return (round(x, 2), round(y, 2)) if grid.is_free(x, y) else None
    for gap in (GOAL_GAP_M, GOAL_GAP_M - 0.2, GOAL_GAP_M + 0.2, GOAL_GAP_M - 0.4):
        reach = _STANDS_M.get(thing.kind, thing.size_m[0] / 2) + gap
        for turn in (0.0, 0.4, -0.4):
            angle = thing.heading_rad + turn
            px, py = round(x + reach * cos(angle), 2), round(y + reach * sin(angle), 2)
            if grid.is_free(px, py):
                return (px, py)
    return None


def make_task(scene: Scene, grid: NavGrid, start: Vec3, thing: SceneObject) -> Task:
    """Create the task from a start to a landmark. Raises RouteError if it is not feasible or not describable."""
    goal, path = path_to(grid, start, thing)
    return Task(start, goal, thing.label, path, describe_route(scene, grid, list(path), thing))


def path_to(grid: NavGrid, start: Vec3, thing: SceneObject) -> tuple[Vec2, tuple[Vec2, ...]]:
    """Return the point at which to stop for a landmark and the path to it. Raises RouteError if there is none."""
    goal = goal_before(grid, thing)
    if goal is None:
        raise RouteError(f"there is no room before the {thing.landmark}")
    path = grid.path((start[0], start[1]), goal)
    if path is None:
        raise RouteError(f"there is no path to the {thing.landmark}")
    if thing.kind in _FREE_STANDING:
        goal = _first_beside(grid, thing, path) or goal
        path = grid.path((start[0], start[1]), goal)
        if path is None:
            raise RouteError(f"there is no path to the {thing.landmark}")
    return goal, tuple(path)


def _first_beside(grid: NavGrid, thing: SceneObject, path: list[Vec2]) -> Vec2 | None:
    """Return the first point of a path close to an object without a front."""
    for x, y in dense(path):
        point = (round(x, 2), round(y, 2))
        if outline_gap_m(thing, point) < GOAL_GAP_M and grid.is_free(*point):
            return point
    return None


def outline_gap_m(thing: SceneObject, point: Vec2) -> float:
    """Return the distance from a point to an object's outline on the floor, m: bounding box, or parts of a parasol."""
    boxes = thing.boxes if thing.kind in ("umbrella", "umbrella_table", "tree") else (thing.box,)
    gaps = []
    for box in boxes:
        dx, dy = point[0] - box.centre_m[0], point[1] - box.centre_m[1]
        c, s = box.axis
        along, across = abs(dx * c + dy * s) - box.size_m[0] / 2, abs(dy * c - dx * s) - box.size_m[1] / 2
        gaps.append(hypot(max(along, 0.0), max(across, 0.0)))
    return min(gaps)


def goals(scene: Scene) -> list[SceneObject]:
    """Return the landmarks that can be goals."""
    return [thing for thing in scene.landmarks() if thing.kind not in _NOT_GOALS]


def starts(scene: Scene) -> list[Area]:
    """Return the areas in which a task can start: corridors, aisles, sidewalks and rooms."""
    return [area for area in scene.areas if area.kind in (*LINEAR, "room") and area.kind != "crossing"]


def draw_start(scene: Scene, grid: NavGrid, rng: np.random.Generator) -> Vec3:
    """Draw a free pose along a corridor or in a room. Raises RouteError if none was found."""
    areas = starts(scene)
    if not areas:
        raise RouteError("the scene has no area to start in")
    # Corridors are weighted by length, rooms by a constant.
    weights = np.array([_weight(area) for area in areas])
    for _ in range(50):
        area = areas[int(rng.choice(len(areas), p=weights / weights.sum()))]
        box = bounds_of(area)
        x = round(float(rng.uniform(box.x0 + 0.6, box.x1 - 0.6)), 2)
        y = round(float(rng.uniform(box.y0 + 0.6, box.y1 - 0.6)), 2)
        flip = bool(rng.integers(2))
        if area.kind == "room":
            heading = float(round(float(rng.uniform(-pi, pi)), 2))
        else:
            heading = (pi if flip else 0.0) if box.along_x else (-pi / 2 if flip else pi / 2)
        if grid.clearance_m(x, y) >= grid.required_m + 0.15:
            return (x, y, heading)
    raise RouteError("no free start was found")


def _weight(area: Area) -> float:
    box = bounds_of(area)
    return 2.0 if area.kind == "room" else max(box.x1 - box.x0, box.y1 - box.y0)


def sample_task(
    scene: Scene, grid: NavGrid, rng: np.random.Generator, *, things: Sequence[SceneObject] | None = None,
    length_m: tuple[float, float] = (4.0, 80.0), tries: int = 12,
) -> Task:  # fmt: skip
    """Draw a random task to one of `things` (default: any goal), with a path length within limits.

    Raises RouteError if no drawn start gives an unambiguous description; draw again.
    """
    found = goals(scene) if things is None else things
    if not found:
        raise RouteError("the scene has no landmark to go to")
    thing = found[int(rng.integers(len(found)))]
    goal = goal_before(grid, thing)
    if goal is None:
        raise RouteError(f"there is no room before the {thing.landmark}")
    field = grid.distance_field(goal)
    why = "no start at such a distance was drawn"
    for _ in range(tries):
        start = draw_start(scene, grid, rng)
        # The grid's own distances are up to 3 % long; the path's length is what counts to the caller.
        if not length_m[0] <= grid.field_at(field, start[0], start[1]) <= length_m[1]:
            continue
        try:
            return _facing(make_task(scene, grid, start, thing))
        except RouteError as error:
            why = str(error)
    raise RouteError(why)


def _facing(task: Task) -> Task:
    """Turn the robot towards the beginning of its route. Raises RouteError if the route begins sideways."""
    start = task.start
    away = _first_direction(task.path)
    if task.route.leaves_room:  # face the door
        return replace(task, start=(start[0], start[1], round(away, 3)))
    if abs(_wrapped(away - start[2])) > pi / 2:  # face the opposite direction of the corridor
        start = (start[0], start[1], _wrapped(start[2] + pi))
    task = replace(task, start=start)
    if not begins_ahead(task):
        raise RouteError("the way begins to the robot's side")
    return task


def facing(start: Vec3, path: Sequence[Vec2]) -> str:
    """Return how a robot must turn on the spot to face its path: "" (it begins ahead), "left", "right" or AROUND."""
    bearing = _wrapped(_first_direction(path) - start[2])
    if abs(bearing) <= pi / 3:
        return ""
    return AROUND if abs(bearing) >= 2 * pi / 3 else "left" if bearing > 0 else "right"


def begins_ahead(task: Task) -> bool:
    """Return whether the route begins ahead of the robot; only then an instruction may begin with "go on"."""
    return not facing(task.start, task.path)


def _first_direction(path: Sequence[Vec2]) -> float:
    """Return the direction of a path's first two metres, rad."""
    left, at = 2.0, path[0]
    for a, b in itertools.pairwise(path):
        length = hypot(b[0] - a[0], b[1] - a[1])
        at = b if length <= left else (a[0] + (b[0] - a[0]) * left / length, a[1] + (b[1] - a[1]) * left / length)
        left -= length
        if left <= 0:
            break
    return atan2(at[1] - path[0][1], at[0] - path[0][0])


def _wrapped(angle: float) -> float:
    return (angle + pi) % (2 * pi) - pi
