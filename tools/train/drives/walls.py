"""Walls around the robot, for a loss on plans too close to them; ground truth that no policy receives.

The imitation loss weighs an error of half a metre on free floor like one through a doorpost; if the position of a turn
is uncertain, the mean of the possible plans cuts the corner. The expert remains the measure: a plan may come as close
to walls as the expert's plan does anywhere. Plans that touch a wall are pushed away. Of a plan through a wall, only the
steps up to the wall count and are pushed back; the side of the obstacle is left to imitation.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 - torch's own idiom

from sim_hil.benchmark.policies.expert import driving_of
from sim_hil.layouts import LayoutError
from tools.train.drives.drive import Drive
from tools.train.drives.scenarios import Site, SiteError

CELL_M: Final = 0.1
X_M: Final = (-0.6, 5.4)
"""Extent of a sample's patch of floor in the robot frame, m; no plan of 5 s at 1 m/s leaves it."""
Y_M: Final = (-3.0, 3.0)
SHAPE: Final = (round((Y_M[1] - Y_M[0]) / CELL_M) + 1, round((X_M[1] - X_M[0]) / CELL_M) + 1)
OPEN_M: Final = 2.0
"""Clearance without walls nearby, or without known walls, m."""
_MIRRORED: Final = np.array((1.0, -1.0, -1.0))
_EVERY_M, _MIDDLE_M, _FREE = 0.3, 0.15, 0.9


@dataclass(frozen=True)
class Body:
    """A robot's footprint as two circles of `radius_m`, `reach_m` before and behind its centre; m."""

    reach_m: float
    radius_m: float


@dataclass(frozen=True)
class Floor:
    """A scene's clearances, m, at the centres of cells [rows (y), columns (x)]."""

    scene: str
    clearances: NDArray[np.float32]
    origin_m: tuple[float, float]
    cell_m: float

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float32]:
        """Interpolate clearances [...] at points [..., 2] x m, y m; outside the floor the edge's values apply."""
        cells = (points[..., ::-1] - self.origin_m[::-1]) / self.cell_m - 0.5
        where = np.moveaxis(cells, -1, 0)
        found: NDArray[np.float32] = map_coordinates(self.clearances, where, order=1, mode="nearest")
        return found

    def saw(self, walls: Walls, scene: str) -> bool:
        """Return whether a drive was recorded in this scene: same name, and almost no path through walls."""
        xy = walls.where()[:, :2]
        gone = np.cumsum(np.hypot(*np.diff(xy, axis=0, prepend=xy[:1]).T)) // _EVERY_M
        way = xy[np.unique(gone, return_index=True)[1]]  # a long stop counts once
        return scene == self.scene and float(np.mean(self.at(way) >= _MIDDLE_M)) >= _FREE


@dataclass(frozen=True)
class Walls:
    """Walls along one drive."""

    floor: Floor
    pose: NDArray[np.float64]
    """[N, 3] true poses: x m, y m, theta rad; mirrored if the drive is."""
    body: Body
    in_mirror: bool = False

    def where(self) -> NDArray[np.float64]:
        """Return the poses [N, 3] in the original scene, also for a mirrored drive."""
        return self.pose * _MIRRORED if self.in_mirror else self.pose

    def patches(self, ks: list[int]) -> NDArray[np.float16]:
        """Return clearances [g, rows (y), columns (x)], m, around the robot at frames `ks`, in the robot frame."""
        x, y = np.meshgrid(np.linspace(*X_M, SHAPE[1]), np.linspace(*Y_M, SHAPE[0]))
        if self.in_mirror:
            y = -y
        where = self.where()[ks]
        c, s = np.cos(where[:, 2, None, None]), np.sin(where[:, 2, None, None])
        points = np.stack([where[:, 0, None, None] + c * x - s * y, where[:, 1, None, None] + s * x + c * y], axis=-1)
        return self.floor.at(points).astype(np.float16)


class Scenes:
    """Walls of scenes, each computed once."""

    def __init__(self) -> None:
        self._floors: dict[tuple[str, int, str], Floor] = {}

    def along(self, drive: Drive, *, in_mirror: bool = False) -> Walls | None:
        """Return the walls along a drive (mirrored poses with `in_mirror`); None if its scene is unknown or changed."""
        about = drive.about
        key = (about.kind, about.layout_seed, about.robot)
        if key not in self._floors:
            try:
                site = Site(about.kind, about.layout_seed)
            except (SiteError, LayoutError):
                return None
            grid = site.robot_grid(about.robot)
            floor = Floor(site.scene.name, grid.clearances.astype(np.float32), grid.origin_m, grid.resolution_m)
            self._floors[key] = floor
        driving, floor = driving_of(about.robot), self._floors[key]
        walls = Walls(floor, drive.pose, Body(driving.body_reach_m, driving.body_radius_m), in_mirror)
        return walls if floor.saw(walls, about.scene) else None


def nothing_near(count: int) -> NDArray[np.float16]:
    """Return patches without walls for `count` frames."""
    return np.full((count, *SHAPE), OPEN_M, np.float16)


def room(plan: Tensor, patches: Tensor, body: Tensor) -> Tensor:
    """Compute the distance [B, steps], m, between the robot and the nearest wall along plans; negative inside a wall.

    `plan` [B, steps, 3] x m, y m, theta rad in the robot frame; `patches` [B, rows, columns]; `body` [B, 2] reach and
    radius, m. Differentiable in the plan, except outside the patch, where the edge's values apply.
    """
    xy, heading = plan[..., :2], plan[..., 2]
    reach = body[:, :1, None] * torch.stack([torch.cos(heading), torch.sin(heading)], dim=-1)
    nose, tail = _gaps(torch.cat([xy + reach, xy - reach], dim=1), patches).chunk(2, dim=1)
    return torch.minimum(nose, tail) - body[:, 1:]


def _gaps(points: Tensor, patches: Tensor) -> Tensor:
    """Interpolate clearances [B, n] at points [B, n, 2] in the robot frame."""
    low, high = points.new_tensor([X_M[0], Y_M[0]]), points.new_tensor([X_M[1], Y_M[1]])
    where = (points - low) / (high - low) * 2 - 1
    return F.grid_sample(
        patches[:, None].float(), where[:, None].float(), mode="bilinear", padding_mode="border", align_corners=True
    )[:, 0, 0]


def too_near(plan: Tensor, target: Tensor, known: Tensor, patches: Tensor, body: Tensor, room_m: float) -> Tensor:
    """Compute by how much plans are closer to walls than both `room_m` and the label's smallest distance: [B], m.

    It is the mean over steps. Steps after the first one inside a wall do not count: a wall is thin, and its far side
    would attract them.
    """
    with torch.no_grad():
        least = room(target, patches, body).masked_fill(~known, OPEN_M).amin(dim=1, keepdim=True)
        inside = _gaps(plan[..., :2], patches) < 0
        counts = known & (inside.long().cumsum(dim=1) - inside.long() == 0)
    lack = torch.clamp(least, max=room_m) - room(plan, patches, body)
    return (torch.relu(lack) * counts).mean(dim=1)
