"""The paper's reward, equation 5, as a pure function of one control step; weights and target speed from appendix D.

The paper names the four terms but does not define them. Our definitions: goal is 1 in the step that reaches it;
progress is the decrease of the path length to the goal around obstacles, m; collision is 1 in a step in which a
collision begins (`Contacts`); speed is the absolute difference from the target speed, m/s.
"""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass
from math import isfinite
from typing import Final

APART_STEPS: Final = 10
"""Control steps (1 s) without contact after which touching the same object counts as another collision."""


@dataclass(frozen=True)
class RewardWeights:
    """Weights w_g, w_p, w_c and w_s of equation 5, and the target speed, m/s."""

    goal: float = 400.0
    progress: float = 5.0
    collision: float = -100.0
    speed: float = -0.1
    target_speed_mps: float = 1.0

    def __post_init__(self) -> None:
        if not all(isfinite(v) for v in (self.goal, self.progress, self.collision, self.speed, self.target_speed_mps)):
            raise ValueError("reward: every weight must be finite")


PAPER = RewardWeights()


class Contacts:
    """Detector of new collisions: repeated contact while scraping along a wall or a person counts once."""

    def __init__(self) -> None:
        self._step = 0
        self._touched: dict[str, int] = {}

    def began(self, touching: Set[str]) -> bool:
        """Return whether a collision begins; call once per control step with the labels of touched objects."""
        self._step += 1
        last = {label: self._touched.get(label) for label in touching}
        self._touched.update(dict.fromkeys(touching, self._step))
        return any(step is None or self._step - step > APART_STEPS for step in last.values())


def reward(
    *,
    reached: bool,
    distance_before_m: float,
    distance_after_m: float,
    collision_began: bool,
    speed_mps: float,
    weights: RewardWeights = PAPER,
) -> float:
    """Return the reward of one control step; distances are path lengths to the goal before and after it, m."""
    return (
        weights.goal * float(reached)
        + weights.progress * (distance_before_m - distance_after_m)
        + weights.collision * float(collision_began)
        + weights.speed * abs(speed_mps - weights.target_speed_mps)
    )
