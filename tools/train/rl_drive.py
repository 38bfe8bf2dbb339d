"""One episode of Algorithm 2: delayed semantics, a Gaussian around the trajectory's command, the paper's reward."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch

from edge.controller import grown
from edge.geometry import SE2
from export.model.action import ActionExpert
from firmware_bridge.config import LimitsConfig
from sim_hil.benchmark.gym_env import DynaNavEnv
from sim_hil.benchmark.latency import Timing
from tools.train.action_tail import now_of, prefix, semantic_of, tail
from tools.train.async_mind import AsyncMind, Models
from tools.train.command_policy import CommandLimits, command_mean
from tools.train.rollout import EpisodeEnd, EpisodeSteps, goal_features
from tools.train.scenarios import Scenario

CONTROL_S: Final = 0.1
STUCK_S: Final = 15.0
STUCK_M: Final = 0.5
"""An episode is cut off when the robot has come no further than this in that time: nothing is learned from waiting."""


@dataclass(frozen=True)
class DriveOptions:
    """`log_std` of the exploration, None: the mean is driven; `drift` of odometry, `max_s` of one episode."""

    log_std: tuple[float, float] | None
    drift: str = "none"
    max_s: float = 120.0


def drive_episode(
    scenario: Scenario,
    models: Models,
    expert: ActionExpert,
    limits: LimitsConfig,
    options: DriveOptions,
    draw: Callable[[], Timing],
    rng: np.random.Generator,
) -> tuple[EpisodeSteps, EpisodeEnd]:
    """Drive one episode to its end; `expert` is in evaluation mode, on the CPU."""
    image_px = models.artifacts.runtime.image_px
    wording = int(rng.integers(len(scenario.wordings)))
    episode = replace(scenario.episode, timeout_s=min(scenario.episode.timeout_s, options.max_s))
    steps = EpisodeSteps()
    env = DynaNavEnv(
        [episode], camera=(image_px, image_px), drift=options.drift, scenes={episode.scene: scenario.scene}
    )
    try:
        seen, info = env.reset(options={"episode": episode.id, "wording": wording})
        mind = AsyncMind(models, info["instruction"], draw)
        actor = _Actor(expert, limits, models.artifacts.runtime.step_s, options.log_std, rng)
        places: deque[tuple[float, float]] = deque(maxlen=round(STUCK_S / CONTROL_S))
        total, cut = 0.0, ""
        while True:
            time_s, state = float(seen["time"][0]), tuple(float(v) for v in seen["state"])
            T_odom_base = SE2(*(float(v) for v in seen["pose"]))
            visual = mind.see(time_s, seen["image"], T_odom_base)
            metadata = mind.metadata(time_s, T_odom_base)
            pose = env.world.pose()
            goal = _goal(pose, episode.goal_xy)
            acted = actor.act(mind, visual, state, metadata)
            mind.think(time_s)
            if acted.queries is not None:
                steps.visual.append(visual[0])
                steps.queries.append(acted.queries)
                steps.state.append(state)
                steps.latency.append(metadata)
                steps.goal.append(goal)
                steps.action.append(acted.action)
                steps.generation.append(actor.generations - 1)
            seen, reward, ended, timed_out, info = env.step(np.array([acted.vx_mps, 0.0, acted.wz_radps], np.float32))
            total += reward
            if acted.queries is not None:
                steps.reward.append(reward)
            here = env.world.pose()
            places.append((here.x_m, here.y_m))
            if not ended and _is_stuck(places):
                cut = "stuck"
            if mind.failure is not None:
                cut = "no-reasoning"
            if ended or timed_out or cut:
                break
        if cut:
            env.world.stop()
        steps.semantic = actor.semantic
        steps.after_visual = models.encode(seen["image"], None)[0]
        steps.after_state = tuple(float(v) for v in seen["state"])
        steps.after_goal = _goal(env.world.pose(), episode.goal_xy)
        outcome = env.world.outcome()
    finally:
        env.close()
    end = EpisodeEnd(
        id=episode.id,
        kind=scenario.kind,
        people=episode.people,
        steps=len(steps),
        end=cut or outcome.end,
        terminal=bool(ended),
        success=outcome.success,
        collided=outcome.collided,
        reward=round(total, 6),
        spl=outcome.spl,
        time_s=outcome.time_s,
    )
    return steps, end


@dataclass(frozen=True)
class _Acted:
    vx_mps: float
    wz_radps: float
    action: tuple[float, float] = (0.0, 0.0)
    queries: np.ndarray | None = None


class _Actor:
    """The action expert for one robot at a time; remembers the generation whose tokens it has projected."""

    def __init__(
        self,
        expert: ActionExpert,
        limits: LimitsConfig,
        step_s: float,
        log_std: tuple[float, float] | None,
        rng: np.random.Generator,
    ) -> None:
        self._expert, self._limits, self._step_s, self._rng = expert, limits, step_s, rng
        self._bounds = CommandLimits(limits.vx_max_mps, limits.wz_max_radps)
        self._std = None if log_std is None else np.exp(np.asarray(log_std))
        self._number: int | None = None
        self._tokens = torch.empty(0)
        self._last = (0.0, 0.0)
        self.semantic: list[np.ndarray] = []

    @property
    def generations(self) -> int:
        """How many have been acted by."""
        return len(self.semantic)

    def act(
        self,
        mind: AsyncMind,
        visual: np.ndarray,
        state: tuple[float, ...],
        metadata: tuple[float, float, float, float],
    ) -> _Acted:
        semantic = mind.semantic
        if semantic is None:
            return self._driven(0.0, 0.0)
        if semantic.generation != self._number:
            self._number = semantic.generation
            self._tokens = semantic_of(self._expert, torch.from_numpy(semantic.last_layer_kv))
            self.semantic.append(self._tokens[0].numpy().copy())
        with torch.no_grad():
            now = now_of(self._expert, torch.from_numpy(visual), torch.tensor([state]), torch.tensor([metadata]))
            x = prefix(self._expert, now, self._tokens)
            mean = command_mean(tail(self._expert, x, now, self._tokens), self._step_s, self._bounds)[0].numpy()
        action = mean.astype(np.float64)
        if self._std is not None:
            action = action + self._std * self._rng.standard_normal(2)
        driven = self._driven(float(action[0]), float(action[1]))
        return replace(driven, action=(float(action[0]), float(action[1])), queries=x[0].numpy().copy())

    def _driven(self, vx_mps: float, wz_radps: float) -> _Acted:
        """Within the robot's limits, speeding up no faster than they allow: what the runner's controller does."""
        limits = self._limits
        vx_mps = min(max(vx_mps, 0.0), limits.vx_max_mps)
        wz_radps = min(max(wz_radps, -limits.wz_max_radps), limits.wz_max_radps)
        vx_mps = grown(self._last[0], vx_mps, limits.accel_mps2 * CONTROL_S)
        wz_radps = grown(self._last[1], wz_radps, limits.alpha_radps2 * CONTROL_S)
        self._last = (vx_mps, wz_radps)
        return _Acted(vx_mps, wz_radps)


def _goal(pose: SE2, goal_xy: tuple[float, float]) -> tuple[float, float]:
    there = pose.inverse() @ SE2(goal_xy[0], goal_xy[1], 0.0)
    return goal_features(there.x_m, there.y_m)


def _is_stuck(places: deque[tuple[float, float]]) -> bool:
    if places.maxlen is None or len(places) < places.maxlen:
        return False
    xy = np.array(places)
    return float(np.hypot(*(xy - xy[-1]).T).max()) < STUCK_M
