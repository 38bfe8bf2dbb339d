"""Small episodes for tests of the benchmark: the corridor, cut to what a test needs."""

from __future__ import annotations

from dataclasses import replace

from sim_hil.benchmark.suite.episode import Episode
from sim_hil.scene.scene import Scene, SceneObject, Wall, load_scene


def corridor_episode(**changes: object) -> Episode:
    """A walk along the shipped corridor, nobody else in it."""
    values: dict[str, object] = {
        "id": "corridor-1",
        "task": "corridor",
        "scene": "corridor",
        "robot": "go2",
        "people": 0,
        "seed": 3,
        "start": (0.0, 0.0, 0.0),
        "goal_xy": (6.0, 0.0),
        "instructions": ("Walk down the corridor.", "Go straight on."),
        "timeout_s": 20.0,
        "threshold_m": 1.5,
        "shortest_m": 6.0,
        "landmarks": ("vending machine",),
        "goal_landmark": "vending machine",
    }
    return Episode(**{**values, **changes})  # type: ignore[arg-type]


def hall(*things: SceneObject, walls: tuple[Wall, ...] = ()) -> Scene:
    """A bare floor of 20 m x 10 m."""
    return replace(
        load_scene("corridor"),
        name="hall",
        start=(-8.0, 0.0, 0.0),
        goal_xy=(8.0, 0.0),
        floor_min_m=(-10.0, -5.0),
        floor_max_m=(10.0, 5.0),
        walls=walls,
        objects=things,
        routes=(),
    )


def block(x: float, y: float, depth: float, width: float, *, turn: float = 0.0, z: float = 0.0) -> SceneObject:
    """A cabinet to stand in the way."""
    return SceneObject(f"block {x} {y}", "cabinet", (x, y, z), turn, (depth, width, 1.0), (0.5, 0.5, 0.5), "")
