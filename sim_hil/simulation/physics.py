"""Simulated world: a robot under physics, ground, static objects, people. No clock, protocol or thread inside."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from math import atan2
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Final, cast

import numpy as np
from numpy.typing import NDArray

from sim_hil.crowd.people import PERSON_HEIGHT_M, PERSON_RADIUS_M, RENDER_FIELDS, UPDATE_HZ, People, appearances
from sim_hil.robots.bullet import pybullet
from sim_hil.robots.go2.body import Go2, RobotTruth
from sim_hil.robots.go2.gait import GRAVITY_MPS2
from sim_hil.robots.go2.sport import SportAction
from sim_hil.robots.interface import BaseTruth, Robot
from sim_hil.scene.scene import Box, Scene, Terrain
from sim_hil.simulation.person_body import PersonBody
from sim_hil.world.drawing.stage import BulletStage
from sim_hil.world.scene_meshes import build_scene

__all__ = ["PERSON_COLLISION_M", "ROBOTS", "RobotTruth", "Simulation", "SimulationClosedError", "SportAction"]

PERSON_COLLISION_M = 0.5  # DynaNav: a person within 0.5 m of the robot counts as a collision
_CONTACT_S = 0.01  # period of the contact check; contacts last longer
_NEAR_M = 2.5  # people within this distance of the robot have a physical body
_MAX_BODIES = 24  # maximum number of people within that distance
_TOUCHING_S = 0.1  # time for which a contact counts as current
_SHARED = 16  # boxes per body, the engine's maximum
_BLOCK_M = 8.0  # distance within which boxes share a body
_SETTLE_S = 6.0  # timeout for a robot to get ready
_FOOTING: Final = 0.9  # friction of the ground
# Slippery sides: with friction, a foot that brushes a wall climbs it and the robot topples over its own leg.
_SIDES: Final = 0.1

ROBOTS: Final[Mapping[str, str]] = MappingProxyType(
    {"go2": "sim_hil.robots.go2.body:Go2", "carter": "sim_hil.robots.carter.body:Carter"}
)
"""Available robots: name -> module and class."""


class SimulationClosedError(RuntimeError):
    """The physics client no longer exists: its window or the simulation was closed."""


class Simulation:
    """Deterministic world: the same scene, people, seed, rate and calls give the same motion, step for step.

    `start` (x m, y m, heading rad) replaces the scene's. `gui` shows the physics in a window (needs a display).
    `glides`: the robot's stand-in without legs or wheels (sim_hil/simulation/gliding.py). Raises ValueError for an
    unknown robot, or if the scene has no room or no routes for that many people.
    """

    DT_S = 0.002  # of the default rate, which real time runs at

    def __init__(
        self,
        scene: Scene,
        *,
        people: int,
        seed: int,
        gui: bool = False,
        robot: str = "go2",
        start: tuple[float, float, float] | None = None,
        rate_hz: int = 500,
        glides: bool = False,
    ) -> None:
        if robot not in ROBOTS:
            raise ValueError(f"simulation: unknown robot {robot!r}, expected one of {', '.join(ROBOTS)}")
        if not 120 <= rate_hz <= 2000:
            raise ValueError(f"simulation: expected 120..2000 physics steps a second, found {rate_hz}")
        self.scene = scene if start is None else replace(scene, start=start)
        self.rate_hz = rate_hz
        self.dt_s = 1.0 / rate_hz
        self._gui = gui
        self._glides = glides
        self._looks: list[PersonBody] = []
        self._walkers = People(self.scene, people, seed)
        self._people = self._walkers.poses()
        self._seed = seed
        self._steps = 0
        self._contact_every = max(1, round(_CONTACT_S * rate_hz))
        self._touched: dict[str, int] = {}  # label -> the latest step in which it was touched
        self._contacts: dict[str, int] = {}  # the same without those who were only near
        self.fell = False  # whether the robot has ever tilted by more than 60 degrees
        self.client = pybullet.connect(pybullet.GUI if gui else pybullet.DIRECT)
        """PyBullet's `physicsClientId` of this world."""
        try:
            # The engine reads its files while building; they are removed at once, so a killed run leaves none.
            with TemporaryDirectory(prefix="edge-sim-") as folder:
                self._build(self.scene, Path(folder), robot)
        except BaseException:
            self.close()
            raise

    def _build(self, scene: Scene, folder: Path, robot: str) -> None:
        client = self.client
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=self.dt_s, numSubSteps=1, deterministicOverlappingPairs=1, physicsClientId=client
        )
        pybullet.setGravity(0, 0, -GRAVITY_MPS2, physicsClientId=client)
        (x0, y0), (x1, y1) = scene.floor_min_m, scene.floor_max_m
        # The floor reaches beyond the walls, so that nothing can ever fall off the world.
        ground = Box(((x0 + x1) / 2, (y0 + y1) / 2, -0.5), (1.0, 0.0), (x1 - x0 + 10, y1 - y0 + 10, 1.0))
        self._grounds = [self._static(ground, friction=_FOOTING), *(self._raised(terrain) for terrain in scene.terrain)]
        self._solids = self._obstacles(scene.obstacles())
        self._aside = (x1 + 50.0, y1 + 50.0)
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_CYLINDER, radius=PERSON_RADIUS_M, height=PERSON_HEIGHT_M, physicsClientId=client
        )
        hidden = self._hidden()
        bodies = min(len(self._walkers), _MAX_BODIES)
        self._person_bodies = [
            pybullet.createMultiBody(
                0, shape, hidden, self._parking(slot), useMaximalCoordinates=1, physicsClientId=client
            )
            for slot in range(bodies)
        ]
        self._is_person = frozenset(self._person_bodies)
        self._embodied = [-1] * bodies
        if self._gui:
            stage = BulletStage(client, folder)
            build_scene(stage, scene)
            looks = appearances(len(self._walkers), self._seed, scene.name)
            self._looks = [PersonBody(stage, look) for look in looks]
        self.robot = self._load(robot, folder)
        self._place_people()

    def _load(self, robot: str, folder: Path) -> Robot:
        if self._glides:
            return self._load_gliding(robot)
        module, _, name = ROBOTS[robot].partition(":")
        # Imported by name: a wheeled base's code is not needed to walk, nor the other way round.
        build = cast("Callable[..., Robot]", getattr(importlib.import_module(module), name))
        start = self.scene.start
        loaded = build(self.client, folder, start, self.dt_s)
        ground = self.scene.ground_height_m(start[0], start[1])
        if ground > 0:
            (x, y, z), turn = pybullet.getBasePositionAndOrientation(loaded.body, physicsClientId=self.client)
            pybullet.resetBasePositionAndOrientation(loaded.body, (x, y, z + ground), turn, physicsClientId=self.client)
            loaded.observe()
        return loaded

    def _load_gliding(self, robot: str) -> Robot:
        from sim_hil.simulation.gliding import GLIDES, GlidingRobot

        loaded = GlidingRobot(self.client, self.scene.start, self.dt_s, GLIDES[robot], self.scene.ground_height_m)
        for ground in self._grounds:
            pybullet.setCollisionFilterPair(loaded.body, ground, -1, -1, 0, physicsClientId=self.client)
        return loaded

    def _static(self, box: Box, friction: float) -> int:
        half = [extent / 2 for extent in box.size_m]
        shape = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half, physicsClientId=self.client)
        turn = pybullet.getQuaternionFromEuler((0, 0, atan2(box.axis[1], box.axis[0])))
        return self._immovable(shape, box.centre_m, turn, friction)

    def _obstacles(self, boxes: list[tuple[str, Box]]) -> dict[int, list[tuple[str, Box]]]:
        """Create bodies from boxes; neighbouring boxes share a body, because every body costs time in every step."""
        ordered = sorted(boxes, key=lambda item: (item[1].centre_m[0] // _BLOCK_M, item[1].centre_m[1] // _BLOCK_M))
        solids = {}
        for first in range(0, len(ordered), _SHARED):
            group = ordered[first : first + _SHARED]
            shape = pybullet.createCollisionShapeArray(
                shapeTypes=[pybullet.GEOM_BOX] * len(group),
                halfExtents=[[extent / 2 for extent in box.size_m] for _, box in group],
                collisionFramePositions=[box.centre_m for _, box in group],
                collisionFrameOrientations=[
                    pybullet.getQuaternionFromEuler((0, 0, atan2(box.axis[1], box.axis[0]))) for _, box in group
                ],
                physicsClientId=self.client,
            )
            solids[self._immovable(shape, (0, 0, 0), (0, 0, 0, 1), _SIDES)] = group
        return solids

    def _raised(self, terrain: Terrain) -> int:
        corners = np.array(terrain.vertices_m())
        middle = corners.mean(axis=0)
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_MESH, vertices=(corners - middle).tolist(), physicsClientId=self.client
        )
        return self._immovable(shape, tuple(middle.tolist()), (0, 0, 0, 1), _FOOTING)

    def _immovable(self, shape: int, position: tuple[float, ...], turn: tuple[float, ...], friction: float) -> int:
        client = self.client
        # As a plain rigid body: a multi-body that cannot move would be solved for in every step all the same.
        body = int(
            pybullet.createMultiBody(
                0, shape, self._hidden(), position, turn, useMaximalCoordinates=1, physicsClientId=client
            )
        )
        pybullet.changeDynamics(body, -1, lateralFriction=friction, physicsClientId=client)
        return body

    def _hidden(self) -> int:
        """The visual shape of a collision body: in a window the textured scene is shown in its place."""
        if not self._gui:
            return -1
        return int(
            pybullet.createVisualShape(
                pybullet.GEOM_SPHERE, radius=0.001, rgbaColor=(0, 0, 0, 0), physicsClientId=self.client
            )
        )

    def _parking(self, slot: int) -> tuple[float, float, float]:
        return (self._aside[0] + slot, self._aside[1], PERSON_HEIGHT_M / 2)

    def _place_people(self) -> None:
        """Show all people in the window, and give those near the robot a physical body."""
        if self._looks:
            for look, row in zip(self._looks, self._walkers.render_rows(), strict=False):
                look.pose(row)
        (x, y, _), _ = self.robot.pose()
        gaps = np.hypot(self._people[:, 0] - x, self._people[:, 1] - y)
        near = np.flatnonzero(gaps < _NEAR_M)
        if len(near) > len(self._person_bodies):
            near = np.sort(near[np.argsort(gaps[near], kind="stable")[: len(self._person_bodies)]])
        for slot, body in enumerate(self._person_bodies):
            person = int(near[slot]) if slot < len(near) else -1
            if person < 0 and self._embodied[slot] < 0:
                continue
            place = self._parking(slot) if person < 0 else self._middle_of(person)
            self._embodied[slot] = person
            pybullet.resetBasePositionAndOrientation(body, place, (0, 0, 0, 1), physicsClientId=self.client)

    def _middle_of(self, person: int) -> tuple[float, float, float]:
        x, y = float(self._people[person, 0]), float(self._people[person, 1])
        return (x, y, PERSON_HEIGHT_M / 2 + self.scene.ground_height_m(x, y))

    def settle(self) -> None:
        """Let the robot get ready to move while people stand still. Raises RuntimeError on a timeout.

        It advances `time_s`; contacts meanwhile do not count.
        """
        self.robot.stand()
        for _ in range(round(_SETTLE_S * self.rate_hz)):
            if self.robot.ready:
                self._touched.clear()
                self._contacts.clear()
                return
            self._physics()
        raise RuntimeError(f"simulation: the robot was not ready to move within {_SETTLE_S} s of its start")

    def step(self) -> None:
        """Advance the world by dt_s. Raises SimulationClosedError if the physics client no longer exists."""
        try:
            if self._walkers_due() and len(self._walkers):
                (x, y, _), heading = self.robot.pose()
                self._walkers.step(x, y, heading)
                self._people = self._walkers.poses()
                self._place_people()
            self._physics()
        except pybullet.error as error:
            raise self._explained(error) from error

    def _walkers_due(self) -> bool:
        """Return whether people move in this step; their rate need not divide the physics rate."""
        return self._steps * UPDATE_HZ // self.rate_hz != (self._steps - 1) * UPDATE_HZ // self.rate_hz

    def _physics(self) -> None:
        self.robot.drive()
        pybullet.stepSimulation(physicsClientId=self.client)
        self.robot.observe()
        self._steps += 1
        if self._steps % self._contact_every == 0:
            self._watch()

    def _explained(self, error: Exception) -> Exception:
        if pybullet.isConnected(self.client):
            return error
        return SimulationClosedError(
            "simulation: its physics ended (the window was closed, or close() was called): expected it to run until"
            " the end; start the run again and leave the window open"
        )

    def _watch(self) -> None:
        labels = set()
        for contact in pybullet.getContactPoints(bodyA=self.robot.body, physicsClientId=self.client):
            # The engine also lists objects that are up to 2 cm away.
            if contact[9] > 0.0 or contact[8] < 0.0:
                if contact[2] in self._is_person:
                    labels.add("person")
                elif contact[2] in self._solids:
                    labels.add(_nearest_label(self._solids[contact[2]], contact[6]))
        self._contacts.update((label, self._steps) for label in labels)
        (x, y, _), _ = self.robot.pose()
        if len(self._people) and bool(
            np.any(np.hypot(self._people[:, 0] - x, self._people[:, 1] - y) < PERSON_COLLISION_M)
        ):
            labels.add("person")
        self._touched.update((label, self._steps) for label in labels)
        self.fell = self.fell or self.robot.up() < 0.5

    @property
    def time_s(self) -> float:
        """Simulated time since the world was created, s."""
        return self._steps * self.dt_s

    def command(self, vx_mps: float, vy_mps: float, wz_radps: float) -> None:
        """Command a body-frame velocity, valid for 1 s of simulation time; ignored unless the robot is ready."""
        self.robot.command(vx_mps, vy_mps, wz_radps)

    def sport(self, action: SportAction) -> int:
        """Request an action of a Go2's sport controller; return 0 or a Unitree error code.

        Raises ValueError for a robot without sport controller.
        """
        if not isinstance(self.robot, Go2):
            raise ValueError(f"simulation: sport actions are the Go2's, this robot is a {type(self.robot).__name__}")
        return self.robot.sport.request(action)

    @property
    def commanded(self) -> tuple[float, float, float]:
        """Velocity command in force; zero if the robot may not move or the last command has expired."""
        if isinstance(self.robot, Go2):
            return self.robot.sport.commanded
        return self.robot.truth(self.time_s).commanded

    def truth(self) -> BaseTruth:
        """Ground truth of the robot now (a Go2's is a RobotTruth). Raises SimulationClosedError."""
        try:
            return self.robot.truth(self.time_s)
        except pybullet.error as error:
            raise self._explained(error) from error

    def pose(self) -> tuple[tuple[float, float, float], float]:
        """Return base position, m, and heading, rad; cheaper than `truth`."""
        return self.robot.pose()

    def people(self) -> NDArray[np.float64]:
        """Return the pose of every person [n, 3]: x m, y m, heading rad."""
        return self._people.copy()

    def people_velocities(self) -> NDArray[np.float64]:
        """Return the velocity of every person [n, 2] in the world frame, m/s."""
        return self._walkers.velocities()

    def collided_with(self) -> set[str]:
        """Return the labels touched so far; "person" also counts one within 0.5 m, centre to centre."""
        return set(self._touched)

    @property
    def touching(self) -> frozenset[str]:
        """Labels touched within the last 0.1 s, because legs make intermittent contact."""
        return self._lately(self._touched)

    def contacts(self) -> set[str]:
        """Return the labels of physical contacts so far, without people who were only near."""
        return set(self._contacts)

    @property
    def in_contact(self) -> frozenset[str]:
        """Labels of physical contacts within the last 0.1 s."""
        return self._lately(self._contacts)

    def _lately(self, steps: dict[str, int]) -> frozenset[str]:
        since = self._steps - _TOUCHING_S * self.rate_hz
        return frozenset(label for label, step in steps.items() if step > since)

    def render_state(self) -> NDArray[np.float64]:
        """Return the render state [robot fields + RENDER_FIELDS n]: the robot's, then every person's row."""
        robot = np.array(self.robot.render_state())
        return np.concatenate((robot, self._walkers.render_rows().reshape(len(self._walkers) * RENDER_FIELDS)))

    def close(self) -> None:
        """Release the physics client; may be called twice, and after its window was closed."""
        if self.client >= 0:
            with suppress(pybullet.error):
                pybullet.disconnect(physicsClientId=self.client)
            self.client = -1


def _nearest_label(boxes: list[tuple[str, Box]], point: tuple[float, float, float]) -> str:
    """Return the label of the box that contains a point or whose surface is nearest to it."""

    def gap_m(box: Box) -> float:
        dx, dy, dz = (p - c for p, c in zip(point, box.centre_m, strict=True))
        c, s = box.axis
        return max(
            abs(c * dx + s * dy) - box.size_m[0] / 2,
            abs(c * dy - s * dx) - box.size_m[1] / 2,
            abs(dz) - box.size_m[2] / 2,
        )

    return min(boxes, key=lambda item: gap_m(item[1]))[0]
