"""The paper's ablations and baselines by name, as settings of a recipe (tables 1, 2, 5, 6, 11 and 13)."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

_UNAWARE: Final = ("model.action.latency_aware=false", "imitate.inject_delay=false")
VARIANTS: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {
        "full": (),
        "waypoints": ("model.action.semantic_interface=waypoints",),
        "waypoints-no-latency": ("model.action.semantic_interface=waypoints", *_UNAWARE),
        "values-only": ("model.action.semantic_interface=values-only",),
        "no-latency": _UNAWARE,
        "no-motion-offset": ("model.action.motion_offset=false",),
        "no-reasoning": ("imitate.sample.reasoning=false",),
        "offsets": ("model.action.parameterisation=offsets",),
        "horizon-1s": ("model.action.steps=10",),
        "horizon-5s": ("model.action.steps=50",),
        "depth-3": ("model.action.layers=3",),
        "depth-12": ("model.action.layers=12",),
        "diffusion": ("model.action.head=diffusion",),
        "flow": ("model.action.head=flow",),
        "point-goal-bc": ("imitate.policy=point-goal",),
        # Trained from scratch, whereas the recipe's values are for a policy that already drives.
        "point-goal-rl": (
            "rl.policy=point-goal",
            "rl.ppo.action_lr=3e-4",
            "rl.log_std=-1.2,-0.7",
            "rl.warmup_iterations=0",
            "rl.imitation=0.0",
        ),
    }
)
"""Settings by variant; the benchmark uses the same names (`sim_hil.benchmark.conditions.variants`)."""
