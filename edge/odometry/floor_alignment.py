"""Planar motion between two pictures of the floor by least squares: first by corners, then by the pictures themselves.

Six unknowns: x, y, θ of the base, and the errors of roll, pitch and height between the two pictures. The latter three
have the attitude's uncertainty as a prior; the trot moves the camera by centimetres and degrees, which would otherwise
count as motion. Tukey's weights reject pixels off the floor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from edge.odometry.camera_geometry import Array, Attitude, FloorProjector, seen_from

Picture = npt.NDArray[np.float32]
_STEPS = np.array((1e-4, 1e-4, 1e-4, 1e-3, 1e-4, 1e-4, 1e-4))


PIXEL_SIGMA = 0.15
"""Smallest error of a tracked corner, pixels."""
INLIER_PX = 1.5
ATTITUDE_SIGMA_RAD = math.radians(0.15)
HEIGHT_SIGMA = 0.01
"""Relative error of the height between two frames."""
TILT_SIGMA_RAD = math.radians(0.1)
"""Prior of the camera's angle to the floor for one pair of pictures."""
GREY_SIGMA = 1.5
"""Smallest error of a pixel of a smoothed picture, grey levels."""
SMOOTH_PX = 1.0
POINTS = 500
MIN_POINTS = 150
MIN_GRADIENT = 2.5
"""Grey levels a pixel: flatter floor gives no information."""
RANGE_HEIGHTS = 2.6 / 0.3545
HALF_WIDTH_HEIGHTS = 1.6 / 0.3545
"""Floor that is compared, in heights of the camera: so far, a pixel shows as much of the floor at any height."""
MIN_SHARE = 0.5
SETTLE_M = 0.06
SETTLE_RAD = math.radians(3.0)
"""Largest deviation of the pictures' answer from that of the corners."""
CORRELATION = 8.5
"""Factor on the covariance of independent pixels: neighbours share blur, texture and sampling."""
_PRIOR: Array = np.array((0.0, 0.0, 0.0, HEIGHT_SIGMA**-2, ATTITUDE_SIGMA_RAD**-2, ATTITUDE_SIGMA_RAD**-2))
"""Information [6] on the six unknowns."""


@dataclass(frozen=True)
class Solution:
    """The unknowns, the covariance [3, 3] of x, y and θ, how many measurements agreed and their share of all.

    A fit of the pictures has a seventh unknown, the camera's tilt in both: `tilt_rad` is its estimate without a prior,
    `tilt_sigma_rad` the standard error.
    """

    unknowns: Array
    covariance: Array
    inliers: int
    share: float
    tilt_rad: float = 0.0
    tilt_sigma_rad: float = math.inf


def smooth(grey: npt.NDArray[np.uint8]) -> Picture:
    """Smooth a picture for the comparison: remove the finest detail, which sampling does not reproduce."""
    return np.asarray(cv2.GaussianBlur(grey.astype(np.float32), (0, 0), SMOOTH_PX), dtype=np.float32)


def fit_corners(
    projector: FloorProjector, before: Array, seen: Array, attitude: Attitude, start: Array
) -> Solution | None:
    """Fit floor points [n, 2] of the earlier frame to pixels [n, 2] of the later one; None when it does not settle."""
    q = np.concatenate((start, np.zeros(3)))
    outlier = 2 * INLIER_PX
    normal = np.eye(6)
    weight = np.zeros(len(before))
    jacobian = np.zeros((len(before), 2, 6))
    for iteration in range(8):
        # The derivatives hardly change within a few pixels, and cost six times as much as the residuals.
        if iteration in (0, 2):
            at = _project(projector, before, attitude, q)
            steps = np.diag(_STEPS)[:6, :6]
            moved = [_project(projector, before, attitude, q + step) - at for step in steps]
            jacobian = np.stack([change / step.sum() for change, step in zip(moved, steps, strict=True)], axis=-1)
        else:
            at = _project(projector, before, attitude, q)
        r = at - seen
        size = np.abs(r).max(axis=1)
        close = size < outlier
        if np.count_nonzero(close) < 6:
            return None
        sigma = max(PIXEL_SIGMA, 1.4826 * float(np.median(np.abs(r[close]))))
        weight = np.clip(1 - (size / min(outlier, 4.7 * sigma)) ** 2, 0, None) ** 2
        weighted = jacobian * (weight / sigma**2)[:, None, None]
        normal = np.einsum("nki,nkj->ij", weighted, jacobian) + np.diag(_PRIOR)
        step = _solve(normal, np.einsum("nki,nk->i", weighted, r) + _PRIOR * q)
        if step is None:
            return None
        q = q + step
        if iteration >= 2 and np.abs(step[:3]).max() < 1e-4:
            break
    inliers = int(np.count_nonzero(weight > 0.05))
    # The axes of one corner err together, and neighbouring corners share texture: count half of them as independent.
    covariance = _inverse(normal)
    return None if covariance is None else Solution(q, 2.0 * covariance[:3, :3], inliers, inliers / len(before))


def align_pictures(
    projector: FloorProjector, key: Picture, key_attitude: Attitude, now: Picture, attitude: Attitude,
    start: Array, floor: npt.NDArray[np.uint8],
) -> Solution | None:  # fmt: skip
    """Fit the later smoothed picture to the earlier one where `floor` is set; `start` [6] must be within a few pixels.

    Edges count as much as corners here, each in the direction that it constrains. None when it does not settle.
    """
    pixels = _strong_pixels(key, floor)
    points, _ = projector.floor_points(pixels.astype(np.float64), key_attitude)
    height_m = projector.geometry.height_m
    near = (points[:, 0] < RANGE_HEIGHTS * height_m) & (np.abs(points[:, 1]) < HALF_WIDTH_HEIGHTS * height_m)
    pixels, points = pixels[near], points[near]
    if len(pixels) < MIN_POINTS:
        return None
    wanted = key[pixels[:, 1], pixels[:, 0]].astype(np.float64)
    # Half of the next and half of the previous pixel: the derivative of the picture that is sampled linearly below.
    slope = _slopes(now)
    q, normal = np.append(start, 0.0), np.eye(7)
    prior = np.append(_PRIOR, 1 / TILT_SIGMA_RAD**2) * CORRELATION
    chosen = pixels.astype(np.float64)
    height, width = now.shape
    weight = np.zeros(0)
    rows = np.zeros((len(points), 7))

    def reprojected(unknowns: Array) -> Array:
        tilted = replace(key_attitude, pitch_rad=key_attitude.pitch_rad + float(unknowns[6]))
        points, _ = projector.floor_points(chosen, tilted)
        return _project(
            projector, points, replace(attitude, pitch_rad=attitude.pitch_rad + float(unknowns[6])), unknowns
        )

    for iteration in range(10):
        if iteration in (0, 2):
            at = reprojected(q)
            jacobian = np.stack([(reprojected(q + step) - at) / step.sum() for step in np.diag(_STEPS)], axis=-1)
        else:
            at = reprojected(q)
        inside = (at[:, 0] > 2) & (at[:, 0] < width - 3) & (at[:, 1] > 2) & (at[:, 1] < height - 3)
        if np.count_nonzero(inside) < MIN_POINTS:
            return None
        spots = at[inside].astype(np.float32)
        r = _sampled(now, spots) - wanted[inside]
        r = r - np.median(r)  # exposure may change
        sigma = max(GREY_SIGMA, 1.4826 * float(np.median(np.abs(r))))
        weight = np.clip(1 - (r / (4.7 * sigma)) ** 2, 0, None) ** 2
        if iteration in (0, 2):
            slopes = np.zeros((len(points), 2))
            slopes[inside] = np.stack([_sampled(picture, spots) for picture in slope], axis=1)
            rows = (slopes[:, None, :] @ jacobian)[:, 0, :]
        weighted = rows[inside] * (weight / sigma**2)[:, None]
        normal = weighted.T @ rows[inside] + np.diag(prior)
        step = _solve(normal, weighted.T @ r + prior * q)
        if step is None:
            return None
        q = q + step
        if iteration >= 2 and np.abs(step[:3]).max() < 1e-4:
            break
    inliers = int(np.count_nonzero(weight > 0.05))
    inverse = _inverse(normal)
    if inverse is None:
        return None
    covariance = CORRELATION * inverse
    # Remove the prior: a sum of many such answers must not count it many times.
    information = 1.0 - float(covariance[6, 6]) / TILT_SIGMA_RAD**2
    tilt_rad, tilt_sigma_rad = 0.0, math.inf
    if information > 0.02:
        tilt_rad, tilt_sigma_rad = (
            float(q[6]) / information,
            TILT_SIGMA_RAD * math.sqrt((1 - information) / information),
        )
    return Solution(q, covariance[:3, :3], inliers, inliers / len(weight), tilt_rad, tilt_sigma_rad)


def _project(projector: FloorProjector, points: Array, attitude: Attitude, q: Array) -> Array:
    height_m = projector.camera_height_m(attitude)
    tilted = Attitude(
        attitude.roll_rad + float(q[5]), attitude.pitch_rad + float(q[4]), attitude.lift_m + height_m * float(q[3])
    )
    return projector.pixels(seen_from(points, q[:3]), tilted)


def _solve(normal: Array, gradient: Array) -> Array | None:
    """Solve a least-squares step; None when it is singular or far beyond any frame's motion."""
    try:
        step = np.linalg.solve(normal, -gradient)
    except np.linalg.LinAlgError:
        return None
    return np.asarray(step, np.float64) if np.all(np.isfinite(step)) and np.abs(step[:3]).max() < 1.0 else None


def _inverse(normal: Array) -> Array | None:
    """Return the covariance of a least-squares problem; None when a direction is unconstrained."""
    try:
        inverse = np.asarray(np.linalg.inv(normal), np.float64)
    except np.linalg.LinAlgError:
        return None
    return inverse if np.all(np.isfinite(inverse)) and np.all(np.diag(inverse) > 0) else None


def _strong_pixels(key: Picture, floor: npt.NDArray[np.uint8]) -> npt.NDArray[np.int64]:
    """Return floor pixels [n, 2] (column, row) with enough slope, evenly thinned to about `points`."""
    gx, gy = _slopes(key)
    rows, columns = np.nonzero((np.hypot(gx, gy) > MIN_GRADIENT) & (floor > 0))
    every = max(1, len(rows) // POINTS)
    return np.stack((columns[::every], rows[::every]), axis=1)


def _slopes(picture: Picture) -> tuple[Picture, Picture]:
    """Return the derivatives along columns and rows, grey levels a pixel."""
    across, down = (cv2.Sobel(picture, cv2.CV_32F, dx, 1 - dx, scale=1 / 8) for dx in (1, 0))
    return np.asarray(across, np.float32), np.asarray(down, np.float32)


def _sampled(picture: Picture, at: npt.NDArray[np.float32]) -> Array:
    """Interpolate grey values [n] at fractional pixels [n, 2]."""
    values = cv2.remap(picture, at[None, :, 0], at[None, :, 1], cv2.INTER_LINEAR)
    return np.asarray(values[0], dtype=np.float64)
