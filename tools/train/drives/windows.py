"""The paper's view of recorded data (appendix B): an episode of 20 s, cut out of a drive every 3 s.

Each has a current frame, past frames with where they were taken, and the future as motion relative to the current pose;
all in the robot's frame at the current frame. The past is what odometry knew, the future is the truth that is learned.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from tools.train.drives.drive import Drive

Array = NDArray[np.float64]

EPISODE_S: Final = 20.0
HISTORY_S: Final = 9.0  # what a reasoning model looks back (section 3.2)
HISTORY_STEP_S: Final = 1.0  # "summarized at 1 s intervals" (appendix B)
_HZ: Final = 10


@dataclass(frozen=True)
class Window:
    """One sample: frame `k` of a drive.

    `past_k` [h] frames before k, oldest first, 1 s apart, and `past` [h, 3] their poses by odometry; `future_k` [f]
    frames k + 1 .. k + f and `future` [f, 3] their true poses; x m, y m, theta rad in the robot's frame at k. f is 200
    (20 s) or less where the drive ends before. `state` (3,): vx m/s, vy m/s, wz rad/s at k.
    """

    drive_id: str
    k: int
    past_k: NDArray[np.int64]
    past: Array
    future_k: NDArray[np.int64]
    future: Array
    state: NDArray[np.float32]


def windows(drive: Drive, stride_s: float = 3.0) -> Iterator[Window]:
    """Samples of one drive, from its first frame on while there is a future. Raises ValueError for no stride."""
    stride = round(stride_s * _HZ)
    if stride < 1:
        raise ValueError(f"windows: expected a stride of 0.1 s or more, found {stride_s}")
    for k in range(0, len(drive) - 1, stride):
        back, step = round(HISTORY_S * _HZ), round(HISTORY_STEP_S * _HZ)
        past_k = np.array([j for j in range(k - back, k, step) if j >= 0], np.int64)
        future_k = np.arange(k + 1, min(k + round(EPISODE_S * _HZ), len(drive) - 1) + 1)
        yield Window(
            drive_id=drive.id,
            k=k,
            past_k=past_k,
            past=relative(drive.pose_odom[k], drive.pose_odom[past_k]),
            future_k=future_k,
            future=relative(drive.pose[k], drive.pose[future_k]),
            state=drive.state[k].copy(),
        )


def relative(origin: Array, poses: Array) -> Array:
    """[n, 3] poses of a frame (x m, y m, theta rad) as seen from `origin` [3], a pose of the same frame."""
    poses = np.asarray(poses, np.float64).reshape(-1, 3)
    c, s = np.cos(origin[2]), np.sin(origin[2])
    dx, dy = poses[:, 0] - origin[0], poses[:, 1] - origin[1]
    turned = (poses[:, 2] - origin[2] + np.pi) % (2 * np.pi) - np.pi
    return np.stack((c * dx + s * dy, c * dy - s * dx, turned), axis=1)
