"""Scenes for training: fresh layouts of the four environments, and the demo's corridor; never one of the benchmark."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Final

import numpy as np

from sim_hil.benchmark.language.tasks import goals
from sim_hil.benchmark.language.visibility import Sightlines
from sim_hil.benchmark.suite.robots import robot_grid, route_grid
from sim_hil.layouts import generate, is_reserved
from sim_hil.scene.nav_grid import NavGrid
from sim_hil.scene.scene import Area, Scene, SceneObject, load_scene
from tools.train.config.scenes import CORRIDOR, KINDS, OUTDOORS

# What can be told apart and gone to in the demo's corridor.
_CORRIDOR_LANDMARKS: Final = frozenset(
    ("vending machine", "bench", "water dispenser", "fire extinguisher", "cabinet", "notice board", "exit door")
)
_OUTDOOR_GOALS: Final = 8
_MOVED_M: Final = 0.7  # along the wall: no two of them meet


class SiteError(ValueError):
    """A scene that training may not use, or of an unknown kind; one line."""


class Site:
    """One scene with what is worked out about it, each when it is first asked for. Raises SiteError, LayoutError."""

    def __init__(self, kind: str, layout_seed: int) -> None:
        if kind not in KINDS:
            raise SiteError(f"unknown kind of scene {kind!r}, expected one of {', '.join(KINDS)}")
        if layout_seed < 0 or is_reserved(layout_seed):
            raise SiteError(f"layout seed {layout_seed} is the benchmark's: expected 100 or more")
        self.kind, self.layout_seed = kind, layout_seed
        made = corridor(layout_seed) if kind == CORRIDOR else generate(kind, layout_seed)
        # The kind stays in front: people dress by it.
        self.scene: Scene = replace(made, name=f"{kind}-{layout_seed}")
        self._robot_grids: dict[str, NavGrid] = {}

    @property
    def outdoors(self) -> bool:
        """Whether there is no ceiling."""
        return self.kind in OUTDOORS

    @property
    def threshold_m(self) -> float:
        """How near the goal has been reached, as in the benchmark."""
        return 3.0 if self.outdoors else 1.5

    @cached_property
    def grid(self) -> NavGrid:
        """The floor by which ways are told."""
        return route_grid(self.scene)

    @cached_property
    def goals(self) -> tuple[SceneObject, ...]:
        """Landmarks to be sent to; outdoors some of them: to search the whole scene for each would take too long."""
        found = goals(self.scene)
        if not self.outdoors or len(found) <= _OUTDOOR_GOALS:
            return tuple(found)
        rng = np.random.default_rng((self.layout_seed, 47))
        return tuple(found[index] for index in sorted(rng.choice(len(found), _OUTDOOR_GOALS, replace=False)))

    @cached_property
    def lines(self) -> Sightlines:
        """Who can be seen from where."""
        return Sightlines(self.scene)

    def robot_grid(self, robot: str) -> NavGrid:
        """The floor that is free for a robot; raises ValueError for an unknown one."""
        if robot not in self._robot_grids:
            self._robot_grids[robot] = robot_grid(self.scene, robot)
        return self._robot_grids[robot]


def corridor(layout_seed: int) -> Scene:
    """The demo's corridor with names for what stands in it: as it is for an even seed, things moved for an odd one.

    What stands along the walls is moved along them a little, so that no place can be learnt by heart.
    """
    scene = load_scene(CORRIDOR)
    (x0, y0), (x1, y1) = scene.floor_min_m, scene.floor_max_m
    area = Area("corridor 1", "corridor", ((x0, y0), (x1, y0), (x1, y1), (x0, y1)), "corridor")
    rng = np.random.default_rng((layout_seed, 31))
    things = []
    for thing in scene.objects:
        x, y, z = thing.position_m
        if layout_seed % 2 and thing.label in _CORRIDOR_LANDMARKS and abs(y) > 1.0:
            x = round(x + float(rng.uniform(-_MOVED_M, _MOVED_M)), 2)
        name = thing.label if thing.label in _CORRIDOR_LANDMARKS else ""
        things.append(replace(thing, position_m=(x, y, z), landmark=name))
    return replace(scene, objects=tuple(things), areas=(area,))
