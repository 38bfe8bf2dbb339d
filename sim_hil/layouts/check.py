"""Validity checks of a layout: objects do not overlap, all areas can be reached, and places are free."""

from __future__ import annotations

from math import hypot

import numpy as np
from numpy.typing import NDArray

from sim_hil.scene.nav_grid import NavGrid
from sim_hil.scene.scene import Box, Scene

ROBOT_RADIUS_M = 0.4
PERSON_RADIUS_M = 0.25
_LARGE_M2 = 3000.0  # area above which a coarse grid suffices (outdoor scenes have no narrow passages)
_TOUCH_M = 0.004  # overlap that is allowed, because objects may touch


def problems(scene: Scene, grid: NavGrid | None = None) -> list[str]:
    """Return the problems of a scene, one line each; `grid`: its navigation grid for ROBOT_RADIUS_M, if available."""
    found = overlaps(scene)
    if grid is None:
        (x0, y0), (x1, y1) = scene.floor_min_m, scene.floor_max_m
        fine = (x1 - x0) * (y1 - y0) < _LARGE_M2
        grid = NavGrid(scene, clearance_m=ROBOT_RADIUS_M, resolution_m=0.1 if fine else 0.2)
    x, y, _ = scene.start
    if not grid.is_free(x, y):
        return [*found, f"start ({x:.2f}, {y:.2f}) is not free for a robot of radius {ROBOT_RADIUS_M} m"]
    field = grid.distance_field((x, y))
    if not np.isfinite(grid.field_at(field, *scene.goal_xy)):
        found.append(f"goal_xy ({scene.goal_xy[0]:.2f}, {scene.goal_xy[1]:.2f}) cannot be reached from the start")
    return found + unreached_areas(scene, grid, field) + bad_places(scene, grid, field)


def overlaps(scene: Scene) -> list[str]:
    """Return the pairs of solid objects, or of an object and a wall, that overlap."""
    boxes = [(thing.label, box) for thing in scene.objects for box in thing.boxes]
    walls = [(wall.label, wall.box) for wall in scene.walls]
    found = []
    for index, (label, box) in enumerate(boxes):
        for other, against in boxes[index + 1 :] + walls:
            if other != label and boxes_overlap(box, against):
                line = f"{label} stands in {other}"
                if line not in found:
                    found.append(line)
    return found


def boxes_overlap(a: Box, b: Box) -> bool:
    """Return whether two upright boxes overlap (separating axes; touching boxes do not)."""
    if abs(a.centre_m[2] - b.centre_m[2]) >= (a.size_m[2] + b.size_m[2]) / 2 - _TOUCH_M:
        return False
    dx, dy = b.centre_m[0] - a.centre_m[0], b.centre_m[1] - a.centre_m[1]
    if hypot(dx, dy) > (hypot(*a.size_m[:2]) + hypot(*b.size_m[:2])) / 2:
        return False
    for c, s in (a.axis, (-a.axis[1], a.axis[0]), b.axis, (-b.axis[1], b.axis[0])):
        reach = 0.0
        for box in (a, b):
            u, v = box.axis
            reach += box.size_m[0] / 2 * abs(c * u + s * v) + box.size_m[1] / 2 * abs(-c * v + s * u)
        if abs(dx * c + dy * s) >= reach - _TOUCH_M:
            return False
    return True


def unreached_areas(scene: Scene, grid: NavGrid, field: NDArray[np.float64]) -> list[str]:
    """Return the areas without a reachable free cell."""
    reached = np.isfinite(field)
    rows, columns = np.nonzero(reached)
    xs = grid.origin_m[0] + (columns + 0.5) * grid.resolution_m
    ys = grid.origin_m[1] + (rows + 0.5) * grid.resolution_m
    found = []
    for area in scene.areas:
        px, py = zip(*area.polygon, strict=True)
        # Areas are nearly axis-aligned rectangles, so the inner part of the bounding box suffices.
        inside = (xs > min(px) + 0.3) & (xs < max(px) - 0.3) & (ys > min(py) + 0.3) & (ys < max(py) - 0.3)
        if area.kind not in ("garden", "street") and not inside.any():
            found.append(f"{area.label} cannot be reached by a robot of radius {ROBOT_RADIUS_M} m")
    return found


def bad_places(scene: Scene, grid: NavGrid, field: NDArray[np.float64]) -> list[str]:
    """Return the places that are not free for a person or cannot be reached."""
    found = []
    for place in scene.places:
        if place.kind == "sit":
            continue
        if grid.clearance_m(*place.position_m) < PERSON_RADIUS_M:
            found.append(f"place {place.label} is not free")
        elif not np.isfinite(grid.field_at(field, *place.position_m)):
            found.append(f"place {place.label} cannot be reached")
    return found
