"""Checks of a task: visible landmarks, a goal that is not reachable through a wall, turns that match the path."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from math import atan2, degrees, hypot, pi

import numpy as np

from sim_hil.benchmark.language.instruction_reading import read
from sim_hil.benchmark.language.openings import dense
from sim_hil.benchmark.language.route import Passed, RouteDescription
from sim_hil.benchmark.language.visibility import Sightlines
from sim_hil.scene.nav_grid import NavGrid
from sim_hil.scene.scene import Scene, Vec2

MIN_PIXELS = 40.0  # least size of a landmark in a 128 x 128 image, about 6 x 6 px: colour and shape are visible
RANGE_INDOORS_M, RANGE_OUTDOORS_M = 12.0, 30.0
_POSE_M = 0.4
_LOOK, _RUN = (
    22,
    6,
)  # steps: a turn lies within 2.2 m of its described place; directions are over 0.6 m
_LEAST_TURN_RAD = pi / 9  # 20 degrees: a shortest path rounds its corners slantwise
_OPEN = frozenset(("plaza", "yard"))


def poses_along(path: Sequence[Vec2]) -> list[tuple[float, float, float]]:
    """Return poses (x m, y m, heading rad) every 0.4 m along a path, facing along it."""
    poses: list[tuple[float, float, float]] = []
    for a, b in itertools.pairwise(path):
        length = hypot(b[0] - a[0], b[1] - a[1])
        if length < 1e-6:
            continue
        heading = atan2(b[1] - a[1], b[0] - a[0])
        count = max(1, round(length / _POSE_M))
        poses += [(a[0] + (b[0] - a[0]) * k / count, a[1] + (b[1] - a[1]) * k / count, heading) for k in range(count)]
    if poses:
        poses.append((path[-1][0], path[-1][1], poses[-1][2]))
    return poses


def named_landmarks(texts: Sequence[str], route: RouteDescription) -> tuple[str, ...]:
    """Return the labels of the landmarks named in any of the texts: first the goal, then in order of the route."""
    names = {claim.name for text in texts for claim in read(text) if claim.name}
    along: list[Passed] = []
    for step in route.steps:
        along += [*step.passed, *step.near]
    along += route.passed
    labels = [route.goal_label]
    for thing in along:
        if thing.name in names and thing.label not in labels:
            labels.append(thing.label)
    return tuple(labels)


def named_too_small(scene: Scene, lines: Sightlines, path: Sequence[Vec2], labels: Sequence[str]) -> list[str]:
    """Return the landmarks that never appear large enough in the image along the path, one line each."""
    range_m = RANGE_INDOORS_M if scene.ceiling_height_m > 0 else RANGE_OUTDOORS_M
    poses, found = poses_along(path), []
    things = {thing.label: thing for thing in scene.objects}
    for label in labels:
        if label not in things:
            found.append(f"{label}: no such landmark in the scene")
            continue
        pixels = lines.most_pixels(poses, things[label], range_m)
        if pixels < MIN_PIXELS:
            found.append(f"{label}: at most {pixels:.0f} px in the picture, {MIN_PIXELS:.0f} expected")
    return found


def worst_leak(grid: NavGrid, goal: Vec2, threshold_m: float) -> float:
    """Return the largest excess path length to the goal from a free spot within the threshold, m; 0: valid.

    A spot behind a wall may lie within the circle but far away by path; a robot there would wrongly count as arrived.
    """
    field = grid.distance_field(goal)
    low = grid.cell(goal[0] - threshold_m, goal[1] - threshold_m)
    high = grid.cell(goal[0] + threshold_m, goal[1] + threshold_m)
    worst = 0.0
    for row in range(low[0], high[0] + 1):
        for column in range(low[1], high[1] + 1):
            x, y = grid.centre(row, column)
            gap = hypot(x - goal[0], y - goal[1])
            if gap < threshold_m and grid.free[row, column]:
                worst = max(worst, float(min(field[row, column], 1e6)) - (2.0 * threshold_m + 0.5))
    return float(np.maximum(worst, 0.0))


def wrong_bends(route: RouteDescription, path: Sequence[Vec2]) -> list[str]:
    """Return the described turns at which the path does not bend to that side.

    Turns onto a plaza or a yard are not checked, because the path may cross their open borders diagonally.
    """
    points = dense(path)
    places = [_nearest(points, step.at) for step in route.steps]
    found = []
    for index, (step, at) in enumerate(zip(route.steps, places, strict=True)):
        if step.side == "straight" or step.kind in _OPEN:
            continue
        # At most half way to the neighbouring turns, which bend the path too.
        first = max(at - _LOOK, (places[index - 1] + at) // 2 if index else 0)
        last = min(at + _LOOK, (at + places[index + 1]) // 2 if index + 1 < len(places) else len(points) - 1)
        before = _minus(points[min(first + _RUN, at)], points[first])
        after = _minus(points[last], points[max(last - _RUN, at)])
        bend = (atan2(after[1], after[0]) - atan2(before[1], before[0]) + pi) % (2 * pi) - pi
        if (bend > 0) != (step.side == "left") or abs(bend) < _LEAST_TURN_RAD:
            found.append(f"turn {step.side} into the {step.name}: the path bends by {degrees(bend):.0f} degrees there")
    return found


def _nearest(points: Sequence[Vec2], to: Vec2) -> int:
    return min(range(len(points)), key=lambda index: hypot(*_minus(points[index], to)))


def _minus(a: Vec2, b: Vec2) -> Vec2:
    return (a[0] - b[0], a[1] - b[1])
