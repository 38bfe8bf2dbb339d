"""Planar motion from the front camera: tracks corners of the floor as points of a plane at the camera's height.

Scale comes from the camera's height and level from the robot's attitude, so the result does not depend on odometry.
Objects off the floor (walls, people, furniture) move differently and are outvoted. In the dark, in blur or in a crowd
there is no answer instead of a bad one. It takes a few milliseconds a frame: run it in the camera thread.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from edge.core.geometry import SE2
from edge.core.jpeg import jpeg_refusal, jpeg_size
from edge.odometry.camera_geometry import Array, Attitude, CameraGeometry, FloorProjector, seen_from
from edge.odometry.floor_alignment import (
    INLIER_PX,
    MIN_SHARE,
    SETTLE_M,
    SETTLE_RAD,
    Picture,
    Solution,
    align_pictures,
    fit_corners,
    smooth,
)

Grey = npt.NDArray[np.uint8]
Covariance = tuple[float, float, float, float, float, float, float, float, float]
"""Row-major 3 × 3 over (x m, y m, θ rad)."""


MAX_CORNERS = 80
MIN_CORNERS = 12
RENEW_CORNERS = 18
"""Number of corners below which an answer is given early, while it is possible."""
MIN_DEPRESSION_RAD = math.radians(7.0)
"""Smallest angle below the horizon of measurable floor: farther floor moves too little."""
KEYFRAME_DISTANCE_M = 0.25
KEYFRAME_TURN_RAD = math.radians(8.0)
KEYFRAME_AGE_NS = 1_000_000_000
MAX_GAP_NS = 500_000_000
"""Longest pause between frames across which corners are tracked."""
MIN_INLIER_SHARE = 0.4
MIN_BRIGHTNESS = 12.0
"""Mean grey value, 0..255."""
HYPOTHESES = 64
TILT_SIGMA_RAD = math.radians(0.2)
"""Error of the camera's angle to the floor: mounting, lens centre and the robot's attitude together."""
TILT_CAUTION = 2.0
"""Factor on the error of one estimate of it: pixel errors correlate from frame to frame."""
TILT_FLOOR_RAD = math.radians(0.03)
"""Smallest uncertainty of it, which keeps it learning."""
MAX_TILT_RAD = math.radians(1.0)


@dataclass(frozen=True)
class VisualMotion:
    """Motion of the base between two frames: pose at the later one in the level base frame of the earlier one."""

    start_ns: int
    end_ns: int
    T_start_end: SE2
    covariance: Covariance
    corners: int
    """Number of agreeing corners."""


@dataclass(frozen=True)
class _Keyframe:
    stamp_ns: int
    attitude: Attitude
    corners: Array
    picture: Picture
    floor: Grey


def grey_frame(jpeg: bytes, width_px: int = 320) -> Grey | None:
    """Decode a JPEG to a grey picture [h, w] of about `width_px`; None for an invalid picture or size.

    The decoder shrinks by 2, 4 or 8, which is cheaper than decoding at full size.
    """
    size = jpeg_size(jpeg)
    if size is None or jpeg_refusal(jpeg) is not None:
        return None
    try:
        grey = cv2.imdecode(np.frombuffer(jpeg, dtype=np.uint8), _reduced(size[0] / width_px))
    except cv2.error:
        return None
    return None if grey is None else np.ascontiguousarray(grey, dtype=np.uint8)


def _reduced(ratio: float) -> int:
    if ratio < 2:
        return int(cv2.IMREAD_GRAYSCALE)
    if ratio >= 8:
        return int(cv2.IMREAD_REDUCED_GRAYSCALE_8)
    return int(cv2.IMREAD_REDUCED_GRAYSCALE_4 if ratio >= 4 else cv2.IMREAD_REDUCED_GRAYSCALE_2)


class VisualOdometry:
    """Tracks the floor from a key frame to the newest frame; answers once the robot has moved enough."""

    def __init__(self, geometry: CameraGeometry) -> None:
        self._geometry = geometry
        self._projector: FloorProjector | None = None
        self._shape = (0, 0)
        self._previous: Grey | None = None
        self._previous_ns = 0
        self._key: _Keyframe | None = None
        self._tracked: Array = np.zeros((0, 2))
        self._rng = np.random.default_rng(0)
        self.tilt_rad = 0.0
        """Learned error of the camera's pitch, rad: true less stated downward pitch."""
        self._tilt_variance = TILT_SIGMA_RAD**2
        self.refused = 0
        """Number of frames at which tracking was lost."""

    def step(self, grey: Grey, stamp_ns: int, attitude: Attitude) -> VisualMotion | None:
        """Take a frame [h, w]; return the motion since the last key frame when it is due, else None.

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
        attitude = replace(attitude, pitch_rad=attitude.pitch_rad + self.tilt_rad)
        motion: VisualMotion | None = None
        restart = True
        if self._key is not None and stamp_ns - self._previous_ns <= MAX_GAP_NS and self._follow(grey):
            solved = self._solve(self._projector, self._key, attitude)
            if solved is None:
                self.refused += 1
            elif self._due(solved, self._key, stamp_ns):
                motion = self._answer(self._projector, self._key, grey, stamp_ns, attitude, solved)
            else:
                restart = False
        elif self._key is not None:
            self.refused += 1
        if restart:
            self._set_keyframe(self._projector, grey, stamp_ns, attitude)
        self._previous, self._previous_ns = grey, stamp_ns
        return motion

    def _due(self, solved: Solution, key: _Keyframe, stamp_ns: int) -> bool:
        return (
            math.hypot(solved.unknowns[0], solved.unknowns[1]) >= KEYFRAME_DISTANCE_M
            or abs(solved.unknowns[2]) >= KEYFRAME_TURN_RAD
            or stamp_ns - key.stamp_ns >= KEYFRAME_AGE_NS
            or solved.inliers < RENEW_CORNERS
        )

    def _answer(
        self, projector: FloorProjector, key: _Keyframe, grey: Grey, stamp_ns: int, attitude: Attitude, solved: Solution
    ) -> VisualMotion:
        """Estimate the motion by the whole picture; by its corners where that fit does not converge near them."""
        aligned = align_pictures(
            projector, key.picture, key.attitude, smooth(grey), attitude, solved.unknowns, key.floor
        )
        if aligned is not None and aligned.share >= MIN_SHARE:
            apart = np.abs(aligned.unknowns[:3] - solved.unknowns[:3])
            if apart[:2].max() < SETTLE_M and apart[2] < SETTLE_RAD:
                solved = aligned
                self._learn_tilt(aligned)
        x, y, theta = (float(v) for v in solved.unknowns[:3])
        c = [float(v) for v in solved.covariance.ravel()]
        covariance: Covariance = (c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8])
        return VisualMotion(key.stamp_ns, stamp_ns, SE2(x, y, theta), covariance, solved.inliers)

    def _learn_tilt(self, aligned: Solution) -> None:
        """Learn the camera's pitch from the best agreement of near and far floor: mounting, attitude and lens."""
        gain = self._tilt_variance / (self._tilt_variance + (TILT_CAUTION * aligned.tilt_sigma_rad) ** 2)
        learned = self.tilt_rad + gain * aligned.tilt_rad
        self.tilt_rad = min(max(learned, -MAX_TILT_RAD), MAX_TILT_RAD)
        self._tilt_variance = max((1.0 - gain) * self._tilt_variance, TILT_FLOOR_RAD**2)

    def _set_keyframe(self, projector: FloorProjector, grey: Grey, stamp_ns: int, attitude: Attitude) -> None:
        self._key, self._tracked = None, np.zeros((0, 2))
        if grey[::4, ::4].mean() < MIN_BRIGHTNESS:
            return
        floor = self._floor_mask(projector, attitude)
        found = cv2.goodFeaturesToTrack(grey, MAX_CORNERS, 0.005, 5, mask=floor, blockSize=5)
        if found is None or len(found) < MIN_CORNERS:
            return
        corners = found.reshape(-1, 2).astype(np.float64)
        self._key, self._tracked = (
            _Keyframe(stamp_ns, attitude, corners, smooth(grey), floor),
            corners,
        )

    def _floor_mask(self, projector: FloorProjector, attitude: Attitude) -> Grey:
        """Return a mask, 255 where a pixel would show near floor; sampled columns, straight edge between them."""
        height, width = self._shape
        mask = np.zeros((height, width), np.uint8)
        columns = np.linspace(0, width - 1, 9)
        rows = np.arange(height, dtype=np.float64)
        first = np.empty(9)
        for index, column in enumerate(columns):
            pixels = np.stack((np.full(height, column), rows), axis=1)
            _, depression = projector.floor_points(pixels, attitude)
            below = np.flatnonzero(depression >= MIN_DEPRESSION_RAD)
            first[index] = below[0] if len(below) else height
        edge = np.interp(np.arange(width), columns, first)
        mask[rows[:, None] >= edge[None, :]] = 255
        # A corner at the border is about to leave the picture, and its neighbourhood is incomplete.
        mask[:, :4] = mask[:, -4:] = 0
        mask[-4:, :] = 0
        return mask

    def _follow(self, grey: Grey) -> bool:
        """Track the corners from the previous frame into this one and back; return False when too few agree."""
        assert self._previous is not None and self._key is not None
        before = self._tracked.astype(np.float32)[:, None, :]
        after, ok = _track(self._previous, grey, before)
        back, ok_back = _track(grey, self._previous, after)
        apart = np.abs(back - before).reshape(-1, 2).max(axis=1)
        height, width = self._shape
        at = after.reshape(-1, 2)
        inside = (at[:, 0] > 3) & (at[:, 0] < width - 4) & (at[:, 1] > 3) & (at[:, 1] < height - 4)
        good = (ok.ravel() == 1) & (ok_back.ravel() == 1) & (apart < 0.7) & inside
        if np.count_nonzero(good) < MIN_CORNERS:
            return False
        self._tracked = at[good].astype(np.float64)
        self._key = replace(self._key, corners=self._key.corners[good])
        return True

    def _solve(self, projector: FloorProjector, key: _Keyframe, attitude: Attitude) -> Solution | None:
        """Estimate the motion since the key frame by its corners."""
        before, _ = projector.floor_points(key.corners, key.attitude)
        after, depression = projector.floor_points(self._tracked, attitude)
        usable = depression > MIN_DEPRESSION_RAD / 2
        if np.count_nonzero(usable) < MIN_CORNERS:
            return None
        start = self._vote(projector, before, after, usable, attitude)
        if start is None:
            return None
        solved = fit_corners(projector, before, self._tracked, attitude, start)
        if solved is None or solved.inliers < MIN_CORNERS or solved.share < MIN_INLIER_SHARE:
            return None
        return solved

    def _vote(
        self, projector: FloorProjector, before: Array, after: Array, usable: npt.NDArray[np.bool_], attitude: Attitude
    ) -> Array | None:
        """Return the planar motion (x, y, θ) of most agreeing corners, among those that pairs of corners define."""
        indices = np.flatnonzero(usable)
        pairs = self._rng.choice(indices, (HYPOTHESES, 2))
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
        moved = seen_from(before[None], motions[:, None, :])
        errors = np.abs(projector.pixels(moved, attitude) - self._tracked[None]).max(axis=2)
        votes = np.count_nonzero(errors < 2 * INLIER_PX, axis=1)
        best = int(votes.argmax())
        if votes[best] < max(MIN_CORNERS, MIN_INLIER_SHARE * len(before)):
            return None
        return np.asarray(motions[best], dtype=np.float64)


def _track(
    before: Grey, after: Grey, corners: npt.NDArray[np.float32]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint8]]:
    """Track corners [n, 1, 2] of one picture into the next; also return which were found."""
    at, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, corners.copy(), winSize=(13, 13), maxLevel=3)
    return np.asarray(at, np.float32), np.asarray(found, np.uint8)
