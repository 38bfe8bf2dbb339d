"""Walls around a robot, for plans that are to keep off them: known where drives were recorded, seen by no policy.

Imitation alone weighs half a metre through the free floor as it weighs half a metre through a doorpost; where a turn's
place is uncertain, the plan in the middle of all is one that cuts the corner. What is imitated stays the measure: a
plan may come as near to things as the expert's own does anywhere. Plans that graze are drawn off; of one that goes
through a wall the steps up to there are, back from it: which way round is for imitation to say.
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
from tools.train.scenes.sites import Site, SiteError

CELL_M: Final = 0.1
X_M: Final = (-0.6, 5.4)
"""Of the floor that a sample carries, in the robot's frame; no plan of 5 s at 1 m/s comes further."""
Y_M: Final = (-3.0, 3.0)
SHAPE: Final = (round((Y_M[1] - Y_M[0]) / CELL_M) + 1, round((X_M[1] - X_M[0]) / CELL_M) + 1)
OPEN_M: Final = 2.0
"""Clearance where nothing is near, or nothing is known."""
_MIRRORED: Final = np.array((1.0, -1.0, -1.0))
_EVERY_M, _MIDDLE_M, _FREE = 0.3, 0.15, 0.9


@dataclass(frozen=True)
class Body:
    """What a robot's plan is measured by: two circles, one before and one behind its middle; m."""

    reach_m: float
    radius_m: float


@dataclass(frozen=True)
class Floor:
    """A scene's clearances, m, at the middles of cells [rows (y), columns (x)]; all that is kept of its grid."""

    scene: str
    clearances: NDArray[np.float32]
    origin_m: tuple[float, float]
    cell_m: float

    def at(self, points: NDArray[np.float64]) -> NDArray[np.float32]:
        """[..., 2] x m, y m -> [...]: blended from the cells around; beyond the floor as at its edge."""
        cells = (points[..., ::-1] - self.origin_m[::-1]) / self.cell_m - 0.5
        where = np.moveaxis(cells, -1, 0)
        found: NDArray[np.float32] = map_coordinates(self.clearances, where, order=1, mode="nearest")
        return found

    def saw(self, walls: Walls, scene: str) -> bool:
        """Whether a drive is of this scene as it is built now: of its name, and its way hardly ever through things."""
        xy = walls.where()[:, :2]
        gone = np.cumsum(np.hypot(*np.diff(xy, axis=0, prepend=xy[:1]).T)) // _EVERY_M
        way = xy[np.unique(gone, return_index=True)[1]]  # where it stands long counts once
        return scene == self.scene and float(np.mean(self.at(way) >= _MIDDLE_M)) >= _FREE


@dataclass(frozen=True)
class Walls:
    """The walls along one drive."""

    floor: Floor
    pose: NDArray[np.float64]
    """[N, 3] true poses: x m, y m, theta rad; in the mirror's scene if the drive is."""
    body: Body
    in_mirror: bool = False

    def where(self) -> NDArray[np.float64]:
        """[N, 3]: poses in the scene itself, also of a mirrored drive."""
        return self.pose * _MIRRORED if self.in_mirror else self.pose

    def patches(self, ks: list[int]) -> NDArray[np.float16]:
        """Clearances [g, rows (y), columns (x)], m, around the robot in its frame at some frames."""
        x, y = np.meshgrid(np.linspace(*X_M, SHAPE[1]), np.linspace(*Y_M, SHAPE[0]))
        if self.in_mirror:
            y = -y
        where = self.where()[ks]
        c, s = np.cos(where[:, 2, None, None]), np.sin(where[:, 2, None, None])
        points = np.stack([where[:, 0, None, None] + c * x - s * y, where[:, 1, None, None] + s * x + c * y], axis=-1)
        return self.floor.at(points).astype(np.float16)


class Scenes:
    """The walls of drives' scenes, each worked out once."""

    def __init__(self) -> None:
        self._floors: dict[tuple[str, int, str], Floor] = {}

    def along(self, drive: Drive, *, in_mirror: bool = False) -> Walls | None:
        """Those along a drive (its poses in the mirror, if it is a mirror's); None where its scene is not ours."""
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
    """Patches of frames about which nothing is known."""
    return np.full((count, *SHAPE), OPEN_M, np.float16)


def room(plan: Tensor, patches: Tensor, body: Tensor) -> Tensor:
    """Room [B, steps], m, between the robot and what is nearest to it along trajectories; below 0 inside a wall.

    `plan` [B, steps, 3] x m, y m, theta rad in the robot's frame, `patches` [B, rows, columns], `body` [B, 2] reach and
    radius, m. It has a gradient towards the plan, but for places beyond the patch, which count as its edge.
    """
    xy, heading = plan[..., :2], plan[..., 2]
    reach = body[:, :1, None] * torch.stack([torch.cos(heading), torch.sin(heading)], dim=-1)
    nose, tail = _gaps(torch.cat([xy + reach, xy - reach], dim=1), patches).chunk(2, dim=1)
    return torch.minimum(nose, tail) - body[:, 1:]


def _gaps(points: Tensor, patches: Tensor) -> Tensor:
    """Clearances [B, n] at points [B, n, 2] in the robot's frame."""
    low, high = points.new_tensor([X_M[0], Y_M[0]]), points.new_tensor([X_M[1], Y_M[1]])
    where = (points - low) / (high - low) * 2 - 1
    return F.grid_sample(
        patches[:, None].float(), where[:, None].float(), mode="bilinear", padding_mode="border", align_corners=True
    )[:, 0, 0]


def too_near(plan: Tensor, target: Tensor, known: Tensor, patches: Tensor, body: Tensor, room_m: float) -> Tensor:
    """How far [B], m, plans come nearer to things than both `room_m` and the label's nearest; mean over steps.

    Steps beyond the first one whose middle is inside something do not count: a wall is thin, and its far side would
    draw them on.
    """
    with torch.no_grad():
        least = room(target, patches, body).masked_fill(~known, OPEN_M).amin(dim=1, keepdim=True)
        inside = _gaps(plan[..., :2], patches) < 0
        counts = known & (inside.long().cumsum(dim=1) - inside.long() == 0)
    lack = torch.clamp(least, max=room_m) - room(plan, patches, body)
    return (torch.relu(lack) * counts).mean(dim=1)
