"""Description of a route through a scene: legs along corridors, turns with counts, passed landmarks, the goal.

Everything is read off the scene's geometry (areas, navigation grid, landmarks) and the path; nothing of how the scene
was made enters. Used both to word instructions and to check them.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from math import cos, hypot, sin

from sim_hil.benchmark.language.instruction_words import COLOUR_WORDS
from sim_hil.benchmark.language.openings import (
    LINEAR,
    Bounds,
    Frame,
    Opening,
    bounds_of,
    dense,
    is_open,
    opening_class,
    side_openings,
)
from sim_hil.scene.nav_grid import NavGrid
from sim_hil.scene.scene import Area, Scene, SceneObject, Vec2

_SAMPLE_M = 0.1
_CLIP_M = 0.45  # a path through an area shorter than this only clips its corner
_LEG_M = 1.2  # a corridor followed for less than this is only crossed
_AT_START_M = 0.7  # an opening this close to the start is ambiguous: it may be counted or not
_END_M = 1.6  # a corridor that continues for less than this ends here
_GOAL_END_M = 2.4  # the same for the goal, which lies about 1 m before the landmark at the end
_NEAR_M = 2.4  # largest distance of a landmark that marks a turn


class RouteError(ValueError):
    """A route that cannot be described unambiguously; one line with the reason."""


@dataclass(frozen=True)
class Passed:
    """A landmark beside the route."""

    label: str
    name: str
    side: str


@dataclass(frozen=True)
class Step:
    """One step of a route: turn or continue into an area of `kind` with `name`.

    `side`: left, right or straight. `ordinal`: number of the opening among those of that kind on that side since the
    last step (0: not counted). `at_end`: the followed area ends there. `near`: landmarks that mark the place. `passed`:
    landmarks passed before it. `before_kind`: area followed before it, for `before_m`, in direction `ahead`. `counted`:
    all openings of that kind on that side, in the frame of `ahead`; the `ordinal`-th is taken.
    """

    side: str
    kind: str
    name: str
    ordinal: int
    at_end: bool
    near: tuple[Passed, ...]
    passed: tuple[Passed, ...]
    before_kind: str
    before_name: str
    before_m: float
    at: Vec2
    ahead: Vec2 = (1.0, 0.0)
    counted: tuple[Opening, ...] = ()


@dataclass(frozen=True)
class RouteDescription:
    """Description of a route: steps, then the goal; `goal_side`: left, right, ahead, or "" if not mentioned."""

    steps: tuple[Step, ...]
    goal_label: str
    goal_name: str
    goal_bare: str  # the name without its colour where that is enough, else the name
    goal_side: str
    goal_at_end: bool
    goal_area_kind: str
    goal_area_name: str
    last_m: float
    passed: tuple[Passed, ...]
    leaves_room: bool
    length_m: float


@dataclass
class _Run:
    area: Area
    points: list[Vec2]


@dataclass
class _Leg:
    frame: Frame
    followed: list[Area]
    crossed: list[Area]
    start: Vec2
    end: Vec2
    kind: str


def describe_route(scene: Scene, grid: NavGrid, path: list[Vec2], goal: SceneObject) -> RouteDescription:
    """Describe a path to a landmark; `grid`: any grid of the scene. Raises RouteError if that is not possible."""
    runs = _runs(scene, path)
    legs = _legs(runs)
    steps = [_step(scene, grid, legs[i - 2] if i > 1 else None, legs[i - 1], legs[i]) for i in range(1, len(legs))]
    last = legs[-1]
    walked = [area for leg in legs for area in (*leg.followed, *leg.crossed)]
    _check_goal(scene, walked, goal)
    linear = last.kind in LINEAR
    length = sum(hypot(b[0] - a[0], b[1] - a[1]) for a, b in itertools.pairwise(path))
    last_m = hypot(last.end[0] - last.start[0], last.end[1] - last.start[1])
    return RouteDescription(
        # The goal is neither passed nor marks a turn.
        steps=tuple(
            replace(step, near=_others(step.near, goal.label), passed=_others(step.passed, goal.label))
            for step in steps
        ),
        goal_label=goal.label,
        goal_name=goal.landmark,
        goal_bare=_bare(scene, walked, goal),
        goal_side=_goal_side(last, goal) if linear and last_m > 2.5 else "",
        goal_at_end=linear and _ends(scene, grid, last),
        goal_area_kind=last.kind,
        goal_area_name=(last.followed or last.crossed)[-1].name,
        last_m=last_m,
        passed=_others(_passed(scene, last, last.frame.along(last.end) - 1.5), goal.label) if linear else (),
        leaves_room=legs[0].kind not in LINEAR,
        length_m=length,
    )


def _others(things: tuple[Passed, ...], label: str) -> tuple[Passed, ...]:
    return tuple(thing for thing in things if thing.label != label)


def _runs(scene: Scene, path: list[Vec2]) -> list[_Run]:
    """Return the areas along a path, in order, without those of which it only clips a corner."""
    runs: list[_Run] = []
    for point in dense(path, _SAMPLE_M):
        area = scene.area_at(*point)
        if area is None:  # a niche between two houses belongs to the previous area
            if not runs:
                raise RouteError("the start lies in no area")
            area = runs[-1].area
        if runs and runs[-1].area is area:
            runs[-1].points.append(point)
        else:
            runs.append(_Run(area, [point]))
    kept: list[_Run] = []
    for index, run in enumerate(runs):
        inner = 0 < index < len(runs) - 1
        if inner and (len(run.points) - 1) * _SAMPLE_M < _CLIP_M:
            continue
        if kept and kept[-1].area is run.area:
            kept[-1].points += run.points
        else:
            kept.append(run)
    return kept


def _legs(runs: list[_Run]) -> list[_Leg]:
    """Return the legs: segments with one direction."""
    legs: list[_Leg] = []
    for index, run in enumerate(runs):
        first, last = index == 0, index == len(runs) - 1
        kind = run.area.kind
        if kind == "street":
            raise RouteError("the way leads over a street, off the crossings")
        if kind not in LINEAR:
            if not (first or last):
                raise RouteError(f"the way leads through {run.area.label}")
            legs.append(_leg_of_room(runs, index))
            continue
        followed, frame = _direction(run, runs, index)
        if frame is None:  # the goal is near: keep the last leg's direction
            if not legs:
                raise RouteError("the way is too short to have a direction")
            if legs[-1].kind not in LINEAR:
                raise RouteError("the way ends as soon as it has left the room")
            legs[-1].crossed.append(run.area)
            legs[-1].end = run.points[-1]
            continue
        same = legs and legs[-1].kind in LINEAR and legs[-1].frame == frame
        if same and (kind == "crossing") == (legs[-1].kind == "crossing"):
            (legs[-1].followed if followed else legs[-1].crossed).append(run.area)
            legs[-1].end = run.points[-1]
        else:
            areas = ([run.area], []) if followed else ([], [run.area])
            legs.append(_Leg(frame, areas[0], areas[1], run.points[0], run.points[-1], kind))
    for leg in legs:
        if not leg.followed and leg.kind in LINEAR:
            raise RouteError("the way cuts across a corridor at an angle")
    return legs


def _direction(run: _Run, runs: list[_Run], index: int) -> tuple[bool, Frame | None]:
    """Return whether a corridor is followed (else crossed), and the direction."""
    box = bounds_of(run.area)
    (ax, ay), (bx, by) = run.points[0], run.points[-1]
    along, across = (bx - ax, by - ay) if box.along_x else (by - ay, bx - ax)
    if abs(along) >= _LEG_M:
        sign = 1.0 if along > 0 else -1.0
        return True, Frame((sign, 0.0) if box.along_x else (0.0, sign))
    if index == len(runs) - 1 or index == 0:
        return False, None
    sign = 1.0 if across > 0 else -1.0
    return False, Frame((0.0, sign) if box.along_x else (sign, 0.0))


def _leg_of_room(runs: list[_Run], index: int) -> _Leg:
    """Return the leg into the last room or out of the first: straight through the border with its neighbour."""
    run = runs[index]
    box = bounds_of(run.area)
    if index == 0 and len(runs) == 1:
        raise RouteError("start and goal lie in one room")
    point = run.points[0] if index > 0 else run.points[-1]
    gaps = {
        (1.0, 0.0): point[0] - box.x0, (-1.0, 0.0): box.x1 - point[0],
        (0.0, 1.0): point[1] - box.y0, (0.0, -1.0): box.y1 - point[1],
    }  # fmt: skip
    inwards = min(gaps, key=lambda key: abs(gaps[key]))
    direction = inwards if index > 0 else (-inwards[0], -inwards[1])
    return _Leg(Frame(direction), [run.area], [], run.points[0], run.points[-1], run.area.kind)


def _turn(before: _Leg, after: _Leg) -> str:
    d0, d1 = before.frame.direction, after.frame.direction
    turn = d0[0] * d1[1] - d0[1] * d1[0]
    if d0[0] * d1[0] + d0[1] * d1[1] < -0.5:
        raise RouteError("the way turns back")
    return "left" if turn > 0.5 else "right" if turn < -0.5 else "straight"


def _step(scene: Scene, grid: NavGrid, earlier: _Leg | None, before: _Leg, after: _Leg) -> Step:
    target = (after.followed or after.crossed)[0]
    side = _turn(before, after)
    ordinal, at_end = 0, False
    counted: tuple[Opening, ...] = ()
    near: tuple[Passed, ...] = ()
    passed: tuple[Passed, ...] = ()
    start = before.frame.along(before.start)
    if before.kind in LINEAR:
        limit = before.frame.along(after.start)
        if side != "straight":
            crossed = [*before.crossed, *([target] if _lies_across(before, target) else [])]
            openings = side_openings(scene, grid, before.frame, before.followed, crossed, side)
            taken = _taken(openings, target, before.frame.along(after.start))
            counted = _counted(openings, taken, start, _turn(earlier, before) if earlier else "")
            ordinal = sum(opening.middle_m <= taken.middle_m + 1e-6 for opening in counted)
            limit = taken.low_m
            near = _near(scene, before, openings, taken)
        at_end = _ends(scene, grid, before, target)
        passed = _passed(scene, before, limit - 0.4)
    return Step(
        side=side, kind=target.kind, name=target.name, ordinal=ordinal, at_end=at_end, near=near, passed=passed,
        before_kind=before.kind, before_name=(before.followed or before.crossed)[-1].name,
        before_m=abs(before.frame.along(after.start) - start), at=after.start,
        ahead=before.frame.direction, counted=counted,
    )  # fmt: skip


def _lies_across(leg: _Leg, area: Area) -> bool:
    """Return whether an area lies at the end of a leg instead of at its side."""
    _, (right, left) = leg.frame.span(bounds_of(area))
    (_, (own_right, own_left)) = leg.frame.span(bounds_of(leg.followed[-1]))
    return right < own_left - 0.3 and left > own_right + 0.3


def _taken(openings: list[Opening], target: Area, along: float) -> Opening:
    mine = [opening for opening in openings if opening.area.label == target.label]
    if not mine:
        raise RouteError(f"no opening towards {target.label} was found")
    return min(mine, key=lambda opening: max(opening.low_m - along, along - opening.high_m, 0.0))


def _counted(openings: list[Opening], taken: Opening, start: float, from_side: str) -> tuple[Opening, ...]:
    """Return the openings of the taken one's kind from the leg's start, in order. Raises RouteError if ambiguous.

    `from_side`: side of the previous turn; an opening on that side at the leg's start was just left, so it does not
    count. A passage straight across belongs to the junction of that turn and does not count either, but a door does.
    """
    counted = []
    for opening in openings:
        if opening_class(opening.area.kind) != opening_class(taken.area.kind):
            continue
        if from_side and (opening.side == from_side or opening.area.kind != "room"):
            if opening.low_m < start - 0.3 < opening.high_m - 0.3:
                if opening is taken:
                    raise RouteError("the turn is taken before its leg has begun")
                continue
        elif opening.low_m - _AT_START_M < start < opening.high_m + _AT_START_M:
            raise RouteError(f"{opening.area.label} opens right beside the start of the way, or of a leg")
        if opening.middle_m > start:
            counted.append(opening)
    return tuple(counted)


def _ends(scene: Scene, grid: NavGrid, leg: _Leg, target: Area | None = None) -> bool:
    """Return whether the followed area ends shortly after the leg."""
    (_, high), (right, left) = leg.frame.span(bounds_of(leg.followed[-1]))
    if target is not None and _lies_across(leg, target):
        (_, high), _ = leg.frame.span(bounds_of(target))
    else:
        end = leg.frame.along(leg.end)
        if target is not None:
            (_, t_high), _ = leg.frame.span(bounds_of(target))
            end = max(end, min(t_high, high))
        if high - end > (_END_M if target is not None else _GOAL_END_M):
            return False
    middle = (right + left) / 2
    a, b = leg.frame.point(high - 0.6, middle), leg.frame.point(high + 0.6, middle)
    return not _inside(scene, b) or not is_open(grid, a, b)


def _inside(scene: Scene, p: Vec2) -> bool:
    (x0, y0), (x1, y1) = scene.floor_min_m, scene.floor_max_m
    return x0 < p[0] < x1 and y0 < p[1] < y1


def _beside(scene: Scene, leg: _Leg) -> list[tuple[float, float, SceneObject]]:
    """Return the landmarks in the areas that a leg follows: (along, across, object)."""
    found = []
    for thing in scene.landmarks():
        if any(_near_box(bounds_of(area), thing) for area in leg.followed):
            p = (thing.position_m[0], thing.position_m[1])
            found.append((leg.frame.along(p), leg.frame.across(p), thing))
    return sorted(found, key=lambda item: item[0])


def _near_box(box: Bounds, thing: SceneObject) -> bool:
    """Return whether an object stands in an area or faces it, as a shop faces the sidewalk."""
    x, y, _ = thing.position_m
    reach = thing.size_m[0] / 2 + 0.25
    front = (x + reach * cos(thing.heading_rad), y + reach * sin(thing.heading_rad))
    return any(box.x0 <= px <= box.x1 and box.y0 <= py <= box.y1 for px, py in ((x, y), front))


def _passed(scene: Scene, leg: _Leg, until: float) -> tuple[Passed, ...]:
    """Return the landmarks beside a leg before a point whose name is unique there."""
    start = leg.frame.along(leg.start) + 1.2
    beside = _beside(scene, leg)
    names = [thing.landmark for along, _, thing in beside if along < until + 1.0]
    found = []
    for along, across, thing in beside:
        middle = leg.frame.across(leg.start), leg.frame.across(leg.end)
        low, high = min(middle) - 0.35, max(middle) + 0.35
        if start < along < until and names.count(thing.landmark) == 1 and not low < across < high:
            found.append(Passed(thing.label, thing.landmark, "left" if across > high else "right"))
    return tuple(found)


def _near(scene: Scene, before: _Leg, openings: list[Opening], taken: Opening) -> tuple[Passed, ...]:
    """Return the landmarks that mark a turn: close to it, unique on the leg, and nearer than to other openings."""
    beside = _beside(scene, before)
    names = [thing.landmark for _, _, thing in beside]
    others = [o for o in openings if o is not taken and opening_class(o.area.kind) == opening_class(taken.area.kind)]
    found = []
    for along, across, thing in beside:
        gap = max(taken.low_m - along, along - taken.high_m, 0.0)
        nearer = any(max(o.low_m - along, along - o.high_m, 0.0) < gap + 1.5 for o in others)
        ahead = along - before.frame.along(before.start)
        if gap <= _NEAR_M and not nearer and names.count(thing.landmark) == 1 and ahead > 1.0:
            middle = before.frame.across(before.end)
            found.append(Passed(thing.label, thing.landmark, "left" if across > middle else "right"))
    return tuple(found)


def _check_goal(scene: Scene, walked: list[Area], goal: SceneObject) -> None:
    """Check that the goal's name is unique in all areas of the route. Raises RouteError."""
    for thing in scene.landmarks():
        same = thing.label != goal.label and thing.landmark == goal.landmark
        if same and any(_near_box(bounds_of(area), thing) for area in walked):
            raise RouteError(f"another {goal.landmark} stands by the way")


def _bare(scene: Scene, walked: list[Area], goal: SceneObject) -> str:
    """Return the goal's name without its colour if no other object of that kind stands along the route."""
    for thing in scene.objects:
        same = thing.label != goal.label and thing.kind == goal.kind
        if same and any(_near_box(bounds_of(area), thing) for area in walked):
            return goal.landmark
    first, _, rest = goal.landmark.partition(" ")
    return rest if rest and first in COLOUR_WORDS else goal.landmark


def _goal_side(leg: _Leg, goal: SceneObject) -> str:
    p = (goal.position_m[0], goal.position_m[1])
    along = leg.frame.along(p) - leg.frame.along(leg.end)
    across = leg.frame.across(p) - leg.frame.across(leg.end)
    if abs(across) >= max(0.5, abs(along)):
        return "left" if across > 0 else "right"
    return "ahead" if along > abs(across) else ""
