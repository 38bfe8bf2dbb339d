"""The kinds of training scenes and their default shares."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from sim_hil.layouts import KINDS as LAYOUTS

CORRIDOR: Final = "corridor"
KINDS: Final = (*LAYOUTS, CORRIDOR)
OUTDOORS: Final = frozenset(("sidewalk",))
TASKS_PER_SCENE: Final = 8
SHARES: Final[Mapping[str, float]] = MappingProxyType(
    {"hospital": 0.25, "office": 0.25, "warehouse": 0.24, "sidewalk": 0.20, CORRIDOR: 0.06}
)
