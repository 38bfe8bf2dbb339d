"""Training scenes: generated layouts of the four environments and the demo's corridor, never one of the benchmark."""

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
from tools.train.config.collect import CORRIDOR, KINDS, OUTDOORS

# Objects of the demo's corridor that are distinguishable and can be goals.
_CORRIDOR_LANDMARKS: Final = frozenset(
    ("vending machine", "bench", "water dispenser", "fire extinguisher", "cabinet", "notice board", "exit door")
)
_OUTDOOR_GOALS: Final = 8
_MOVED_M: Final = 0.7  # largest shift of an object along the wall, small enough that no two meet


class SiteError(ValueError):
    """A scene of an unknown kind or of the benchmark; one line."""


class Site:
    """One scene with derived data, computed on first use. Raises SiteError, LayoutError."""

    def __init__(self, kind: str, layout_seed: int) -> None:
        if kind not in KINDS:
            raise SiteError(f"unknown kind of scene {kind!r}, expected one of {', '.join(KINDS)}")
        if layout_seed < 0 or is_reserved(layout_seed):
            raise SiteError(f"layout seed {layout_seed} is the benchmark's: expected 100 or more")
        self.kind, self.layout_seed = kind, layout_seed
        made = corridor(layout_seed) if kind == CORRIDOR else generate(kind, layout_seed)
        # The name begins with the kind, which determines the people's clothes.
        self.scene: Scene = replace(made, name=f"{kind}-{layout_seed}")
        self._robot_grids: dict[str, NavGrid] = {}

    @property
    def outdoors(self) -> bool:
        """Whether the scene has no ceiling."""
        return self.kind in OUTDOORS

    @property
    def threshold_m(self) -> float:
        """Distance to the goal that counts as success, m, as in the benchmark."""
        return 3.0 if self.outdoors else 1.5

    @cached_property
    def grid(self) -> NavGrid:
        """Grid of free floor by which routes are described."""
        return route_grid(self.scene)

    @cached_property
    def goals(self) -> tuple[SceneObject, ...]:
        """Landmarks that can be goals; outdoors a subset, because each needs a search of the whole scene."""
        found = goals(self.scene)
        if not self.outdoors or len(found) <= _OUTDOOR_GOALS:
            return tuple(found)
        rng = np.random.default_rng((self.layout_seed, 47))
        return tuple(found[index] for index in sorted(rng.choice(len(found), _OUTDOOR_GOALS, replace=False)))

    @cached_property
    def lines(self) -> Sightlines:
        """Sightlines of the scene."""
        return Sightlines(self.scene)

    def robot_grid(self, robot: str) -> NavGrid:
        """Return the grid of floor that is free for a robot. Raises ValueError for an unknown robot."""
        if robot not in self._robot_grids:
            self._robot_grids[robot] = robot_grid(self.scene, robot)
        return self._robot_grids[robot]


def corridor(layout_seed: int) -> Scene:
    """Build the demo's corridor with named landmarks; for odd seeds the landmarks are moved.

    Landmarks at the walls are moved a little along them, so that their positions cannot be memorised.
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
