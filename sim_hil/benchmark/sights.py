"""Checks of a task on its scene: landmarks seen along the way, and a goal that is not reached through a wall."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from math import atan2, hypot

import numpy as np

from sim_hil.benchmark.instruction_reading import read
from sim_hil.benchmark.route import Passed, Told
from sim_hil.benchmark.visibility import Sightlines
from sim_hil.nav_grid import NavGrid
from sim_hil.scene import Scene, Vec2

MIN_PIXELS = 40.0  # of a 128 x 128 picture: about 6 x 6, enough for a colour and a shape
RANGE_INDOORS_M, RANGE_OUTDOORS_M = 12.0, 30.0
_STEP_M = 0.4


def poses_along(path: Sequence[Vec2]) -> list[tuple[float, float, float]]:
    """Poses (x m, y m, heading rad) every 0.4 m along a path, looking along it."""
    poses: list[tuple[float, float, float]] = []
    for a, b in itertools.pairwise(path):
        length = hypot(b[0] - a[0], b[1] - a[1])
        if length < 1e-6:
            continue
        heading = atan2(b[1] - a[1], b[0] - a[0])
        count = max(1, round(length / _STEP_M))
        poses += [(a[0] + (b[0] - a[0]) * k / count, a[1] + (b[1] - a[1]) * k / count, heading) for k in range(count)]
    if poses:
        poses.append((path[-1][0], path[-1][1], poses[-1][2]))
    return poses


def named_landmarks(texts: Sequence[str], told: Told) -> tuple[str, ...]:
    """Labels of the things that any of the texts names, the goal first, then in the order of the way."""
    names = {claim.name for text in texts for claim in read(text) if claim.name}
    along: list[Passed] = []
    for step in told.steps:
        along += [*step.passed, *step.near]
    along += told.passed
    labels = [told.goal_label]
    for thing in along:
        if thing.name in names and thing.label not in labels:
            labels.append(thing.label)
    return tuple(labels)


def named_too_small(
    scene: Scene, lines: Sightlines, path: list[Vec2], labels: Sequence[str]
) -> list[str]:  # fmt: skip
    """Landmarks that are nowhere along the path large enough in the picture, one line each."""
    range_m = RANGE_INDOORS_M if scene.ceiling_height_m > 0 else RANGE_OUTDOORS_M
    poses, found = poses_along(path), []
    things = {thing.label: thing for thing in scene.objects}
    for label in labels:
        if label not in things:
            found.append(f"{label}: no such landmark in the scene")
            continue
        sight = lines.best(poses, things[label], range_m)
        if sight.pixels < MIN_PIXELS:
            found.append(f"{label}: at most {sight.pixels:.0f} px in the picture, {MIN_PIXELS:.0f} expected")
    return found


def worst_leak(grid: NavGrid, goal: Vec2, threshold_m: float) -> float:
    """How much further than it should be the goal is, m, from the worst free spot within the threshold; 0: sound.

    A spot behind a wall lies within the circle but a long way off: a robot there would count as having arrived.
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
