"""Pictures of a made-up floor, a ray through every pixel: what the camera would see from a known pose."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from edge.core.geometry import SE2
from edge.odometry.camera_geometry import Attitude, CameraGeometry, FloorProjector

GEOMETRY = CameraGeometry(hfov_rad=1.745, height_m=0.36, pitch_rad=0.05, forward_m=0.3)
WIDTH_PX, HEIGHT_PX = 320, 180
_PX_PER_M = 50.0
_SIZE_M = 20.0


def floor_texture(seed: int = 0) -> npt.NDArray[np.float32]:
    """A floor of soft blotches, `_PX_PER_M` pixels a metre."""
    side = round(_SIZE_M * _PX_PER_M)
    noise = np.random.default_rng(seed).normal(0, 1, (side, side)).astype(np.float32)
    soft = cv2.GaussianBlur(noise, (0, 0), 4.0)
    return np.asarray(128 + 45 * soft / soft.std(), dtype=np.float32)


def picture(
    texture: npt.NDArray[np.float32], pose: SE2, attitude: Attitude | None = None, geometry: CameraGeometry = GEOMETRY
) -> npt.NDArray[np.uint8]:
    """What the camera sees from a pose on the floor; even grey above the horizon."""
    projector = FloorProjector(geometry, WIDTH_PX, HEIGHT_PX)
    columns, rows = np.meshgrid(np.arange(WIDTH_PX), np.arange(HEIGHT_PX))
    pixels = np.stack((columns.ravel(), rows.ravel()), axis=1).astype(np.float64)
    points, depression = projector.floor_points(pixels, attitude or Attitude())
    c, s = np.cos(pose.theta_rad), np.sin(pose.theta_rad)
    x = pose.x_m + c * points[:, 0] - s * points[:, 1]
    y = pose.y_m + s * points[:, 0] + c * points[:, 1]
    middle = _SIZE_M / 2
    shape = (HEIGHT_PX, WIDTH_PX)
    # Towards the horizon the floor is far outside the texture.
    at_x, at_y = ((np.clip(v + middle, 0, _SIZE_M) * _PX_PER_M).astype(np.float32).reshape(shape) for v in (x, y))
    seen = cv2.remap(texture, at_x, at_y, cv2.INTER_LINEAR)
    floor = (depression > 0.06).reshape(shape)
    return np.where(floor, np.clip(seen, 0, 255), 200).astype(np.uint8)
