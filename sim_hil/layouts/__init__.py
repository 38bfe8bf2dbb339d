"""Generator of layouts for DynaNav's four environments: every seed gives another valid scene."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sim_hil.layouts.builder import Turn, turned
from sim_hil.layouts.check import problems
from sim_hil.layouts.hospital import hospital
from sim_hil.layouts.office import office
from sim_hil.layouts.plan import LayoutError
from sim_hil.layouts.sidewalk import sidewalk
from sim_hil.layouts.warehouse import warehouse
from sim_hil.scene.scene import Scene, SceneError

__all__ = ["BENCHMARK_SEEDS", "KINDS", "LayoutError", "generate", "is_reserved", "problems"]

_MAKERS: dict[str, tuple[int, Callable[[np.random.Generator], Scene]]] = {
    "hospital": (1, hospital),
    "office": (2, office),
    "warehouse": (3, warehouse),
    "sidewalk": (4, sidewalk),
}
KINDS = tuple(_MAKERS)
RESERVED_BELOW = 100  # seeds reserved for the benchmark, not allowed for training
BENCHMARK_SEEDS = {"hospital": 7, "office": 11, "warehouse": 5, "sidewalk": 3}
_ATTEMPTS = 60


def is_reserved(seed: int) -> bool:
    """Return whether a seed is reserved for the benchmark, so that training must not use it."""
    return 0 <= seed < RESERVED_BELOW


def generate(kind: str, seed: int, *, reserved: bool = False) -> Scene:
    """Generate a valid layout; the same kind and seed give the same scene. Raises LayoutError.

    Reserved seeds are refused unless `reserved` is true, which is not allowed for training.
    """
    if kind not in _MAKERS:
        raise LayoutError(f"unknown kind of layout {kind!r}, expected one of {', '.join(KINDS)}")
    if seed < 0:
        raise LayoutError(f"seed must be 0 or more, found {seed}")
    if is_reserved(seed) and not reserved:
        raise LayoutError(
            f"seed {seed} is reserved for the benchmark's scenes: take {RESERVED_BELOW} or more for training"
        )
    tag, make = _MAKERS[kind]
    last = "nothing was tried"
    for attempt in range(_ATTEMPTS):
        rng = np.random.default_rng((seed, tag, attempt))
        turn = Turn(*(bool(rng.integers(2)) for _ in range(3)))
        try:
            scene = turned(make(rng), turn)
        except (LayoutError, SceneError) as error:
            last = str(error)
            continue
        found = problems(scene)
        if not found:
            return scene
        last = found[0]
    raise LayoutError(f"{kind} of seed {seed}: no sound layout in {_ATTEMPTS} attempts; the last one: {last}")
