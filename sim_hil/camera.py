"""The Go2's forward camera: the scene and its people in a renderer of their own, posed from a render state."""

from __future__ import annotations

from contextlib import suppress
from math import atan, degrees, radians, tan
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pybullet
from numpy.typing import NDArray

from sim_hil.go2 import load_go2, place_go2, rotation_matrix
from sim_hil.people import RENDER_FIELDS, appearances
from sim_hil.person_body import PersonBody
from sim_hil.scene import Scene
from sim_hil.simulation import ROBOT_FIELDS
from sim_hil.world import build_scene
from sim_hil.world_stage import BulletStage

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

# Where the front camera sits on the base, and how it looks (the real one: wide, nearly level, at the nose).
CAMERA_POSITION_M = (0.327, 0.0, 0.043)
CAMERA_PITCH_RAD = radians(2.0)  # downwards
CAMERA_HFOV_RAD = radians(100.0)
_NEAR_M, _FAR_M = 0.02, 60.0  # near: the nose may touch a wall, which must still be seen


class CameraWorld:
    """Renders what the robot's camera sees. Own PyBullet client: build it in a process of its own for real time."""

    def __init__(self, scene: Scene, *, people: int, seed: int) -> None:
        self._people_count = people
        self._robot: int | None = None
        self._robot_joints: list[int] = []
        self._client = pybullet.connect(pybullet.DIRECT)
        try:
            # The renderer reads its files while building: afterwards even a killed run leaves none behind.
            with TemporaryDirectory(prefix="edge-camera-") as folder:
                stage = BulletStage(self._client, Path(folder))
                build_scene(stage, scene)
                self._people = [PersonBody(stage, look) for look in appearances(people, seed, scene.name)]
        except BaseException:
            self.close()
            raise

    @property
    def state_size(self) -> int:
        """Length of the render state this world takes."""
        return ROBOT_FIELDS + RENDER_FIELDS * self._people_count

    def render(self, render_state: Array, width: int, height: int) -> Picture:
        """The forward camera's picture, uint8 RGB [height, width, 3]. Raises ValueError on a state of another world."""
        self._pose(render_state)
        rotation = rotation_matrix(tuple(float(v) for v in render_state[3:7]))
        eye = render_state[0:3] + rotation @ CAMERA_POSITION_M
        forward = rotation @ (np.cos(CAMERA_PITCH_RAD), 0.0, -np.sin(CAMERA_PITCH_RAD))
        return self._picture(eye, eye + forward, rotation[:, 2], CAMERA_HFOV_RAD, width, height)

    def look(
        self, render_state: Array, eye_m: tuple[float, float, float], target_m: tuple[float, float, float],
        width: int, height: int, hfov_rad: float = radians(70.0),
    ) -> Picture:  # fmt: skip
        """The world, robot included, from anywhere: for reports and for looking at the simulation itself."""
        self._pose(render_state)
        self._show_robot(render_state)
        return self._picture(np.array(eye_m), np.array(target_m), np.array((0.0, 0.0, 1.0)), hfov_rad, width, height)

    def _pose(self, state: Array) -> None:
        if state.shape != (self.state_size,):
            raise ValueError(f"render state has shape {state.shape}, this world takes ({self.state_size},)")
        rows = state[ROBOT_FIELDS:].reshape(self._people_count, RENDER_FIELDS)
        for person, row in zip(self._people, rows, strict=True):
            person.pose(row)

    def _show_robot(self, state: Array) -> None:
        # The forward camera never sees the robot, so its body is loaded only for a view from outside.
        if self._robot is None:
            with TemporaryDirectory(prefix="edge-camera-") as folder:
                self._robot, self._robot_joints = load_go2(self._client, Path(folder), (0, 0, 0.3), 0.0)
        place_go2(self._client, self._robot, self._robot_joints, state)

    def _picture(self, eye: Array, target: Array, up: Array, hfov_rad: float, width: int, height: int) -> Picture:
        view = pybullet.computeViewMatrix(eye.tolist(), target.tolist(), up.tolist())
        vertical = degrees(2 * atan(tan(hfov_rad / 2) * height / width))
        projection = pybullet.computeProjectionMatrixFOV(vertical, width / height, _NEAR_M, _FAR_M)
        image = pybullet.getCameraImage(
            width,
            height,
            view,
            projection,
            shadow=0,  # a second pass over everything; the ceiling would put the whole corridor in the shade anyway
            lightDirection=(-3.0, 2.0, 6.0),
            lightColor=(1.0, 0.99, 0.96),
            lightAmbientCoeff=0.72,
            lightDiffuseCoeff=0.36,
            lightSpecularCoeff=0.0,
            renderer=pybullet.ER_TINY_RENDERER,
            flags=pybullet.ER_NO_SEGMENTATION_MASK,
            physicsClientId=self._client,
        )[2]
        pixels = np.asarray(image, dtype=np.uint8).reshape(height, width, 4)
        return np.ascontiguousarray(pixels[:, :, :3])

    def close(self) -> None:
        """Release the client; may be called twice, and after its connection was lost."""
        if self._client >= 0:
            with suppress(pybullet.error):
                pybullet.disconnect(physicsClientId=self._client)
            self._client = -1
