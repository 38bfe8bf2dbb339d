"""Choice of a walking person's velocity by sampled reciprocal velocity obstacles; pure functions on arrays.

Each person compares candidate velocities around the preferred one (van den Berg et al. 2008: two people who meet share
the avoidance equally). The cost rates the deviation from the preferred velocity, time to collision, passing distance
and distance to walls. The caller leaves out what a person does not see.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_hil.crowd.walkable_map import CrowdMap

Array = NDArray[np.float64]

HORIZON_S = 2.6  # later collisions are ignored
# Candidates: turns, rad (left positive), and shares of the speed; then standing, a slow step back, and no change.
_TURNS = np.array((0.0, 0.18, -0.18, 0.4, -0.4, 0.7, -0.7, 1.05, -1.05, 1.6, -1.6))
_FAST = len(_TURNS)
_SLOW = np.array((0.0, 0.25, -0.25, 0.7, -0.7, 1.3, -1.3, 2.1, -2.1))
_ANGLES = np.concatenate((_TURNS, _SLOW, (0.0, np.pi)))
_SHARES = np.concatenate((np.full(_FAST, 1.0), np.full(len(_SLOW), 0.5), (0.0, 0.3)))
_COS, _SIN = np.cos(_ANGLES) * _SHARES, np.sin(_ANGLES) * _SHARES
_IDLE = np.append(1.0 - _SHARES, 0.5)
_LEFT = np.append(np.where((_ANGLES > 0) & (_ANGLES < 3), 0.05, 0.0), 0.0)  # small cost: people prefer the right side

_COLLISION, _CLOSE, _INERTIA, _WALL, _WALL_AIR = 3.2, 0.9, 0.65, 2.6, 0.45
_SOON_S = 0.25  # a collision now costs _COLLISION / _SOON_S
_NONE_S = 1e3
_WALL_TIMES_S = np.array((0.25, 0.55, 1.0))
_WALL_COSTS = _WALL * (1.0 / (_WALL_TIMES_S + _SOON_S) - 1.0 / (1.6 + _SOON_S))
_WALL_M, _AIR_M = 0.25, 0.5


@dataclass(frozen=True)
class Nearby:
    """Surroundings of m people, arrays [m, k]; x and y are offsets, m.

    A collision is a centre distance below `touch`, a close pass one below `close`, m. With `share` 2 the neighbour
    avoids too, and (ux, uy) is the sum of both velocities; with 1 it does not, and (ux, uy) is the neighbour's.
    """

    x: Array
    y: Array
    ux: Array
    uy: Array
    share: Array
    touch: Array
    close: Array


def choose(
    ways: CrowdMap, position: tuple[Array, Array], velocity: tuple[Array, Array], preferred: tuple[Array, Array],
    pace_mps: Array, hurry: Array, nearby: Nearby,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Return the chosen velocities of m people, m/s, and their times to collision, s.

    position, velocity, preferred (velocity): x and y arrays [m], m and m/s. pace_mps [m]: speed of the fastest
    candidates. hurry [m]: extra cost of standing still, so that people who have waited long accept detours.
    """
    (x, y), (vx, vy), (lx, ly) = position, velocity, preferred
    norm = np.sqrt(lx * lx + ly * ly)
    scale = pace_mps / np.maximum(norm, 1e-6)
    ex, ey = lx * scale, ly * scale
    cx = np.concatenate((ex[:, None] * _COS - ey[:, None] * _SIN, vx[:, None]), axis=1)
    cy = np.concatenate((ey[:, None] * _COS + ex[:, None] * _SIN, vy[:, None]), axis=1)
    per_pace = (1.0 / pace_mps)[:, None]
    cost = _length(cx - lx[:, None], cy - ly[:, None]) * per_pace
    cost += _length(cx - vx[:, None], cy - vy[:, None]) * (_INERTIA * per_pace)
    cost += _LEFT
    cost += hurry[:, None] * _IDLE

    meet_s, closeness = _meetings(cx, cy, nearby)
    cost += _COLLISION * np.maximum(1.0 / (meet_s + _SOON_S) - 1.0 / (HORIZON_S + _SOON_S), 0.0)
    cost += _CLOSE * closeness
    cost += _walls(ways, x, y, cx, cy)
    best = np.argmin(cost, axis=1)
    rows = np.arange(len(x))
    return cx[rows, best], cy[rows, best], meet_s[rows, best]


def _length(x: Array, y: Array) -> Array:
    return np.sqrt(x * x + y * y)


def _meetings(cx: Array, cy: Array, near: Nearby) -> tuple[Array, Array]:
    """Return for each candidate [m, c] the time to collision, s, and the closeness of the closest pass, 0..1."""
    share = near.share[:, None, :]
    wx = cx[:, :, None] * share - near.ux[:, None, :]
    wy = cy[:, :, None] * share - near.uy[:, None, :]
    px, py = near.x[:, None, :], near.y[:, None, :]
    square = wx * wx + wy * wy + 1e-9
    toward = px * wx + py * wy
    gap2 = px * px + py * py
    touch2 = (near.touch * near.touch)[:, None, :]
    inside = toward * toward - square * (gap2 - touch2)
    hits = (toward > 0) & (inside > 0)
    meet = np.where(hits, (toward - np.sqrt(np.maximum(inside, 0.0))) / square, _NONE_S)
    meet_s = np.maximum(meet, 0.0)
    nearest_s = np.minimum(np.maximum(toward / square, 0.0), 1.6)
    pass_m = np.sqrt(np.maximum(gap2 + nearest_s * (nearest_s * square - 2.0 * toward), 0.0))
    touch = near.touch[:, None, :]
    close = (near.close[:, None, :] - pass_m) / (near.close[:, None, :] - touch)
    close = np.minimum(np.maximum(close, 0.0), 1.0) * (1.0 - nearest_s * (0.7 / 1.6))
    return meet_s.min(axis=2), close.max(axis=2)


def _walls(ways: CrowdMap, x: Array, y: Array, cx: Array, cy: Array) -> Array:
    """Return for each candidate [m, c] the cost of hitting a wall or of walking close along it."""
    gaps = ways.gaps_at(
        x[:, None, None] + cx[:, :, None] * _WALL_TIMES_S, y[:, None, None] + cy[:, :, None] * _WALL_TIMES_S
    )
    here = ways.gaps_at(x, y)[:, None, None]
    # A person already closer to a wall may walk along it and away from it.
    limit = np.minimum(_WALL_M, here - 0.03)
    hit = np.where(gaps < limit, _WALL_COSTS, 0.0).max(axis=2)
    air = np.minimum(np.maximum((_AIR_M - gaps[:, :, 1]) * (1.0 / _AIR_M), 0.0), 1.0)
    return np.asarray(hit + _WALL_AIR * air)
