"""Baselines without learning: standing still, a random walk, and driving straight towards the goal."""

from __future__ import annotations

from collections.abc import Mapping
from math import atan2, cos, exp, hypot, sqrt
from typing import TYPE_CHECKING, Final

import numpy as np

from edge.core.geometry import SE2, wrap_angle
from sim_hil.benchmark.conditions.conditions import BASELINES
from sim_hil.benchmark.env.observation import Observation
from sim_hil.benchmark.policies.policy import Policy, Velocity
from sim_hil.benchmark.suite.episode import Episode

if TYPE_CHECKING:
    from sim_hil.benchmark.env.world import EpisodeWorld

CONTROL_S: Final = 0.1
_TAG: Final = 31


class _Baseline:
    """A policy without an image, notes or anything to release."""

    privileged = False
    needs_image = False

    def reset(self, episode: Episode, instruction: str, world: EpisodeWorld | None, seed: int) -> None:
        """Do nothing."""

    def notes(self) -> Mapping[str, object]:
        """Return nothing."""
        return {}

    def close(self) -> None:
        """Release nothing."""


class StillPolicy(_Baseline):
    """Policy that never moves; it measures the collision rate caused by the crowd alone."""

    name = "still"

    def act(self, observation: Observation) -> Velocity:
        """Return zero velocity."""
        return (0.0, 0.0, 0.0)


class RandomPolicy(_Baseline):
    """Policy that walks randomly in velocity space (Ornstein-Uhlenbeck), never backwards, at about 0.5 m/s."""

    name = "random"

    _FORWARD: Final = (0.5, 0.25, 4.0)  # mean m/s, standard deviation, correlation s
    _TURN: Final = (0.0, 0.5, 2.0)  # mean rad/s, standard deviation, correlation s

    def __init__(self) -> None:
        self._rng = np.random.default_rng((0, _TAG))
        self._v, self._w = 0.0, 0.0

    def reset(self, episode: Episode, instruction: str, world: EpisodeWorld | None, seed: int) -> None:
        """Begin a new walk, seeded by run and episode."""
        self._rng = np.random.default_rng((seed, episode.seed, _TAG))
        self._v, self._w = 0.0, 0.0

    def act(self, observation: Observation) -> Velocity:
        """Return the next velocity of the walk."""
        self._v = self._drifted(self._v, *self._FORWARD)
        self._w = self._drifted(self._w, *self._TURN)
        return (min(max(self._v, 0.0), 1.0), 0.0, min(max(self._w, -1.0), 1.0))

    def _drifted(self, value: float, mean: float, sigma: float, correlation_s: float) -> float:
        keep = exp(-CONTROL_S / correlation_s)
        return mean + keep * (value - mean) + sigma * sqrt(1 - keep * keep) * float(self._rng.standard_normal())


class PointGoalPolicy(_Baseline):
    """Policy that knows only the goal's position by odometry: it turns to it, drives straight and stops on contact."""

    name = "point-goal"

    def __init__(self, speed_mps: float = 0.8) -> None:
        if not 0 < speed_mps <= 1.5:
            raise ValueError(f"point-goal: expected a speed of up to 1.5 m/s, found {speed_mps}")
        self._speed_mps = speed_mps
        self._goal = SE2(0.0, 0.0, 0.0)
        self._ahead: tuple[float, float] = (0.0, 0.0)

    def reset(self, episode: Episode, instruction: str, world: EpisodeWorld | None, seed: int) -> None:
        """Compute the goal relative to the start, where odometry begins."""
        self._goal = SE2(*episode.start).inverse() @ SE2(*episode.goal_xy, 0.0)

    def act(self, observation: Observation) -> Velocity:
        """Turn towards the goal; the forward speed grows as the heading error shrinks."""
        goal = observation.T_odom_base.inverse() @ self._goal
        self._ahead = (goal.x_m, goal.y_m)
        error = atan2(goal.y_m, goal.x_m)
        turn = min(max(1.5 * wrap_angle(error), -1.0), 1.0)
        if observation.touching:
            return (0.0, 0.0, turn)
        speed = self._speed_mps * max(cos(error), 0.0) ** 2
        return (min(speed, hypot(goal.x_m, goal.y_m)), 0.0, turn)

    def notes(self) -> Mapping[str, object]:
        """Return `waypoints`: the goal in the base frame, m."""
        return {"waypoints": [list(self._ahead)]}


def make_baseline(name: str) -> Policy:
    """Create one of the BASELINES. Raises ValueError for another name."""
    if name == "expert":
        # Imported here: the planner's libraries load slowly.
        from sim_hil.benchmark.policies.expert import ExpertPolicy

        return ExpertPolicy()
    kinds: dict[str, type[Policy]] = {"point-goal": PointGoalPolicy, "random": RandomPolicy, "still": StillPolicy}
    if name not in kinds:
        raise ValueError(f"policy: unknown baseline {name!r}, expected one of {', '.join(BASELINES)}")
    return kinds[name]()
