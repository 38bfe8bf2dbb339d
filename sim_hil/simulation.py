"""The simulated world: a Go2 under physics, static things, walking people. No clock, no DDS, no threads inside."""

from __future__ import annotations

from contextlib import suppress
from math import atan2, hypot
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pybullet
from numpy.typing import NDArray

from sim_hil.gait import GRAVITY_MPS2
from sim_hil.go2 import Go2, RobotTruth
from sim_hil.people import PERSON_HEIGHT_M, PERSON_RADIUS_M, RENDER_FIELDS, UPDATE_HZ, People, appearances
from sim_hil.person_body import PersonBody
from sim_hil.scene import Box, Scene
from sim_hil.sport import SportAction
from sim_hil.world import build_scene

__all__ = ["PERSON_COLLISION_M", "ROBOT_FIELDS", "RobotTruth", "Simulation", "SimulationClosedError", "SportAction"]

PERSON_COLLISION_M = 0.5  # DynaNav: a person within 0.5 m of the robot counts as a collision
ROBOT_FIELDS = 19  # render_state: position, quaternion xyzw, 12 joint angles
_CONTACT_EVERY = 5  # steps: contacts last longer than 10 ms


class SimulationClosedError(RuntimeError):
    """The physics is gone: somebody closed its window, or the simulation was closed."""


class Simulation:
    """One deterministic world: the same scene, people, seed and calls give the same motion, step for step.

    With `gui` the physics shows in a window (needs a display). Raises ValueError when the scene has no room
    or no routes for that many people.
    """

    DT_S = 0.002

    def __init__(self, scene: Scene, *, people: int, seed: int, gui: bool = False) -> None:
        self.scene = scene
        self._gui = gui
        self._looks: list[PersonBody] = []
        self._walkers = People(scene, people, seed)
        self._seed = seed
        self._steps = 0
        self._touched: set[str] = set()
        self._fell = False
        self._client = pybullet.connect(pybullet.GUI if gui else pybullet.DIRECT)
        try:
            # The engine reads its files while building: afterwards even a killed run leaves none behind.
            with TemporaryDirectory(prefix="edge-sim-") as folder:
                self._build(scene, Path(folder))
        except BaseException:
            self.close()
            raise

    def _build(self, scene: Scene, folder: Path) -> None:
        client = self._client
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=self.DT_S, numSubSteps=1, deterministicOverlappingPairs=1, physicsClientId=client
        )
        pybullet.setGravity(0, 0, -GRAVITY_MPS2, physicsClientId=client)
        (x0, y0), (x1, y1) = scene.floor_min_m, scene.floor_max_m
        # The floor reaches beyond the walls, so that nothing can ever fall off the world.
        ground = Box(((x0 + x1) / 2, (y0 + y1) / 2, -0.5), (1.0, 0.0), (x1 - x0 + 10, y1 - y0 + 10, 1.0))
        self._floor = self._static(ground, friction=0.9)
        # Slippery sides: with friction, a foot that brushes a wall climbs it and the robot topples over its own leg.
        self._labels = {self._static(box, friction=0.1): label for label, box in scene.obstacles()}
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_CYLINDER, radius=PERSON_RADIUS_M, height=PERSON_HEIGHT_M, physicsClientId=client
        )
        hidden = self._hidden()
        self._person_bodies = [
            pybullet.createMultiBody(0, shape, hidden, physicsClientId=client) for _ in range(len(self._walkers))
        ]
        self._labels.update((body, "person") for body in self._person_bodies)
        if self._gui:
            build_scene(client, folder, scene)
            looks = appearances(len(self._walkers), self._seed)
            self._looks = [PersonBody(client, folder, look, f"person{i}-") for i, look in enumerate(looks)]
        self._place_people()
        self._go2 = Go2(client, folder, scene.start, self.DT_S)

    def _static(self, box: Box, friction: float) -> int:
        client = self._client
        half = [extent / 2 for extent in box.size_m]
        shape = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half, physicsClientId=client)
        turn = pybullet.getQuaternionFromEuler((0, 0, atan2(box.axis[1], box.axis[0])))
        body = int(pybullet.createMultiBody(0, shape, self._hidden(), box.centre_m, turn, physicsClientId=client))
        pybullet.changeDynamics(body, -1, lateralFriction=friction, physicsClientId=client)
        return body

    def _hidden(self) -> int:
        """The visual shape of a collision body: in a window the textured scene is shown in its place."""
        if not self._gui:
            return -1
        return int(
            pybullet.createVisualShape(
                pybullet.GEOM_SPHERE, radius=0.001, rgbaColor=(0, 0, 0, 0), physicsClientId=self._client
            )
        )

    def _place_people(self) -> None:
        for look, row in zip(self._looks, self._walkers.render_rows(), strict=False):
            look.pose(row)
        for body, (x, y, _) in zip(self._person_bodies, self._walkers.poses(), strict=True):
            pybullet.resetBasePositionAndOrientation(
                body, (x, y, PERSON_HEIGHT_M / 2), (0, 0, 0, 1), physicsClientId=self._client
            )

    def step(self) -> None:
        """Advance the world by DT_S. Raises SimulationClosedError when the physics is gone."""
        try:
            self._advance()
        except pybullet.error as error:
            raise self._explained(error) from error

    def _explained(self, error: Exception) -> Exception:
        if pybullet.isConnected(self._client):
            return error
        return SimulationClosedError(
            "simulation: its physics ended (the window was closed, or close() was called): expected it to run until"
            " the end; start the run again and leave the window open"
        )

    def _advance(self) -> None:
        if self._steps % round(1 / (UPDATE_HZ * self.DT_S)) == 0 and self._person_bodies:
            (x, y, _), heading = self._go2.pose()
            self._walkers.step(x, y, heading)
            self._place_people()
        self._go2.drive()
        pybullet.stepSimulation(physicsClientId=self._client)
        self._go2.observe()
        self._steps += 1
        if self._steps % _CONTACT_EVERY == 0:
            self._watch()

    def _watch(self) -> None:
        for contact in pybullet.getContactPoints(bodyA=self._go2.body, physicsClientId=self._client):
            label = self._labels.get(contact[2])
            if label is not None:
                self._touched.add(label)
        (x, y, _), _ = self._go2.pose()
        if any(hypot(x - px, y - py) < PERSON_COLLISION_M for px, py, _ in self._walkers.poses()):
            self._touched.add("person")
        self._fell = self._fell or self._go2.measured().up < 0.5

    def sport(self, action: SportAction) -> int:
        """Ask the sport controller for an action; 0, or a Unitree error code when the posture does not allow it."""
        return self._go2.sport.request(action)

    def move(self, vx_mps: float, vy_mps: float, wz_radps: float) -> None:
        """Command a body-frame velocity, in force for 1 s of simulation time; ignored unless balanced on its feet."""
        self._go2.sport.request_move(vx_mps, vy_mps, wz_radps)

    @property
    def commanded(self) -> tuple[float, float, float]:
        """The velocity command in force in the robot: zero when it may not move, or its last command has expired."""
        return self._go2.sport.commanded

    def truth(self) -> RobotTruth:
        """Ground truth of the robot now. Raises SimulationClosedError when the physics is gone."""
        try:
            return self._go2.truth(self._steps * self.DT_S)
        except pybullet.error as error:
            raise self._explained(error) from error

    def people(self) -> NDArray[np.float64]:
        """[n, 3]: x m, y m, heading rad of every person."""
        return self._walkers.poses()

    def collided_with(self) -> set[str]:
        """Labels of what the robot has touched so far; "person" also for one within 0.5 m, centre to centre."""
        return set(self._touched)

    @property
    def fell(self) -> bool:
        """Whether the robot has ever tilted by more than 60 degrees."""
        return self._fell

    def render_state(self) -> NDArray[np.float64]:
        """[19 + 5 n]: base position, quaternion xyzw, 12 joints, then per person x, y, heading, gait phase, swing."""
        robot = np.array(self._go2.base_and_joints())
        return np.concatenate((robot, self._walkers.render_rows().reshape(len(self._walkers) * RENDER_FIELDS)))

    def close(self) -> None:
        """Release the physics client; may be called twice, and after its window was closed."""
        if self._client >= 0:
            with suppress(pybullet.error):
                pybullet.disconnect(physicsClientId=self._client)
            self._client = -1
