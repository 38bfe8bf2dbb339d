"""Forward camera of the robot: renders the scene and its people from a render state."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, radians, sin, tan
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sim_hil.crowd.people import RENDER_FIELDS, Appearance, appearances
from sim_hil.robots.carter import body as carter
from sim_hil.robots.go2 import body as go2
from sim_hil.robots.go2.body import rotation_matrix
from sim_hil.scene.scene import Scene
from sim_hil.simulation.person_body import PersonBody
from sim_hil.simulation.renderer import Picture, Renderer
from sim_hil.world.scene_meshes import build_scene
from sim_hil.world.wall_visibility import Sight, Visibility

Array = NDArray[np.float64]

# Pose and field of view of the Go2's front camera on the base (the real one: wide, nearly level, at the nose).
CAMERA_POSITION_M = (0.327, 0.0, 0.043)
CAMERA_PITCH_RAD = radians(2.0)  # downwards
CAMERA_HFOV_RAD = radians(100.0)

_PERSON_M: Final = 0.9  # radius of a person's body around the point between the feet
_FAR_PERSON_M: Final = 45.0  # people beyond this are not rendered (1 to 2 px at 128 x 128)
_NEAR_PERSON_M: Final = 6.0  # people beyond this are rendered with less detail
_UPRIGHT: Final = 0.9


@dataclass(frozen=True)
class Mount:
    """Camera of a robot: position on the base, m; pitch (downwards) and horizontal field of view, rad.

    `fields`: length of the robot's part of a render state.
    """

    position_m: tuple[float, float, float]
    pitch_rad: float
    hfov_rad: float
    fields: int


MOUNTS: Final = {
    "go2": Mount(CAMERA_POSITION_M, CAMERA_PITCH_RAD, CAMERA_HFOV_RAD, go2.RENDER_FIELDS),
    "carter": Mount(
        carter.CAMERA_POSITION_M, carter.CAMERA_PITCH_RAD, carter.CAMERA_HFOV_RAD, carter.RENDER_FIELDS
    ),
}  # fmt: skip


class CameraWorld:
    """Renderer of the robot's camera; for real time, use it in a separate process.

    `looks`: the people's appearances; default: those of the seed. Raises ValueError for an unknown robot.
    """

    def __init__(
        self, scene: Scene, *, people: int, seed: int, robot: str = "go2", looks: list[Appearance] | None = None
    ) -> None:
        if robot not in MOUNTS:
            raise ValueError(f"camera: unknown robot {robot!r}, expected one of {', '.join(MOUNTS)}")
        self._looks = appearances(people, seed, scene.name) if looks is None else looks
        if len(self._looks) != people:
            raise ValueError(f"camera: expected looks of {people} people, found {len(self._looks)}")
        self._mount = MOUNTS[robot]
        self._renderer = Renderer(scene.sky)
        self._near: dict[int, PersonBody] = {}
        self._far: dict[int, PersonBody] = {}
        self._shown: dict[int, PersonBody] = {}
        try:
            pieces = build_scene(self._renderer, scene)
            self._fixed = [handle for handle, _ in pieces]
            self._visibility = Visibility(scene, [bounds for _, bounds in pieces])
        except BaseException:
            self.close()
            raise

    @property
    def state_size(self) -> int:
        """Length of this world's render state."""
        return self._mount.fields + RENDER_FIELDS * len(self._looks)

    def render(self, render_state: Array, width: int, height: int, aspect: float | None = None) -> Picture:
        """Render the forward camera's image, uint8 RGB [height, width, 3]. Raises ValueError for a bad state.

        `aspect`: aspect ratio of the field of view, which is scaled to the image's size; None: square pixels.
        """
        if render_state.shape != (self.state_size,):
            raise ValueError(f"render state has shape {render_state.shape}, this world takes ({self.state_size},)")
        mount = self._mount
        rotation = rotation_matrix(tuple(float(v) for v in render_state[3:7]))
        eye = render_state[0:3] + rotation @ mount.position_m
        forward = rotation @ (cos(mount.pitch_rad), 0.0, -sin(mount.pitch_rad))
        shape = width / height if aspect is None else aspect
        sight = self._sight(eye, forward, rotation[:, 2], mount.hfov_rad)
        shown = self._fixed if sight is None else [self._fixed[piece] for piece in self._visibility.pieces(sight)]
        self._renderer.arrange(self._fixed, shown)
        self._show_people(render_state, eye, sight)
        return self._renderer.picture(eye, forward, rotation[:, 2], mount.hfov_rad, width, height, shape)

    def _sight(self, eye: Array, forward: Array, up: Array, hfov_rad: float) -> Sight | None:
        """Return the robot's view cone; None if it lies on its side or looks steeply up or down."""
        flat = float(np.hypot(forward[0], forward[1]))
        if up[2] < _UPRIGHT or flat < _UPRIGHT:
            return None
        # A tilted camera's view is slightly wider on the floor than its field of view.
        return self._visibility.sight(eye[:2], forward[:2] / flat, tan(hfov_rad / 2) / (flat * float(up[2])))

    def _show_people(self, state: Array, eye: Array, sight: Sight | None) -> None:
        """Pose the people who may be visible and hide all others."""
        rows = state[self._mount.fields :].reshape(len(self._looks), RENDER_FIELDS)
        before, self._shown = self._shown, {}
        if len(rows):
            gaps = np.hypot(rows[:, 0] - eye[0], rows[:, 1] - eye[1])
            seen = gaps < _FAR_PERSON_M
            if sight is not None:
                seen &= sight.sees(rows[:, :2] - _PERSON_M, rows[:, :2] + _PERSON_M)[0]
            for index in np.flatnonzero(seen):
                body = self._body(int(index), bool(gaps[index] < _NEAR_PERSON_M))
                body.pose(rows[index])
                self._shown[id(body)] = body
        for key, body in before.items():
            if key not in self._shown:
                body.hide()

    def _body(self, index: int, near: bool) -> PersonBody:
        bodies = self._near if near else self._far
        if index not in bodies:
            bodies[index] = PersonBody(self._renderer, self._looks[index], 1.0 if near else 0.5)
        return bodies[index]

    def close(self) -> None:
        """Release the renderer; may be called twice."""
        self._renderer.close()
