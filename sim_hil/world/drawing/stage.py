"""Stages, which show and move meshes: the camera's renderer is one, PyBullet's window the other."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import numpy as np

from sim_hil.robots.bullet import pybullet
from sim_hil.world.drawing.mesh import MeshBuilder, Surface
from sim_hil.world.drawing.textures import png_bytes

Vec3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  # x, y, z, w

_AWAY: Vec3 = (0.0, 0.0, -1000.0)


class Stage(Protocol):
    """Interface of a stage; an added mesh is moved by its handle."""

    def add(self, mesh: MeshBuilder) -> int:
        """Show a mesh as it was built, and return its handle."""

    def place(self, handle: int, position_m: Vec3, quaternion_xyzw: Quaternion) -> None:
        """Set a mesh's pose; shows it again if it was hidden."""

    def hide(self, handle: int) -> None:
        """Hide a mesh until it is placed again."""


class BulletStage:
    """Stage in a PyBullet client: bodies without collision; textures pass through PNG files in `folder`."""

    def __init__(self, client: int, folder: Path) -> None:
        self._client, self._folder = client, folder
        self._made: list[list[int]] = []
        self._pictures = 0

    def add(self, mesh: MeshBuilder) -> int:
        """Show a mesh as it was built, and return its handle."""
        self._made.append([self._body(surface) for surface in mesh.surfaces()])
        return len(self._made) - 1

    def place(self, handle: int, position_m: Vec3, quaternion_xyzw: Quaternion) -> None:
        """Set a mesh's pose."""
        for body in self._made[handle]:
            pybullet.resetBasePositionAndOrientation(body, position_m, quaternion_xyzw, physicsClientId=self._client)

    def hide(self, handle: int) -> None:
        """Hide a mesh until it is placed again."""
        self.place(handle, _AWAY, (0.0, 0.0, 0.0, 1.0))

    def _body(self, surface: Surface) -> int:
        image, uvs = surface.image, surface.uvs
        if image is None:
            # Its visual shapes take no colours of vertices: they become cells of one palette picture.
            colours = sorted(set(surface.colours))
            cell = {colour: (index + 0.5) / len(colours) for index, colour in enumerate(colours)}
            image, uvs = np.array([colours], np.uint8), [(cell[colour], 0.5) for colour in surface.colours]
            image = image.repeat(4, axis=0).repeat(4, axis=1)  # 4 x 4 pixels per colour
        path = self._folder / f"stage-{self._pictures}.png"
        path.write_bytes(png_bytes(image))
        self._pictures += 1
        client = self._client
        handle = pybullet.loadTexture(str(path), physicsClientId=client)
        shape = pybullet.createVisualShape(
            pybullet.GEOM_MESH, vertices=surface.vertices, indices=surface.indices, uvs=uvs, normals=surface.normals,
            physicsClientId=client,
        )  # fmt: skip
        body = int(pybullet.createMultiBody(0, -1, shape, physicsClientId=client))
        pybullet.changeVisualShape(body, -1, textureUniqueId=handle, physicsClientId=client)
        return body
