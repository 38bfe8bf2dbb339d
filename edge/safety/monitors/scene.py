"""Checks that the scene changes as odometry predicts. Finds frozen pictures that are not equal byte for byte.

The monitor keeps a small grey copy of the picture every few centimetres or degrees of travel. It compares the newest
picture with the copies from which odometry has moved far enough. A live camera changes wherever the picture has
texture across the direction of image motion. A frozen picture changes nowhere, or only under an overlay such as a
clock. Copies are kept by distance, not by time: a slow robot is judged after the same distance as a fast one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from edge.core.geometry import SE2

GRID: Final = 32
"""Blocks along each side of the grey copy."""
LINES_PER_BLOCK: Final = 7
"""Number of picture lines in a block mean; more cost time and hardly lower its noise."""
CELL: Final = 4
"""Blocks along each side of a cell. Counting cells gives a small, busy overlay little weight."""
CELLS: Final = GRID // CELL
FOCAL_BLOCKS: Final = 13.0
"""Focal length of a 100° camera, blocks; a narrower camera sees more motion than expected, a wider one less."""
DEPTH_M: Final = 5.0
"""Assumed distance of the scene, m: the floor ahead and most indoor walls are nearer."""

_Grey = npt.NDArray[np.int16]
_Floats = npt.NDArray[np.float64]
_AXIS: Final = np.arange(GRID, dtype=np.float32) + 0.5 - GRID / 2
_U: Final = _AXIS[None, :]
_V: Final = _AXIS[:, None]


@dataclass(frozen=True)
class SceneConfig:
    """How far the robot must move before the scene must change, and by how much."""

    moved_m: float = 0.2
    moved_rad: float = math.radians(10.0)
    """Smallest odometry motion between two compared pictures: above the effect of a 0.1 s stamp error at 1 rad/s."""
    slowest_mps: float = 0.03
    slowest_radps: float = math.radians(0.5)
    """Speed below which motion may be odometry drift of a standing robot."""
    spacing_m: float = 0.05
    spacing_rad: float = math.radians(2.0)
    copies: int = 24
    compared: int = 4
    """Number of the newest sufficiently distant copies that are compared. Beyond 0.5 m a corridor may repeat itself:
    panels, tiles. Fewer copies would miss rotating stale buffers that differ by noise."""
    changed_levels: int = 2
    """Difference of 255 above which a block mean has changed. Sensor noise and JPEG change block means by less."""
    expected_levels: float = 4.0
    """Predicted change of 255 from which a block is judged."""
    cell_share: float = 0.25
    """Share of its judged blocks that must change for a cell to count as changed."""
    min_cells: int = 20
    """Number of textured cells, of 64, below which a picture proves nothing: a blank wall."""
    frozen_share: float = 0.2
    """Share of textured cells that must change. Simulated drives: 0.48 or more when live; a clock: below 0.1."""
    overlay_share: float = 0.3
    """Share of all blocks above which a change proves a live picture whatever was predicted."""
    release_pictures: int = 10
    """Live pictures in a row that end a frozen verdict: rotating stale buffers appear live for a moment."""
    focal_blocks: float = FOCAL_BLOCKS
    """Focal length by which motion is predicted, blocks."""

    @staticmethod
    def for_hfov(hfov_deg: float) -> SceneConfig:
        """Return the configuration for a camera: a wider one than the usual is expected to show less motion."""
        return SceneConfig(focal_blocks=min(FOCAL_BLOCKS, GRID / 2 / math.tan(math.radians(hfov_deg) / 2)))

    def __post_init__(self) -> None:
        if not all(math.isfinite(value) and value > 0 for value in vars(self).values()):
            raise ValueError(f"scene monitor: expected positive values, found {self}")
        if max(self.cell_share, self.frozen_share, self.overlay_share) >= 1 or self.min_cells > CELLS**2:
            raise ValueError(f"scene monitor: expected shares below 1 and at most {CELLS**2} cells, found {self}")
        if self.spacing_m >= self.moved_m or self.spacing_rad >= self.moved_rad:
            raise ValueError(f"scene monitor: expected a spacing below the motion that is judged, found {self}")


class SceneMonitor:
    """Compares small grey copies of recent pictures with the motion between them."""

    def __init__(self, config: SceneConfig | None = None) -> None:
        self._config = config or SceneConfig()
        copies = self._config.copies
        # One row for each copy, the oldest overwritten first: one comparison serves all of them.
        self._greys: _Grey = np.zeros((copies, GRID, GRID), dtype=np.int16)
        self._poses = np.zeros((copies, 3))
        self._near_ns = np.zeros(copies, dtype=np.int64)
        self._taken = 0
        self._newest = -1
        self._frozen = ""
        self._live_in_a_row = 0

    def step(self, pixels: npt.NDArray[np.uint8], T_odom_base: SE2, stamp_ns: int) -> str:
        """Check a picture [1, h, w, 3] captured at `T_odom_base`; return why it counts as frozen, empty when live.

        A frozen verdict lasts until `release_pictures` in a row do not count as frozen, also while the robot stands.
        """
        grey = _shrink(pixels)
        went_m, turned_rad = self._motion(T_odom_base)
        detail = self._frozen_detail(grey, T_odom_base, self._must_change(went_m, turned_rad, stamp_ns))
        self._live_in_a_row = 0 if detail else self._live_in_a_row + 1
        if detail:
            self._frozen = detail
        elif self._frozen and self._live_in_a_row >= self._config.release_pictures:
            # Copies of frozen pictures have wrong poses.
            self._frozen, self._taken, self._newest = "", 0, -1
            went_m, turned_rad = went_m[:0], turned_rad[:0]
        self._remember(grey, T_odom_base, stamp_ns, went_m, turned_rad)
        return self._frozen

    def _motion(self, T_odom_base: SE2) -> tuple[_Floats, _Floats]:
        """Return the distance, m, and rotation, rad, from every copy to a pose."""
        offset = np.array(T_odom_base.as_tuple()) - self._poses[: self._taken]
        turned_rad = np.abs((offset[:, 2] + math.pi) % (2 * math.pi) - math.pi)
        return np.hypot(offset[:, 0], offset[:, 1]), turned_rad

    def _must_change(self, went_m: _Floats, turned_rad: _Floats, stamp_ns: int) -> npt.NDArray[np.intp]:
        """Rows of the copies from which the robot has moved so far that the scene must differ."""
        config = self._config
        # Once a frozen picture has stopped the robot, its mean speed no longer separates motion from drift.
        elapsed_s = 0.0 if self._frozen else (stamp_ns - self._near_ns[: self._taken]) / 1e9
        went = (went_m >= config.moved_m) & (went_m >= config.slowest_mps * elapsed_s)
        turned = (turned_rad >= config.moved_rad) & (turned_rad >= config.slowest_radps * elapsed_s)
        rows = np.flatnonzero(went | turned)
        if self._frozen:
            return rows
        ages = (self._newest - rows) % config.copies
        return rows[np.argsort(ages)[: config.compared]]

    def _remember(self, grey: _Grey, T_odom_base: SE2, stamp_ns: int, went_m: _Floats, turned_rad: _Floats) -> None:
        config = self._config
        if len(went_m):
            newest = self._newest
            if went_m[newest] < config.spacing_m and turned_rad[newest] < config.spacing_rad:
                self._near_ns[newest] = stamp_ns
                return
        self._newest = (self._newest + 1) % config.copies
        self._greys[self._newest], self._near_ns[self._newest] = grey, stamp_ns
        self._poses[self._newest] = T_odom_base.as_tuple()
        self._taken = min(self._taken + 1, config.copies)

    def _frozen_detail(self, grey: _Grey, T_odom_base: SE2, rows: npt.NDArray[np.intp]) -> str:
        """Compare with the one of these copies that is most like `grey`."""
        config = self._config
        if not len(rows):
            return ""
        changed = np.abs(self._greys[rows] - grey) > config.changed_levels
        counts = changed.reshape(len(rows), -1).sum(axis=1)
        best = int(np.argmin(counts))
        if counts[best] > config.overlay_share * GRID * GRID:
            return ""
        motion = SE2(*self._poses[rows[best]]).inverse() @ T_odom_base
        judged = expected_change(self._greys[rows[best]], motion, config.focal_blocks) >= config.expected_levels
        judged_in_cell, changed_in_cell = _per_cell(judged), _per_cell(judged & changed[best])
        textured = judged_in_cell >= 2
        cells = int(np.count_nonzero(textured))
        if cells < config.min_cells:
            return ""
        live = int(np.count_nonzero(textured & (changed_in_cell >= config.cell_share * judged_in_cell)))
        if live > config.frozen_share * cells:
            return ""
        went_m, turned_deg = math.hypot(motion.x_m, motion.y_m), math.degrees(abs(motion.theta_rad))
        return (
            f"{live} of {cells} textured cells changed over {went_m:.2f} m and {turned_deg:.0f}°, "
            f"expected more than {config.frozen_share:.0%}"
        )


def expected_change(grey: _Grey, motion: SE2, focal_blocks: float = FOCAL_BLOCKS) -> npt.NDArray[np.float32]:
    """Change that `motion` (robot frame, m and rad) makes in each block of a grey copy [32, 32]; levels of 255.

    Gradient times image motion of a forward pinhole camera and a scene `DEPTH_M` away, at most one block. The result is
    zero for edges along the image motion, such as those of a corridor ahead.
    """
    dy, dx = np.gradient(grey.astype(np.float32))
    across = focal_blocks * (motion.theta_rad + motion.y_m / DEPTH_M) + _U * (motion.x_m / DEPTH_M)
    down = _V * (motion.x_m / DEPTH_M)
    change: npt.NDArray[np.float32] = np.abs(dx * np.clip(across, -1, 1) + dy * np.clip(down, -1, 1)).astype(np.float32)
    return change


def _shrink(pixels: npt.NDArray[np.uint8]) -> _Grey:
    """Return the block means of a picture [1, h, w, 3] as grey values [32, 32]."""
    lines = pixels[0, :: max(1, pixels.shape[1] // (GRID * LINES_PER_BLOCK))]
    small = cv2.resize(lines, (GRID, GRID), interpolation=cv2.INTER_AREA)
    grey: _Grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.int16)
    return grey


def _per_cell(blocks: npt.NDArray[np.bool_]) -> npt.NDArray[np.int_]:
    counts: npt.NDArray[np.int_] = blocks.reshape(CELLS, CELL, CELLS, CELL).sum(axis=(1, 3))
    return counts
