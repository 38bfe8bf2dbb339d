"""The worker process that renders one shard of the encoder's training images with labels, and their camera poses.

The result depends on the shard's configuration alone. Poses are drawn without physics: in passages, in front of
objects, near people, at walls, anywhere on free floor; the body sways about them as a walking robot's does.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import closing
from math import atan2, cos, pi, sin
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save_file

from export.core.tensor_file import replacing
from export.core.typed import build
from sim_hil.benchmark.language.openings import LINEAR, bounds_of
from sim_hil.benchmark.language.visibility import ASPECT
from sim_hil.benchmark.workers.worker_process import worker_main
from sim_hil.crowd.people import UPDATE_HZ, People, appearances
from sim_hil.layouts import LayoutError
from sim_hil.processes.child_process import Message
from sim_hil.scene.nav_grid import NavGrid
from sim_hil.scene.scene import Scene, SceneObject
from sim_hil.simulation.camera import CameraWorld
from tools.train.config.encoder import MOST_SCENES
from tools.train.drives.drive import PICTURE_PX
from tools.train.drives.scenarios import Site
from tools.train.encoder.data import WORKER, Shard, finish, path_of
from tools.train.encoder.ids import IdWorld, view_of
from tools.train.encoder.labels import PIXELS, SceneLabels, label_shapes
from tools.train.samples.augment import encoded

Pose = tuple[float, float, float]  # x m, y m, heading rad

SHARES: Final = (("way", 0.50), ("anywhere", 0.14), ("thing", 0.20), ("person", 0.12), ("wall", 0.04))
"""Share of each kind of pose."""
_TRIES: Final = 24  # attempts with one kind before `anywhere` is used
_MORE_TRIES: Final = 200  # attempts in total
_ROOM_M: Final = 0.6  # least distance between the centres of robot and person
_OFF_WAY_RAD: Final = 0.3  # standard deviation of the heading in a passage
_AIM_RAD: Final = 0.75  # largest bearing of the target; the camera's half field of view is 0.87
_FRONT_RAD: Final = 0.8  # standard deviation of the direction from which an object is seen
_THING_M: Final = (0.8, 12.0)  # range of the distance to an object
_PERSON_M: Final = (0.7, 5.0)  # range of the distance to a person
_WALL_M: Final = 0.25  # clearance at walls beyond what the robot needs
# A driving robot rarely faces a wall: most poses without free floor ahead are drawn again.
_AHEAD_RAD: Final = (-0.6, -0.3, 0.0, 0.3, 0.6)
_AHEAD_M: Final = 2.0
_AHEAD_CLEAR_M: Final = 0.2
_BLIND_SHARE: Final = 0.2
_STEP_M: Final = 0.1
# Height of the base above the ground, m, how it bobs, and how far roll and pitch sway, rad (one standard deviation).
_BODIES: Final = {"go2": (0.31, 0.012, 0.020, 0.025), "carter": (0.0, 0.0, 0.006, 0.008)}
_ROUGH_SHARE, _ROUGH = 0.1, 3.0  # share of poses with stronger sway (steps, ramps, pushes), and its factor


class Poses:
    """Draws poses in one scene for one robot; `grid`: floor that is free for it."""

    def __init__(self, scene: Scene, grid: NavGrid, rng: np.random.Generator) -> None:
        self._scene, self._grid, self._rng = scene, grid, rng
        self._cells = np.argwhere(grid.free)
        tight = grid.clearances[grid.free] < grid.required_m + _WALL_M
        self._at_walls = self._cells[tight] if tight.any() else self._cells
        self._ways = [bounds_of(area) for area in scene.areas if area.kind in LINEAR]
        lengths = np.array([max(way.x1 - way.x0, way.y1 - way.y0) for way in self._ways])
        self._lengths = lengths / lengths.sum() if len(lengths) else lengths
        self._landmarks = scene.landmarks()
        self._things = [thing for thing in scene.objects if thing.kind != "light"]

    def draw(self, people: Array) -> Pose:
        """Draw a pose with room to all people; `people` [n, 2 or more]: x m, y m."""
        shares = dict(SHARES)
        sort = str(self._rng.choice(list(shares), p=list(shares.values())))
        for attempt in range(_MORE_TRIES):
            pose = self._drawn(sort if attempt < _TRIES else "anywhere", people)
            if self._grid.is_free(pose[0], pose[1]) and _roomy(pose, people) and self._worth_seeing(pose):
                return pose
        return self._cell(self._cells)  # the scene is so crowded that no pose has room

    def _drawn(self, sort: str, people: Array) -> Pose:
        rng = self._rng
        if sort == "way" and self._ways:
            way = self._ways[int(rng.choice(len(self._ways), p=self._lengths))]
            x, y = rng.uniform((way.x0, way.y0), (way.x1, way.y1))
            along = (0.0 if way.along_x else pi / 2) + pi * float(rng.integers(2))
            return (float(x), float(y), along + float(rng.normal(0.0, _OFF_WAY_RAD)))
        if sort == "thing" and self._things:
            return self._before(self._thing())
        if sort == "person" and len(people):
            x, y = people[int(rng.integers(len(people))), :2]
            return self._towards(float(x), float(y), float(rng.uniform(-pi, pi)), float(rng.uniform(*_PERSON_M)))
        return self._cell(self._at_walls if sort == "wall" else self._cells)

    def _worth_seeing(self, pose: Pose) -> bool:
        chance = float(self._rng.uniform())
        x, y, heading = pose
        bearings = heading + np.array(_AHEAD_RAD)
        gone = np.arange(1, round(_AHEAD_M / _STEP_M) + 1) * _STEP_M
        ways = np.stack((np.cos(bearings), np.sin(bearings)), -1)
        points = np.array((x, y)) + ways[:, None, :] * gone[None, :, None]
        clear = self._grid.clearances_at(points) >= _AHEAD_CLEAR_M
        return bool(clear.all(axis=1).any()) or chance < _BLIND_SHARE

    def _thing(self) -> SceneObject:
        pool = self._landmarks if self._landmarks and self._rng.uniform() < 0.75 else self._things
        return pool[int(self._rng.integers(len(pool)))]

    def _before(self, thing: SceneObject) -> Pose:
        x, y, _ = thing.position_m
        gap = max(thing.size_m[:2]) / 2 + float(self._rng.uniform(*_THING_M))
        return self._towards(x, y, thing.heading_rad + float(self._rng.normal(0.0, _FRONT_RAD)), gap)

    def _towards(self, x: float, y: float, side_rad: float, gap_m: float) -> Pose:
        """Return a pose at distance `gap_m` on one side of a point that faces it roughly."""
        px, py = x + gap_m * cos(side_rad), y + gap_m * sin(side_rad)
        return (px, py, atan2(y - py, x - px) + float(self._rng.uniform(-_AIM_RAD, _AIM_RAD)))

    def _cell(self, cells: NDArray[np.int64]) -> Pose:
        row, column = cells[int(self._rng.integers(len(cells)))]
        x, y = self._grid.centre(int(row), int(column))
        half = self._grid.resolution_m / 2
        dx, dy, heading = self._rng.uniform((-half, -half, -pi), (half, half, pi))
        if not self._grid.is_free(x + dx, y + dy):
            dx = dy = 0.0
        return (x + float(dx), y + float(dy), float(heading))


def body_state(scene: Scene, robot: str, pose: Pose, rng: np.random.Generator) -> Array:
    """Draw position m and quaternion xyzw [7] of a swaying body: the first entries of a render state."""
    x, y, heading = pose
    height, bob, roll, pitch = _BODIES[robot]
    sway = _ROUGH if rng.uniform() < _ROUGH_SHARE else 1.0
    up, tilt, nod = rng.standard_normal(3) * (bob, roll * sway, pitch * sway)
    return np.array((x, y, scene.ground_height_m(x, y) + height + up, *quaternion_xyzw(tilt, nod, heading)))


def quaternion_xyzw(roll_rad: float, pitch_rad: float, yaw_rad: float) -> tuple[float, float, float, float]:
    """Return the rotation about x, then y, then z of the world (positive pitch points down)."""
    (cr, sr), (cp, sp), (cy, sy) = ((cos(a / 2), sin(a / 2)) for a in (roll_rad, pitch_rad, yaw_rad))
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def _roomy(pose: Pose, people: Array) -> bool:
    return not len(people) or bool(np.hypot(people[:, 0] - pose[0], people[:, 1] - pose[1]).min() >= _ROOM_M)


Array = NDArray[np.float64]

_TAG: Final = 0xE0C1
_LAYOUT_TRIES: Final = 8
_SAY_EVERY: Final = 50  # images between two progress messages
_THINNED_SHARE: Final = 0.5  # share of moments in which some people are removed
_AWAY_M: Final = -1e5


def messages(job: Message) -> Iterator[Mapping[str, Any]]:
    """Render the job `{"folder": path, "shard": Shard}`; yield `{"frames": n}` as progress and at the end."""
    for done in render(Path(job["folder"]), build(Shard, job["shard"], "shard")):
        yield {"frames": done}


def render(folder: Path, shard: Shard) -> Iterator[int]:
    """Render and write a shard; yield the number of images so far. Raises LayoutError, OSError."""
    site = _site(shard)
    scene, grid = site.scene, site.robot_grid(shard.robot)
    rng = np.random.default_rng((shard.seed, _TAG))
    crowd = _Crowd(scene, shard, rng)
    looks = appearances(crowd.count, shard.seed, scene.name)
    poses, labels = Poses(scene, grid, rng), SceneLabels(scene, grid, shard.side)
    shapes = label_shapes(shard.side)
    columns: dict[str, NDArray[Any]] = {
        name: np.empty((shard.frames, *shape), kind) for name, (kind, shape) in shapes.items()
    }
    pictures: list[NDArray[np.uint8]] = []
    camera = CameraWorld(scene, people=crowd.count, seed=shard.seed, robot=shard.robot, looks=looks)
    with closing(camera), closing(IdWorld(scene, looks, shard.robot)) as twin:
        state = np.zeros(camera.state_size)
        for k in range(shard.frames):
            if k % shard.moment == 0:
                crowd.move_on()
                state[twin.mount.fields :] = crowd.rows.ravel()
            pose = poses.draw(crowd.present)
            crowd.robot = pose
            state[:7] = body_state(scene, shard.robot, pose, rng)
            sharp, quality = (
                rng.uniform() < shard.sharp_share,
                rng.integers(shard.jpeg_quality_min, shard.jpeg_quality_max + 1),
            )
            px = 2 * PICTURE_PX if sharp else PICTURE_PX
            picture = camera.render(state, px, px, ASPECT)
            if sharp:
                picture = np.asarray(
                    cv2.resize(picture, (PICTURE_PX, PICTURE_PX), interpolation=cv2.INTER_AREA), np.uint8
                )
            pictures.append(encoded(picture, int(quality)))
            found = labels.of(twin.ids(state, PIXELS), view_of(state, twin.mount), crowd.rows, pose[:2])
            for name in shapes:
                columns[name][k] = found[name]
            if (k + 1) % _SAY_EVERY == 0:
                yield k + 1
    ends = np.cumsum([len(each) for each in pictures])
    with replacing(path_of(folder, shard.name)) as partial:
        save_file({"jpeg": np.concatenate(pictures), "jpeg_end": ends.astype(np.int64), **columns}, partial)
    finish(folder, shard)
    yield shard.frames


class _Crowd:
    """The people of a shard; `rows` are those of a render state, `present` those of people who are not removed."""

    def __init__(self, scene: Scene, shard: Shard, rng: np.random.Generator) -> None:
        self.count = shard.people
        while True:
            try:
                self._people = People(scene, self.count, shard.seed)
                break
            except ValueError:
                # A small layout has no room for that many people; try half of them.
                if self.count == 0:
                    raise
                self.count //= 2
        self._rng = rng
        self._steps = max(1, round(shard.moment_s * UPDATE_HZ))
        self.robot = scene.start
        self.rows = self._people.render_rows()
        self.present = self.rows

    def move_on(self) -> None:
        """Let the people walk for one moment with the robot at its last position."""
        for _ in range(self._steps if self.count else 0):
            self._people.step(*self.robot)
        rows = self._people.render_rows().copy()
        there = np.ones(self.count, bool)
        if self._rng.uniform() < _THINNED_SHARE:
            there = self._rng.uniform(size=self.count) < self._rng.uniform()
        rows[~there, :2] = _AWAY_M
        self.rows, self.present = rows, rows[there]


def _site(shard: Shard) -> Site:
    why = ""
    for attempt in range(_LAYOUT_TRIES):
        try:
            return Site(shard.kind, shard.layout_seed + attempt * MOST_SCENES)
        except LayoutError as error:
            why = str(error)
    raise LayoutError(f"{shard.name}: no sound layout in {_LAYOUT_TRIES}; the last: {why}")


if __name__ == "__main__":
    sys.exit(worker_main(f"python -m {WORKER}", messages))
