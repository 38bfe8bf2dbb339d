"""Instance images: a copy of a scene in which every object has one flat colour that encodes its number."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from math import cos, sin, tan
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sim_hil.benchmark.language.visibility import ASPECT
from sim_hil.crowd.people import RENDER_FIELDS, Appearance
from sim_hil.robots.go2.body import rotation_matrix
from sim_hil.scene.scene import Scene, SceneObject
from sim_hil.simulation.camera import MOUNTS, Mount
from sim_hil.simulation.person_body import PersonBody
from sim_hil.simulation.renderer import Renderer
from sim_hil.world.drawing.mesh import MeshBuilder, Surface, Vec2, Vec3
from sim_hil.world.drawing.stage import Quaternion
from sim_hil.world.drawing.textures import Colour, Image
from sim_hil.world.scene_meshes import Pieces, add_ceiling, add_floor, add_object, add_terrain, add_wall
from sim_hil.world.wall_visibility import Sight, Visibility

Array = NDArray[np.float64]
Ids = NDArray[np.int32]

SKY, FLOOR, CEILING = 0, 1, 2
"""Numbers that are equal in every scene; terrain, walls, objects and people follow, each in the scene's order."""
FIRST: Final = 3
_LIT: Vec3 = (-3 / 7, 2 / 7, 6 / 7)  # normal towards the renderer's sun: without shading, colours are exact
_BITS, _STEP = 5, 8  # bits per colour channel, and the step between two levels
_PERSON_M, _FAR_PERSON_M = 0.9, 30.0  # half size of a person's bounds; people farther away have no labels
_UPRIGHT: Final = 0.9  # least vertical component of the camera's up vector for visibility culling
_DETAIL: Final = 0.4  # level of detail of people


@dataclass(frozen=True)
class View:
    """Pose and field of view of a camera: position m, unit vectors ahead, right and above, in the world.

    `half_width` and `half_height` are the tangents of half the horizontal and vertical field of view.
    """

    eye: Array
    ahead: Array
    right: Array
    above: Array
    half_width: float
    half_height: float

    def rays(self, px: int) -> Array:
        """Return the pixels' directions [px, px, 3] in the world, of length 1 along `ahead`, top row first."""
        steps = (np.arange(px) + 0.5) / px * 2 - 1
        across, up = steps * self.half_width, -steps * self.half_height
        return self.ahead + across[None, :, None] * self.right + up[:, None, None] * self.above


def view_of(render_state: Array, mount: Mount) -> View:
    """Return the view of a robot's camera in this render state, for an image of 16:9."""
    rotation = rotation_matrix(tuple(float(v) for v in render_state[3:7]))
    ahead = rotation @ (cos(mount.pitch_rad), 0.0, -sin(mount.pitch_rad))
    right = np.cross(ahead, rotation[:, 2])
    right /= np.linalg.norm(right)
    half = tan(mount.hfov_rad / 2)
    eye = render_state[:3] + rotation @ mount.position_m
    return View(eye, ahead, right, np.cross(right, ahead), half, half / ASPECT)


class IdWorld:
    """Renders instance images of a robot's camera, for the same render states as a CameraWorld."""

    def __init__(self, scene: Scene, looks: Sequence[Appearance], robot: str) -> None:
        self.mount = MOUNTS[robot]
        self._looks = tuple(looks)
        self._renderer = Renderer((0.0, 0.0, 0.0), smooth=False)
        self._bodies: dict[int, PersonBody] = {}
        self._shown: set[int] = set()
        self._pen = _Pen()
        try:
            pieces = self._painted(scene)
            self._fixed = [self._renderer.add(mesh) for mesh in pieces]
            self._visibility = Visibility(scene, [mesh.bounds() for mesh in pieces])
        except BaseException:
            self.close()
            raise
        self.first_person = FIRST + len(scene.terrain) + len(scene.walls) + len(scene.objects)
        if self.first_person + len(self._looks) > 1 << 3 * _BITS:
            raise ValueError(f"{scene.name}: more things than there are colours")

    def ids(self, render_state: Array, px: int) -> Ids:
        """Return the number of the object in each pixel [px, px], top row first."""
        view = view_of(render_state, self.mount)
        up = np.cross(view.right, view.ahead)
        sight = self._sight(view, up)
        shown = self._fixed if sight is None else [self._fixed[piece] for piece in self._visibility.pieces(sight)]
        self._renderer.arrange(self._fixed, shown)
        self._show_people(render_state, view.eye, sight)
        picture = self._renderer.picture(view.eye, view.ahead, up, self.mount.hfov_rad, px, px, ASPECT)
        levels = picture.astype(np.int32) // _STEP
        ids: Ids = levels[..., 0] + (levels[..., 1] << _BITS) + (levels[..., 2] << 2 * _BITS)
        return ids

    def close(self) -> None:
        """Release the renderer; repeated calls have no effect."""
        self._renderer.close()

    def _painted(self, scene: Scene) -> list[MeshBuilder]:
        """Build the scene's meshes as `build_scene` does, in flat colours."""
        pieces = Pieces(8.0 if scene.ceiling_height_m > 0 else 16.0, lambda: _Painted(self._pen))
        self._pen.number = FLOOR
        add_floor(pieces, scene)
        self._pen.number = CEILING
        add_ceiling(pieces, scene)

        def place(thing: SceneObject) -> None:
            add_object(pieces.at(*thing.position_m[:2]), thing)

        parts: list[Callable[[], None]] = [partial(add_terrain, pieces, each) for each in scene.terrain]
        parts += [partial(add_wall, pieces, each) for each in scene.walls]
        parts += [partial(place, each) for each in scene.objects]
        for number, add in enumerate(parts, FIRST):
            self._pen.number = number
            add()
        return pieces.all()

    def _sight(self, view: View, up: Array) -> Sight | None:
        flat = float(np.hypot(view.ahead[0], view.ahead[1]))
        if up[2] < _UPRIGHT or flat < _UPRIGHT:
            return None
        return self._visibility.sight(view.eye[:2], view.ahead[:2] / flat, view.half_width / (flat * float(up[2])))

    def _show_people(self, state: Array, eye: Array, sight: Sight | None) -> None:
        rows = state[self.mount.fields :].reshape(len(self._looks), RENDER_FIELDS)
        seen = np.hypot(rows[:, 0] - eye[0], rows[:, 1] - eye[1]) < _FAR_PERSON_M
        if sight is not None and len(rows):
            seen &= sight.sees(rows[:, :2] - _PERSON_M, rows[:, :2] + _PERSON_M)[0]
        now = {int(index) for index in np.flatnonzero(seen)}
        for index in self._shown - now:
            self._bodies[index].hide()
        for index in sorted(now):
            if index not in self._bodies:
                pen = _Pen(self.first_person + index)
                self._bodies[index] = PersonBody(_PaintStage(self._renderer, pen), self._looks[index], _DETAIL)
            self._bodies[index].pose(rows[index])
        self._shown = now


@dataclass
class _Pen:
    number: int = SKY

    @property
    def colour(self) -> Colour:
        low = (1 << _BITS) - 1
        levels = (self.number & low, self.number >> _BITS & low, self.number >> 2 * _BITS & low)
        red, green, blue = (level * _STEP + _STEP // 2 for level in levels)
        return (red, green, blue)


class _Painted(MeshBuilder):
    """A mesh whose faces and textures all have the pen's colour."""

    def __init__(self, pen: _Pen) -> None:
        super().__init__()
        self._pen = pen

    def picture(self, name: str, image: Image) -> str:
        return name

    def has_picture(self, name: str) -> bool:
        return True

    def patch(self, texture: str, corners: Sequence[Vec3], uvs: Sequence[Vec2]) -> None:
        self.face(self._pen.colour, corners)

    def face(self, colour: Colour, corners: Sequence[Vec3], normals: Sequence[Vec3] | None = None) -> None:
        super().face(self._pen.colour, corners, (_LIT,) * len(corners))


class _Repainted(MeshBuilder):
    """A copy of a mesh in the pen's colour."""

    def __init__(self, mesh: MeshBuilder, pen: _Pen) -> None:
        super().__init__()
        self._mesh, self._pen = mesh, pen

    def surfaces(self) -> Iterator[Surface]:
        for each in self._mesh.surfaces():
            count = len(each.vertices)
            yield Surface(
                None, each.vertices, each.indices, [(0.0, 0.0)] * count, [_LIT] * count, [self._pen.colour] * count
            )


class _PaintStage:
    """A stage that shows added meshes in the pen's colour."""

    def __init__(self, renderer: Renderer, pen: _Pen) -> None:
        self._renderer, self._pen = renderer, pen

    def add(self, mesh: MeshBuilder) -> int:
        return self._renderer.add(_Repainted(mesh, self._pen))

    def place(self, handle: int, position_m: Vec3, quaternion_xyzw: Quaternion) -> None:
        self._renderer.place(handle, position_m, quaternion_xyzw)

    def hide(self, handle: int) -> None:
        self._renderer.hide(handle)
