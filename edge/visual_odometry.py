"""Planar motion from the front camera: corners of the floor are tracked and seen as points of a plane of known height.

Scale comes from the camera's height, level from the robot's attitude, so the result owes nothing to its odometry. What
is not floor (walls, people, furniture) moves otherwise and is outvoted; where there is nothing to hold on to, the dark,
blur or a crowd, there is no answer instead of a bad one. A few milliseconds a frame: run it in the camera thread.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from edge.camera_geometry import Array, Attitude, CameraGeometry, FloorProjector
from edge.geometry import SE2

Grey = npt.NDArray[np.uint8]
Covariance = tuple[float, float, float, float, float, float, float, float, float]
"""Row-major 3 × 3 over (x m, y m, θ rad)."""


@dataclass(frozen=True)
class VisualConfig:
    """How corners are chosen, when an answer is given, and how far the attitude is trusted between two frames."""

    max_corners: int = 120
    min_corners: int = 14
    min_depression_rad: float = math.radians(7.0)
    """Floor nearer to the horizon than this moves too little to tell anything."""
    keyframe_distance_m: float = 0.25
    keyframe_turn_rad: float = math.radians(8.0)
    keyframe_age_ns: int = 1_000_000_000
    max_gap_ns: int = 500_000_000
    """Corners are not followed across a longer pause between frames."""
    inlier_px: float = 1.5
    min_inlier_share: float = 0.5
    min_pixel_sigma: float = 0.15
    attitude_sigma_rad: float = math.radians(0.15)
    height_sigma: float = 0.01
    """Relative error of the height between two frames."""
    min_brightness: float = 12.0
    """Mean grey value, 0..255."""
    hypotheses: int = 64

    def __post_init__(self) -> None:
        if not 6 <= self.min_corners <= self.max_corners <= 1000:
            raise ValueError("visual odometry: expected 6 <= min_corners <= max_corners <= 1000, found "
                             f"{self.min_corners} and {self.max_corners}")  # fmt: skip
        positive = (
            self.min_depression_rad, self.keyframe_distance_m, self.keyframe_turn_rad, self.keyframe_age_ns,
            self.max_gap_ns, self.inlier_px, self.min_pixel_sigma, self.attitude_sigma_rad, self.height_sigma,
            self.hypotheses,
        )  # fmt: skip
        if not all(math.isfinite(v) and v > 0 for v in positive) or not 0 < self.min_inlier_share <= 1:
            raise ValueError(f"visual odometry: expected positive settings, found {self}")


@dataclass(frozen=True)
class VisualMotion:
    """Motion of the base between two frames: pose at the later one in the level base frame of the earlier one."""

    start_ns: int
    end_ns: int
    T_start_end: SE2
    covariance: Covariance
    corners: int
    """How many corners agreed."""


@dataclass(frozen=True)
class _Keyframe:
    stamp_ns: int
    attitude: Attitude
    corners: Array


def grey_frame(jpeg: bytes, width_px: int = 320) -> Grey | None:
    """JPEG → grey picture [h, w] of about `width_px`; None when it is not a picture.

    The decoder itself shrinks by 2, 4 or 8, which is cheaper than decoding the whole.
    """
    data = np.frombuffer(jpeg, dtype=np.uint8)
    if data.size == 0:
        return None
    grey = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE if _jpeg_width(jpeg) < 2 * width_px else _reduced(jpeg, width_px))
    return None if grey is None else np.ascontiguousarray(grey, dtype=np.uint8)


def _jpeg_width(jpeg: bytes) -> int:
    """Width in the start-of-frame segment; 0 when there is none (the decoder then decides)."""
    at = 2
    while at + 9 < len(jpeg) and jpeg[at] == 0xFF:
        marker = jpeg[at + 1]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            return int.from_bytes(jpeg[at + 7 : at + 9], "big")
        at += 2 + int.from_bytes(jpeg[at + 2 : at + 4], "big")
    return 0


def _reduced(jpeg: bytes, width_px: int) -> int:
    ratio = _jpeg_width(jpeg) / width_px
    if ratio >= 8:
        return int(cv2.IMREAD_REDUCED_GRAYSCALE_8)
    return int(cv2.IMREAD_REDUCED_GRAYSCALE_4 if ratio >= 4 else cv2.IMREAD_REDUCED_GRAYSCALE_2)


class VisualOdometry:
    """Follows the floor from a key frame to the newest frame; answers once the robot has moved enough to tell."""

    def __init__(self, geometry: CameraGeometry, config: VisualConfig | None = None) -> None:
        self._geometry = geometry
        self._config = config or VisualConfig()
        self._projector: FloorProjector | None = None
        self._shape = (0, 0)
        self._previous: Grey | None = None
        self._previous_ns = 0
        self._key: _Keyframe | None = None
        self._tracked: Array = np.zeros((0, 2))
        self._rng = np.random.default_rng(0)
        self.refused = 0
        """Frames on which the floor could not be followed any more."""

    def step(self, grey: Grey, stamp_ns: int, attitude: Attitude) -> VisualMotion | None:
        """Take a frame [h, w]; the motion since the last key frame when it is due, else None.

        Frames must come in the order of their stamps; one that does not advance is ignored. Raises ValueError for a
        picture that is not uint8 [h, w].
        """
        if grey.ndim != 2 or grey.dtype != np.uint8 or min(grey.shape) < 32:
            raise ValueError(f"visual odometry: expected a grey uint8 picture, found {grey.dtype}{list(grey.shape)}")
        if self._key is not None and stamp_ns <= self._previous_ns:
            return None
        if grey.shape != self._shape:
            self._shape = (grey.shape[0], grey.shape[1])
            self._projector = FloorProjector(self._geometry, grey.shape[1], grey.shape[0])
            self._key = None
        assert self._projector is not None
        motion: VisualMotion | None = None
        restart = True
        if self._key is not None and stamp_ns - self._previous_ns <= self._config.max_gap_ns and self._follow(grey):
            motion = self._solve(self._projector, self._key, stamp_ns, attitude)
            if motion is None:
                self.refused += 1
            elif not self._due(motion, self._key):
                motion, restart = None, False
        elif self._key is not None:
            self.refused += 1
        if restart:
            self._set_keyframe(self._projector, grey, stamp_ns, attitude)
        self._previous, self._previous_ns = grey, stamp_ns
        return motion

    def _due(self, motion: VisualMotion, key: _Keyframe) -> bool:
        config = self._config
        moved = motion.T_start_end
        return (
            math.hypot(moved.x_m, moved.y_m) >= config.keyframe_distance_m
            or abs(moved.theta_rad) >= config.keyframe_turn_rad
            or motion.end_ns - motion.start_ns >= config.keyframe_age_ns
            or motion.corners < max(2 * config.min_corners, 0.4 * len(key.corners))
        )

    def _set_keyframe(self, projector: FloorProjector, grey: Grey, stamp_ns: int, attitude: Attitude) -> None:
        self._key, self._tracked = None, np.zeros((0, 2))
        if grey[::4, ::4].mean() < self._config.min_brightness:
            return
        found = cv2.goodFeaturesToTrack(
            grey, self._config.max_corners, 0.02, 6, mask=self._floor_mask(projector, attitude), blockSize=5
        )
        if found is None or len(found) < self._config.min_corners:
            return
        corners = found.reshape(-1, 2).astype(np.float64)
        self._key, self._tracked = _Keyframe(stamp_ns, attitude, corners), corners

    def _floor_mask(self, projector: FloorProjector, attitude: Attitude) -> Grey:
        """255 where a pixel would show floor that is near enough; columns are sampled, the edge between is straight."""
        height, width = self._shape
        mask = np.zeros((height, width), np.uint8)
        columns = np.linspace(0, width - 1, 9)
        rows = np.arange(height, dtype=np.float64)
        first = np.empty(9)
        for index, column in enumerate(columns):
            pixels = np.stack((np.full(height, column), rows), axis=1)
            _, depression = projector.floor_points(pixels, attitude)
            below = np.flatnonzero(depression >= self._config.min_depression_rad)
            first[index] = below[0] if len(below) else height
        edge = np.interp(np.arange(width), columns, first)
        mask[rows[:, None] >= edge[None, :]] = 255
        # A corner at the rim is about to leave the picture, and its neighbourhood is cut off.
        mask[:, :4] = mask[:, -4:] = 0
        mask[-4:, :] = 0
        return mask

    def _follow(self, grey: Grey) -> bool:
        """Track the corners from the previous frame into this one and back; False when too few come back."""
        assert self._previous is not None and self._key is not None
        before = self._tracked.astype(np.float32)[:, None, :]
        after, ok = _track(self._previous, grey, before)
        back, ok_back = _track(grey, self._previous, after)
        apart = np.abs(back - before).reshape(-1, 2).max(axis=1)
        height, width = self._shape
        at = after.reshape(-1, 2)
        inside = (at[:, 0] > 3) & (at[:, 0] < width - 4) & (at[:, 1] > 3) & (at[:, 1] < height - 4)
        good = (ok.ravel() == 1) & (ok_back.ravel() == 1) & (apart < 0.7) & inside
        if np.count_nonzero(good) < self._config.min_corners:
            return False
        self._tracked = at[good].astype(np.float64)
        self._key = replace(self._key, corners=self._key.corners[good])
        return True

    def _solve(
        self, projector: FloorProjector, key: _Keyframe, stamp_ns: int, attitude: Attitude
    ) -> VisualMotion | None:
        config = self._config
        before, _ = projector.floor_points(key.corners, key.attitude)
        after, depression = projector.floor_points(self._tracked, attitude)
        usable = depression > config.min_depression_rad / 2
        if np.count_nonzero(usable) < config.min_corners:
            return None
        start = self._vote(projector, before, after, usable, attitude)
        if start is None:
            return None
        solved = _refine(projector, before, self._tracked, attitude, start, config)
        if solved is None:
            return None
        motion, covariance, inliers = solved
        if inliers < max(config.min_corners, config.min_inlier_share * len(before)):
            return None
        return VisualMotion(key.stamp_ns, stamp_ns, motion, covariance, inliers)

    def _vote(
        self, projector: FloorProjector, before: Array, after: Array, usable: npt.NDArray[np.bool_], attitude: Attitude
    ) -> Array | None:
        """The planar motion (x, y, θ) that most corners agree with, out of those that two corners each define."""
        indices = np.flatnonzero(usable)
        pairs = self._rng.choice(indices, (self._config.hypotheses, 2))
        p, q = before[pairs], after[pairs]
        dp, dq = p[:, 1] - p[:, 0], q[:, 1] - q[:, 0]
        apart = np.hypot(dp[:, 0], dp[:, 1]) > 0.2
        if not apart.any():
            return None
        p, q, dp, dq = p[apart], q[apart], dp[apart], dq[apart]
        turn = np.arctan2(dq[:, 0] * dp[:, 1] - dq[:, 1] * dp[:, 0], (dq * dp).sum(axis=1))
        c, s = np.cos(turn), np.sin(turn)
        middle = q.mean(axis=1)
        shift = p.mean(axis=1) - np.stack(
            (c * middle[:, 0] - s * middle[:, 1], s * middle[:, 0] + c * middle[:, 1]), axis=1
        )
        motions = np.concatenate((shift, turn[:, None]), axis=1)
        moved = _seen_from(before[None], motions[:, None, :])
        errors = np.abs(projector.pixels(moved, attitude) - self._tracked[None]).max(axis=2)
        votes = np.count_nonzero(errors < 2 * self._config.inlier_px, axis=1)
        best = int(votes.argmax())
        if votes[best] < max(self._config.min_corners, self._config.min_inlier_share * len(before)):
            return None
        return np.asarray(motions[best], dtype=np.float64)


def _track(
    before: Grey, after: Grey, corners: npt.NDArray[np.float32]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint8]]:
    """Corners [n, 1, 2] of one picture in the next, and which of them were found."""
    at, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, corners.copy(), winSize=(13, 13), maxLevel=3)
    return np.asarray(at, np.float32), np.asarray(found, np.uint8)


def _seen_from(points: Array, motion: Array) -> Array:
    """Floor points [..., 2] of the earlier level base frame in the later one, which is at `motion` [..., 3] in it."""
    c, s = np.cos(motion[..., 2]), np.sin(motion[..., 2])
    x, y = points[..., 0] - motion[..., 0], points[..., 1] - motion[..., 1]
    return np.stack((c * x + s * y, c * y - s * x), axis=-1)


_STEPS = np.array((1e-4, 1e-4, 1e-4, 1e-3, 1e-4, 1e-4))


def _refine(
    projector: FloorProjector, before: Array, seen: Array, attitude: Attitude, start: Array, config: VisualConfig
) -> tuple[SE2, Covariance, int] | None:
    """Least squares in pixels over x, y, θ and the errors of height, pitch and roll between the frames.

    Robust by Tukey's weights. The three nuisance terms carry the attitude's own uncertainty as a prior; the trot moves
    the camera by centimetres and degrees, which would otherwise pass for motion. None when it does not settle.
    """
    q = np.concatenate((start, np.zeros(3)))
    prior = 1 / np.array((np.inf, np.inf, np.inf, config.height_sigma, *[config.attitude_sigma_rad] * 2)) ** 2
    height_m = projector.camera_height_m(attitude)

    def residuals(parameters: Array) -> Array:
        tilted = Attitude(
            attitude.roll_rad + parameters[5],
            attitude.pitch_rad + parameters[4],
            attitude.lift_m + height_m * parameters[3],
        )
        return projector.pixels(_seen_from(before, parameters[:3]), tilted) - seen

    sigma = config.inlier_px
    for iteration in range(8):
        r = residuals(q)
        jacobian = np.stack([(residuals(q + step) - r) / step.sum() for step in np.diag(_STEPS)], axis=-1)
        size = np.abs(r).max(axis=1)
        close = size[size < 2 * config.inlier_px]
        if len(close) < config.min_corners:
            return None
        sigma = max(config.min_pixel_sigma, 1.4826 * float(np.median(np.abs(r[size < 2 * config.inlier_px]))))
        weight = np.clip(1 - (size / min(2 * config.inlier_px, 4.7 * sigma)) ** 2, 0, None) ** 2
        weighted = jacobian * (weight / sigma**2)[:, None, None]
        normal = np.einsum("nki,nkj->ij", weighted, jacobian) + np.diag(prior)
        gradient = np.einsum("nki,nk->i", weighted, r) + prior * q
        try:
            step = np.linalg.solve(normal, -gradient)
            inverse = np.linalg.inv(normal)
        except np.linalg.LinAlgError:
            return None
        if not np.all(np.isfinite(step)) or np.abs(step[:3]).max() > 1.0:
            return None
        q = q + step
        if iteration >= 2 and np.abs(step[:3]).max() < 1e-5:
            break
    inliers = int(np.count_nonzero(weight > 0.05))
    # The axes of one corner err together, and neighbouring corners share texture: count half of them as independent.
    block = 2.0 * inverse[:3, :3]
    if not np.all(np.isfinite(q)):
        return None
    values = [float(v) for v in block.ravel()]
    covariance: Covariance = (
        values[0], values[1], values[2], values[3], values[4], values[5], values[6], values[7], values[8],
    )  # fmt: skip
    return SE2(float(q[0]), float(q[1]), float(q[2])), covariance, inliers
