"""The worker process that renders one shard of the encoder's training images with labels.

The result depends on the shard's configuration alone.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save_file

from sim_hil.benchmark.language.visibility import ASPECT
from sim_hil.benchmark.workers.worker_process import worker_main
from sim_hil.crowd.people import UPDATE_HZ, People, appearances
from sim_hil.layouts import LayoutError
from sim_hil.processes.child_process import Message
from sim_hil.scene.scene import Scene
from sim_hil.simulation.camera import CameraWorld
from tools.train.config.encoder import MOST_SCENES
from tools.train.drives.drive import PICTURE_PX
from tools.train.encoder.data import WORKER, Shard, finish, path_of
from tools.train.encoder.ids import IdWorld, view_of
from tools.train.encoder.labels import PIXELS, SceneLabels, label_shapes
from tools.train.encoder.poses import Poses, body_state
from tools.train.samples.augment import encoded
from tools.train.scenes.sites import Site

Array = NDArray[np.float64]

_TAG: Final = 0xE0C1
_LAYOUT_TRIES: Final = 8
_SAY_EVERY: Final = 50  # images between two progress messages
_THINNED_SHARE: Final = 0.5  # share of moments in which some people are removed
_AWAY_M: Final = -1e5


def messages(job: Message) -> Iterator[Mapping[str, Any]]:
    """Render the job `{"folder": path, "shard": Shard}`; yield `{"frames": n}` as progress and at the end."""
    for done in render(Path(job["folder"]), Shard.of_json(job["shard"])):
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
            sharp, quality = rng.uniform() < shard.sharp_share, rng.integers(*_span(shard))
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
    path = path_of(folder, shard.name)
    partial = path.with_name(f"{path.name}.partial")
    save_file({"jpeg": np.concatenate(pictures), "jpeg_end": ends.astype(np.int64), **columns}, partial)
    partial.replace(path)
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


def _span(shard: Shard) -> tuple[int, int]:
    return (shard.jpeg_quality_min, shard.jpeg_quality_max + 1)


if __name__ == "__main__":
    sys.exit(worker_main(f"python -m {WORKER}", messages))
