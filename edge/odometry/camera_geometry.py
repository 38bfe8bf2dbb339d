"""Mount and projection of the front camera: pixels ↔ points on a level floor, for a body that rolls and pitches.

The body frame is x forward, y left, z up. Attitude is that of rotation Rz(yaw) Ry(pitch) Rx(roll): positive pitch is
nose down. The *level base frame* is the body frame rotated to level; floor points are in it, x and y in m.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class CameraGeometry:
    """Pinhole with square pixels, mounted `forward_m` ahead of the base origin.

    `height_m`: camera above the floor while the robot stands level. `pitch_rad`: pitch downwards from the body's x
    axis. Raises ValueError for values beyond any front camera.
    """

    hfov_rad: float
    height_m: float
    pitch_rad: float
    forward_m: float

    def __post_init__(self) -> None:
        checks = (
            (0.3 <= self.hfov_rad <= 2.8, f"hfov_rad: expected 0.3..2.8, found {self.hfov_rad}"),
            (0.05 <= self.height_m <= 3.0, f"height_m: expected 0.05..3, found {self.height_m}"),
            (-0.8 <= self.pitch_rad <= 1.4, f"pitch_rad: expected -0.8..1.4, down positive; found {self.pitch_rad}"),
            (-2.0 <= self.forward_m <= 2.0, f"forward_m: expected -2..2, found {self.forward_m}"),
        )
        for good, message in checks:
            if not good:
                raise ValueError(f"camera geometry: {message}")


@dataclass(frozen=True)
class Attitude:
    """Roll and pitch of the body, rad, and height of its base above (+) or below the usual one, m."""

    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    lift_m: float = 0.0

    def __post_init__(self) -> None:
        if not all(math.isfinite(v) for v in (self.roll_rad, self.pitch_rad, self.lift_m)):
            raise ValueError(f"attitude ({self.roll_rad}, {self.pitch_rad}, {self.lift_m}) is not finite")


class FloorProjector:
    """Projection between pixels of one picture size and the floor."""

    def __init__(self, geometry: CameraGeometry, width_px: int, height_px: int) -> None:
        self.focal_px = width_px / 2 / math.tan(geometry.hfov_rad / 2)
        self._cx = (width_px - 1) / 2
        self._cy = (height_px - 1) / 2
        self.geometry = geometry

    def camera_height_m(self, attitude: Attitude) -> float:
        """Height of the camera above the floor, m; a nose-down pitch lowers it."""
        return self.geometry.height_m + attitude.lift_m - self.geometry.forward_m * math.sin(attitude.pitch_rad)

    def floor_points(self, pixels: Array, attitude: Attitude) -> tuple[Array, Array]:
        """Project pixels [n, 2] to floor points in the level base frame [n, 2], m, and depression below level [n], rad.

        A pixel at or above the horizon gives a meaningless point: check its depression.
        """
        rays = self._level_rays(pixels, attitude)
        horizontal = np.hypot(rays[:, 0], rays[:, 1])
        depression = np.arctan2(-rays[:, 2], horizontal)
        drop = np.maximum(-rays[:, 2], 1e-6)
        points = rays[:, :2] * (self.camera_height_m(attitude) / drop)[:, None]
        points[:, 0] += self.geometry.forward_m * math.cos(attitude.pitch_rad)
        return points, depression

    def pixels(self, points: Array, attitude: Attitude) -> Array:
        """Project floor points [..., 2] in the level base frame to pixels [..., 2]; points behind give a far pixel."""
        x = points[..., 0] - self.geometry.forward_m * math.cos(attitude.pitch_rad)
        y, z = points[..., 1], -self.camera_height_m(attitude)
        cp, sp = math.cos(attitude.pitch_rad), math.sin(attitude.pitch_rad)
        cr, sr = math.cos(attitude.roll_rad), math.sin(attitude.roll_rad)
        bx, level_z = cp * x - sp * z, sp * x + cp * z
        by, bz = cr * y + sr * level_z, -sr * y + cr * level_z
        cc, sc = math.cos(self.geometry.pitch_rad), math.sin(self.geometry.pitch_rad)
        forward, up = cc * bx - sc * bz, sc * bx + cc * bz
        forward = np.maximum(forward, 1e-3)
        return np.stack((self._cx - self.focal_px * by / forward, self._cy - self.focal_px * up / forward), axis=-1)

    def _level_rays(self, pixels: Array, attitude: Attitude) -> Array:
        left = (self._cx - pixels[:, 0]) / self.focal_px
        up = (self._cy - pixels[:, 1]) / self.focal_px
        cc, sc = math.cos(self.geometry.pitch_rad), math.sin(self.geometry.pitch_rad)
        bx, bz = cc + sc * up, cc * up - sc
        cr, sr = math.cos(attitude.roll_rad), math.sin(attitude.roll_rad)
        y, z = cr * left - sr * bz, sr * left + cr * bz
        cp, sp = math.cos(attitude.pitch_rad), math.sin(attitude.pitch_rad)
        return np.stack((cp * bx + sp * z, y, cp * z - sp * bx), axis=1)


def seen_from(points: Array, motion: Array) -> Array:
    """Transform floor points [..., 2] from an earlier level base frame to a later one at `motion` [..., 3] in it."""
    c, s = np.cos(motion[..., 2]), np.sin(motion[..., 2])
    x, y = points[..., 0] - motion[..., 0], points[..., 1] - motion[..., 1]
    return np.stack((c * x + s * y, c * y - s * x), axis=-1)
