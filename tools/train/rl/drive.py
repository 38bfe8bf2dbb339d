"""One episode of Algorithm 2: a Gaussian around the policy's command, the paper's reward, every step kept."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final, Protocol

import numpy as np
import numpy.typing as npt

from edge.core.geometry import SE2
from edge.motion.controller import grown, scale_to_limits
from firmware_bridge.core.config import LimitsConfig
from sim_hil.benchmark.env.gym_env import DynaNavEnv
from sim_hil.benchmark.env.world import EpisodeWorld
from tools.train.rl.rollout import Chosen, EpisodeEnd, EpisodeSteps, goal_features
from tools.train.scenes.scenarios import Scenario

CONTROL_S: Final = 0.1
STUCK_S: Final = 15.0
STUCK_M: Final = 0.5
"""An episode is cut off when the robot has come no further than this in that time: nothing is learned from waiting."""

Floats = npt.NDArray[np.float32]


class Pilot(Protocol):
    """A policy that is trained, in one episode."""

    @property
    def semantic(self) -> Sequence[Floats]:
        """Semantic tokens [T, hidden] of each generation that was acted by."""
        ...

    @property
    def failure(self) -> str | None:
        """Why it cannot go on; None while it can."""
        ...

    def see(self, time_s: float, image: npt.NDArray[np.uint8], T_odom_base: SE2) -> Floats:
        """Begin a control period; the frame's visual tokens [1, N, D]."""
        ...

    def choose(
        self, visual: Floats, state: tuple[float, ...], goal_m: tuple[float, float], time_s: float, T_odom_base: SE2
    ) -> Chosen | None:
        """The command's mean; None while there is nothing to act by. `goal_m` is in the robot frame."""
        ...

    def think(self, time_s: float) -> None:
        """End the control period."""
        ...


@dataclass(frozen=True)
class DriveOptions:
    """`log_std` of the exploration, None: the mean is driven; `drift` of odometry, `max_s` of one episode."""

    image_px: int
    log_std: tuple[float, float] | None
    drift: str = "none"
    max_s: float = 120.0


def drive_episode(
    scenario: Scenario,
    pilot_for: Callable[[str], Pilot],
    limits: LimitsConfig,
    options: DriveOptions,
    rng: np.random.Generator,
) -> tuple[EpisodeSteps, EpisodeEnd]:
    """Drive one episode to its end with the pilot made for its instruction."""
    wording = int(rng.integers(len(scenario.wordings)))
    episode = replace(scenario.episode, timeout_s=min(scenario.episode.timeout_s, options.max_s))
    steps, wheel = EpisodeSteps(), _Wheel(limits)
    std = None if options.log_std is None else np.exp(np.asarray(options.log_std))
    env = DynaNavEnv(
        [episode], camera=(options.image_px,) * 2, drift=options.drift, scenes={episode.scene: scenario.scene}
    )
    try:
        _, info = env.reset(options={"episode": episode.id, "wording": wording})
        pilot = pilot_for(info["instruction"])
        places: deque[tuple[float, float]] = deque(maxlen=round(STUCK_S / CONTROL_S))
        total, cut, ended, timed_out = 0.0, "", False, False
        while not (ended or timed_out or cut):
            time_s, image, state, T_odom_base = _known(env.world)
            goal_m = _goal_m(env.world.pose(), episode.goal_xy)
            visual = pilot.see(time_s, image, T_odom_base)
            chosen = pilot.choose(visual, state, goal_m, time_s, T_odom_base)
            pilot.think(time_s)
            action = (0.0, 0.0) if chosen is None else _explored(chosen.mean, std, rng)
            scale = 1.0 if chosen is None else chosen.speed_scale
            _, reward, ended, timed_out, _ = env.step(np.array(wheel.turned(*action, scale), np.float32))
            total += reward
            if chosen is not None:
                steps.add(visual[0], state, goal_features(*goal_m), action, reward, chosen)
            here = env.world.pose()
            places.append((here.x_m, here.y_m))
            cut = "no-reasoning" if pilot.failure is not None else "stuck" if _is_stuck(places) else ""
        if not env.world.done:
            env.world.stop()
        time_s, image, steps.after_state, T_odom_base = _known(env.world)
        steps.after_visual = pilot.see(time_s, image, T_odom_base)[0]
        steps.after_goal = goal_features(*_goal_m(env.world.pose(), episode.goal_xy))
        steps.semantic = list(pilot.semantic)
        outcome = env.world.outcome()
    finally:
        env.close()
    end = EpisodeEnd(
        id=episode.id,
        kind=scenario.kind,
        people=episode.people,
        steps=len(steps),
        end=outcome.end if ended or timed_out else cut,
        terminal=bool(ended),
        success=outcome.success,
        collided=outcome.collided,
        reward=round(total, 6),
        spl=outcome.spl,
        time_s=outcome.time_s,
    )
    return steps, end


class _Wheel:
    """Within the robot's limits, speeding up no faster than they allow: what the runner's controller does."""

    def __init__(self, limits: LimitsConfig) -> None:
        self._limits = limits
        self._last = (0.0, 0.0)

    def turned(self, vx_mps: float, wz_radps: float, speed_scale: float = 1.0) -> tuple[float, float, float]:
        limits = self._limits
        vx_mps = min(max(vx_mps, 0.0), limits.vx_max_mps)
        wz_radps = min(max(wz_radps, -limits.wz_max_radps), limits.wz_max_radps)
        vx_mps, wz_radps = scale_to_limits(vx_mps, wz_radps, limits, speed_scale)
        vx_mps = grown(self._last[0], vx_mps, limits.accel_mps2 * CONTROL_S)
        wz_radps = grown(self._last[1], wz_radps, limits.alpha_radps2 * CONTROL_S)
        self._last = (vx_mps, wz_radps)
        return (vx_mps, 0.0, wz_radps)


def _explored(
    mean: tuple[float, float], std: npt.NDArray[np.float64] | None, rng: np.random.Generator
) -> tuple[float, float]:
    if std is None:
        return mean
    noise = std * rng.standard_normal(2)
    return (mean[0] + float(noise[0]), mean[1] + float(noise[1]))


def _known(world: EpisodeWorld) -> tuple[float, npt.NDArray[np.uint8], tuple[float, ...], SE2]:
    """Time, s, picture, body velocity and odometry pose now.

    Of the world, as in the benchmark: the environment's are float32, whose rounding releases answers a tick late.
    """
    seen = world.observe()
    assert seen.image is not None  # the environment was asked for one
    return seen.time_s, seen.image, seen.state, seen.T_odom_base


def _goal_m(pose: SE2, goal_xy: tuple[float, float]) -> tuple[float, float]:
    there = pose.inverse() @ SE2(goal_xy[0], goal_xy[1], 0.0)
    return (there.x_m, there.y_m)


def _is_stuck(places: deque[tuple[float, float]]) -> bool:
    if places.maxlen is None or len(places) < places.maxlen:
        return False
    xy = np.array(places)
    return float(np.hypot(*(xy - xy[-1]).T).max()) < STUCK_M
