"""Visibility behind walls: rays over the floor from the camera, about one per column of a small image.

Only walls from floor to ceiling occlude, so heights do not matter. Gaps that no ray hits are narrower than the distance
between two rays.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sim_hil.scene.scene import Scene

Array = NDArray[np.float64]
Bounds = tuple[float, float, float, float]  # x0, y0, x1, y1

RAYS: Final = 160
_REACH_M: Final = 1e3
_MARGIN: Final = 1.12  # rays reach beyond the image's edges
_AROUND_M: Final = 2.0  # distance within which everything counts as visible
_THICK_M: Final = 0.3  # largest distance of a wall's faces from its centre line
_AHEAD_M: Final = 0.05
_SIDEWAYS: Final = 1e6


class Sight:
    """View distance in each direction; `ahead`: unit vector, `reach_m` [RAYS]: from right to left."""

    def __init__(self, eye: Array, ahead: Array, half_width: float, reach_m: Array) -> None:
        self.eye = eye
        self._axes = np.stack((ahead, (-ahead[1], ahead[0])), axis=1)
        self._half = half_width
        # Row k holds the furthest of 2**k columns from each on: any range is two overlapping ones of them.
        rows = [reach_m]
        while 2 ** len(rows) <= RAYS:
            step = 2 ** (len(rows) - 1)
            rows.append(np.maximum(rows[-1], np.append(rows[-1][step:], np.full(step, reach_m[-1]))))
        self._furthest = np.stack(rows)

    def sees(self, low: Array, high: Array) -> tuple[NDArray[np.bool_], Array]:
        """Return for boxes on the floor (corners [n, 2], [n, 2]) whether they may be visible, and their distance, m."""
        beside = np.maximum(np.maximum(low - self.eye, self.eye - high), 0.0)
        gap = np.hypot(beside[:, 0], beside[:, 1])
        xs, ys = np.stack((low[:, 0], high[:, 0]), 1), np.stack((low[:, 1], high[:, 1]), 1)
        corners = np.stack((xs[:, (0, 0, 1, 1)], ys[:, (0, 1, 0, 1)]), axis=2) - self.eye
        turned = corners @ self._axes
        depth, aside = turned[..., 0], turned[..., 1]
        # A corner behind the camera: the box extends beyond the image's edge on that side.
        tangent = np.where(depth > _AHEAD_M, aside / np.maximum(depth, _AHEAD_M), np.sign(aside) * _SIDEWAYS)
        columns = (tangent / self._half * 0.5 + 0.5) * (RAYS - 1)
        first, last = np.floor(columns.min(axis=1)), np.ceil(columns.max(axis=1))
        inside = (last >= 0) & (first <= RAYS - 1) & (depth.max(axis=1) > _AHEAD_M)
        a, b = (np.clip(edge, 0, RAYS - 1).astype(np.int64) for edge in (first, last))
        row = np.log2(b - a + 1).astype(np.int64)
        furthest = np.maximum(self._furthest[row, a], self._furthest[row, b + 1 - 2**row])
        return (inside & (gap < furthest + _THICK_M)) | (gap < _AROUND_M), gap


class Visibility:
    """Visibility of a scene's pieces; `bounds`: the pieces' extents on the floor, m."""

    def __init__(self, scene: Scene, bounds: Sequence[Bounds]) -> None:
        high = scene.ceiling_height_m
        hiding = [wall for wall in scene.walls if 0 < high <= wall.height_m + 0.1]
        self._starts = np.array([wall.start_m for wall in hiding]).reshape(-1, 2)
        self._spans = np.array([wall.end_m for wall in hiding]).reshape(-1, 2) - self._starts
        boxes = np.array(bounds).reshape(-1, 4)
        self._low, self._high = boxes[:, :2], boxes[:, 2:]

    def sight(self, eye_xy: Array, ahead_xy: Array, half_width: float) -> Sight:
        """Cast the rays from the camera around a unit vector, up to `half_width` (a tangent) on each side."""
        half = half_width * _MARGIN
        rays = ahead_xy + np.linspace(-half, half, RAYS)[:, None] * np.array((-ahead_xy[1], ahead_xy[0]))
        rays /= np.hypot(rays[:, 0], rays[:, 1])[:, None]
        reach = np.full(RAYS, _REACH_M)
        if len(self._starts):
            # Where the ray eye + t ray meets the wall start + s span.
            to, across = self._starts - eye_xy, rays[:, :1] * self._spans[:, 1] - rays[:, 1:] * self._spans[:, 0]
            with np.errstate(divide="ignore", invalid="ignore"):
                t = (to[:, 0] * self._spans[:, 1] - to[:, 1] * self._spans[:, 0]) / across
                s = (to[:, 0] * rays[:, 1:] - to[:, 1] * rays[:, :1]) / across
            reach = np.where((t > 0) & (s >= 0) & (s <= 1), t, _REACH_M).min(axis=1)
        return Sight(eye_xy, ahead_xy, half, reach)

    def pieces(self, sight: Sight) -> NDArray[np.int64]:
        """Return the pieces that may be visible, nearest first."""
        seen, gap = sight.sees(self._low, self._high)
        shown = np.flatnonzero(seen)
        order: NDArray[np.int64] = shown[np.argsort(gap[shown], kind="stable")]
        return order
