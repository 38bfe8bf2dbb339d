"""Robot on a stage for outside views: the visual shapes of its URDF, moved with its joints."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
import pybullet
from numpy.typing import NDArray

from sim_hil.robots.carter.body import load_carter, place_carter
from sim_hil.robots.go2.body import load_go2, place_go2
from sim_hil.world.drawing.mesh import Frame, MeshBuilder
from sim_hil.world.drawing.stage import Quaternion, Stage, Vec3
from sim_hil.world.drawing.textures import rgb

Array = NDArray[np.float64]
Load = Callable[[int, Path, Vec3, float], "tuple[int, list[int]]"]
Place = Callable[[int, int, "list[int]", Array], None]
ROBOTS: Final[dict[str, tuple[Load, Place]]] = {"go2": (load_go2, place_go2), "carter": (load_carter, place_carter)}


@dataclass(frozen=True)
class _Shape:
    link: int
    offset_m: Vec3
    turn: Quaternion
    handle: int


class RobotBody:
    """Visual shapes of the robot as meshes; a separate PyBullet client without a world computes the kinematics."""

    def __init__(self, stage: Stage, robot: str) -> None:
        self._stage = stage
        load, self._place = ROBOTS[robot]
        self._client = pybullet.connect(pybullet.DIRECT)
        try:
            with TemporaryDirectory(prefix="edge-robot-") as folder:
                self._body, self._joints = load(self._client, Path(folder), (0.0, 0.0, 0.3), 0.0)
            self._shapes = [
                self._shape(entry) for entry in pybullet.getVisualShapeData(self._body, physicsClientId=self._client)
            ]
        except BaseException:
            pybullet.disconnect(self._client)
            raise

    def _shape(self, entry: tuple[Any, ...]) -> _Shape:
        _, link, kind, size, _, offset, turn, colour = entry[:8]
        mesh, paint = MeshBuilder(), rgb(colour[:3])
        a, b, c = size
        if kind == pybullet.GEOM_BOX:
            mesh.box(Frame(), (0.0, 0.0, 0.0), (a, b, c), paint)
        elif kind == pybullet.GEOM_SPHERE:
            mesh.ball(Frame(), (0.0, 0.0, 0.0), (a, a, a), paint, 10)
        else:  # cylinders and capsules: length and radius
            mesh.prism(Frame(), (((0.0, 0.0, -a / 2), b, b), ((0.0, 0.0, a / 2), b, b)), paint, 14)
        return _Shape(link, offset, turn, self._stage.add(mesh))

    def pose(self, state: Array) -> None:
        """Show the robot in a render state."""
        self._place(self._client, self._body, self._joints, state)
        # The base's pose is that of its centre of mass; shapes are given in the links' frames.
        centre = pybullet.getDynamicsInfo(self._body, -1, physicsClientId=self._client)[3:5]
        base = pybullet.getBasePositionAndOrientation(self._body, physicsClientId=self._client)
        frames = {-1: pybullet.multiplyTransforms(*base, *pybullet.invertTransform(*centre))}
        for link in {shape.link for shape in self._shapes} - {-1}:
            at = pybullet.getLinkState(self._body, link, computeForwardKinematics=True, physicsClientId=self._client)
            frames[link] = at[4:6]
        for shape in self._shapes:
            position, turn = pybullet.multiplyTransforms(*frames[shape.link], shape.offset_m, shape.turn)
            self._stage.place(shape.handle, position, turn)

    def hide(self) -> None:
        """Hide the robot."""
        for shape in self._shapes:
            self._stage.hide(shape.handle)

    def close(self) -> None:
        """Release the kinematics; may be called twice."""
        if self._client >= 0:
            pybullet.disconnect(physicsClientId=self._client)
            self._client = -1
