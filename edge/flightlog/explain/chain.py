"""Parts of the chain from picture to motion at one tick: generation in force, people ahead, waypoints, drift."""

from __future__ import annotations

import math
from typing import Final

from edge.core.geometry import SE2
from edge.flightlog.explain.flight import Flight, Truth, bearing_rad
from edge.flightlog.replay.records import RecordedGeneration, RecordedTick
from edge.state.reasoning_text import parse_waypoints

NEAR_M: Final = 3.0
"""A person this near and ahead must be in the text, m, unless something hides the person."""
VIEW_RAD: Final = math.radians(45)
"""Half of the picture's width, less a margin, rad (field of view 100°)."""


def generation_of(flight: Flight, tick: RecordedTick) -> RecordedGeneration | None:
    """Return the generation that drove a tick; None without one in the log."""
    return None if tick.generation is None else flight.generations.get(tick.generation)


def people_ahead(truth: Truth, within_m: float) -> list[tuple[float, float]]:
    """Return distance, m, and direction, rad, of the people in the camera's field of view, the nearest first.

    Those whom a solid hides are left out where the truth says so; otherwise each may be hidden.
    """
    seen = []
    for (x_m, y_m), is_free in zip(truth.people, truth.seen or (True,) * len(truth.people), strict=True):
        there = truth.T_world_base.inverse() @ SE2(x_m, y_m, 0.0)
        distance_m, direction_rad = math.hypot(there.x_m, there.y_m), bearing_rad((there.x_m, there.y_m))
        if is_free and distance_m <= within_m and abs(direction_rad) <= VIEW_RAD:
            seen.append((distance_m, direction_rad))
    return sorted(seen)


def leading_waypoint(generation: RecordedGeneration) -> tuple[float, float] | None:
    """Return the waypoint nearest to 3 m ahead, as far as the shortest path's direction is taken; None without one."""
    points = parse_waypoints(generation.text)
    far = [point for point in points or () if math.hypot(*point) > 0.5]
    return min(far, key=lambda point: abs(math.hypot(*point) - NEAR_M), default=None)


def waypoint_at(generation: RecordedGeneration, at_s: float) -> tuple[float, float] | None:
    """Return the waypoints' position at s after the anchor, in the anchor's frame; None without or beyond them."""
    points = parse_waypoints(generation.text)
    if points is None or not 0 <= at_s <= 3.0 * len(points):
        return None
    line = ((0.0, 0.0), *points)
    index = min(int(at_s / 3.0), len(points) - 1)
    share = at_s / 3.0 - index
    a, b = line[index], line[index + 1]
    return a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])


def drift(flight: Flight, tick: RecordedTick) -> tuple[float, float] | None:
    """Return the odometry's error since the anchor of a tick, m and rad; None without truth."""
    generation = generation_of(flight, tick)
    if generation is None or tick.pose is None:
        return None
    then, now = flight.truth_at(generation.frames_ns[-1]), flight.truth_at(tick.now_ns)
    if then is None or now is None:
        return None
    true = then.T_world_base.inverse() @ now.T_world_base
    believed = generation.anchor_pose.inverse() @ tick.pose
    error = true.inverse() @ believed
    return math.hypot(error.x_m, error.y_m), error.theta_rad
