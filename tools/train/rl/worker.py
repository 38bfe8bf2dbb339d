"""The worker process of reinforcement learning: drives episodes with one policy and writes a rollout file.

An episode is Algorithm 2: actions drawn from a Gaussian around the policy's command, the paper's reward, every step
recorded. With `artifacts` the policy is the action expert with asynchronous reasoning, without them a point-goal
network.

Run as `python -m tools.train.rl.worker`. Each job has a new process, so that physics starts anew and a run resumes
exactly.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch

from edge.artifacts.manifest import load_artifacts
from edge.core.geometry import SE2
from edge.motion.controller import grown, scale_to_limits
from export.model.config import config_from_dict
from export.model.network import TicVla
from firmware_bridge.core.config import LimitsConfig
from sim_hil.benchmark.conditions.latency import LatencyProfile, LatencySampler
from sim_hil.benchmark.env.gym_env import DynaNavEnv
from sim_hil.benchmark.env.world import EpisodeWorld
from sim_hil.benchmark.policies.select import robot_config
from sim_hil.benchmark.workers.worker_pool import WorkerJob, Workers
from sim_hil.benchmark.workers.worker_process import worker_main
from sim_hil.processes.child_process import Message
from tools.train.config.collect import TASKS_PER_SCENE
from tools.train.drives.scenarios import FIRST_SEED, Scenario, training_episodes
from tools.train.imitate.trainable_policies import PointGoalNet
from tools.train.rl import rollout
from tools.train.rl.policies import (
    CommandLimits,
    Models,
    PointGoalRolloutPolicy,
    RolloutPolicy,
    TailPolicy,
    check_tail,
    load_tail,
)
from tools.train.rl.rollout import EpisodeEnd, EpisodeSteps, Rollout, goal_features, read
from tools.train.run.job import StageFailedError
from tools.train.run.loop import load_checkpoint
from tools.train.run.network_file import read_network

MODULE: Final = "tools.train.rl.worker"
_TAG, _CROWD, _DELAYS = 0x71, 0xC0, 0xDE

CONTROL_S: Final = 0.1
"""Control period, s."""
STUCK_S: Final = 15.0
STUCK_M: Final = 0.5
"""The episode is cut off if the robot moves less than STUCK_M in STUCK_S: waiting teaches nothing."""


@dataclass(frozen=True)
class RolloutOrder:
    """Job of a worker: drive scenarios `numbers` of `scenario_seed` with the weights `policy`, write steps to `out`.

    `network`: weights before reinforcement learning; `model`: their configuration; `policy`: trained weights on top of
    them, with `log_std`; `artifacts`: exported encoder and language model (empty: a point-goal network is trained);
    `kinds`: shares of scenes; `explore`: False drives the mean; `delays`: latencies to draw from. `first`: position of
    the first of `numbers` among all episodes of this `seed`. Every random number depends on seed and position, so that
    a repeated scenario is another episode.
    """

    artifacts: str
    network: str
    model: dict[str, Any]
    network_seed: int
    policy: str
    out: str
    scenario_seed: int
    numbers: tuple[int, ...]
    kinds: dict[str, float]
    delays: LatencyProfile
    explore: bool
    drift: str
    max_s: float
    seed: int
    first: int = 0
    tasks_per_scene: int = TASKS_PER_SCENE

    def to_json(self) -> dict[str, object]:
        """Return the content that `of_json` reads."""
        return {**asdict(self), "delays": self.delays.as_json()}

    @staticmethod
    def of_json(content: dict[str, Any]) -> RolloutOrder:
        """Build the order that `to_json` wrote. Raises TypeError, LatencyError."""
        made = {"numbers": tuple(content["numbers"]), "delays": LatencyProfile.of_json(content["delays"])}
        return RolloutOrder(**{**content, **made})


def messages(content: Message) -> Iterator[Message]:
    """Drive an order's scenarios, yield one message per episode, then write the rollout file."""
    torch.set_num_threads(1)
    order = RolloutOrder.of_json(content)
    limits = robot_config().limits
    network = read_network(Path(order.network), config_from_dict(order.model), order.network_seed).eval()
    tensors, meta = load_checkpoint(Path(order.policy))
    log_std = (float(meta["log_std"][0]), float(meta["log_std"][1])) if order.explore else None
    options = DriveOptions(network.config.vision.image_px, log_std, order.drift, order.max_s)
    policies = _tail_policies(order, network, tensors) if order.artifacts else _point_goal_policies(network, tensors)
    driven = []
    for place, scenario in scenarios(order):
        rng = np.random.default_rng((order.seed, place, _TAG))
        driven.append(drive_episode(scenario, policies(scenario, place), limits, options, rng))
        yield asdict(driven[-1][1])
    rollout.save(Path(order.out), driven)


def scenarios(order: RolloutOrder) -> Iterator[tuple[int, Scenario]]:
    """Yield (position, scenario) of each episode; when exploring, each has its own crowd and odometry noise.

    A repeated scenario is generated once; consecutive numbers, which share a layout, are generated together.
    """
    drawn: dict[int, Scenario] = {}
    for place, number in enumerate(order.numbers, order.first):
        if number not in drawn:
            count = 1
            while number + count in order.numbers:
                count += 1
            made = training_episodes(
                order.scenario_seed, count, order.kinds, start=number, tasks_per_scene=order.tasks_per_scene
            )
            drawn |= dict(enumerate(made, number))
        scenario = drawn[number]
        yield place, crowded(scenario, order.seed, place) if order.explore else scenario


def crowded(scenario: Scenario, seed: int, place: int) -> Scenario:
    """Replace the seed of a scenario's crowd by one drawn from the order's seed and the position in it."""
    crowd = FIRST_SEED + int(np.random.default_rng((seed, place, _CROWD)).integers(2**40))
    return replace(scenario, episode=replace(scenario.episode, seed=crowd))


def delays(order: RolloutOrder, scenario: Scenario, place: int) -> LatencySampler:
    """Return the sampler of one episode's latencies."""
    seed = int(np.random.default_rng((order.seed, place, _DELAYS)).integers(2**40))
    return LatencySampler(order.delays, seed, scenario.episode.id)


PolicyFor = Callable[[str], RolloutPolicy]
"""Makes a policy for an instruction."""


def _tail_policies(
    order: RolloutOrder, network: TicVla, tensors: Mapping[str, torch.Tensor]
) -> Callable[[Scenario, int], PolicyFor]:
    models, expert = Models(load_artifacts(Path(order.artifacts))), network.action
    check_tail(expert)
    load_tail(expert, tensors)

    def policies(scenario: Scenario, place: int) -> PolicyFor:
        draw = delays(order, scenario, place).draw
        return lambda instruction: TailPolicy(models, expert, _bounds(), instruction, draw)

    return policies


def _point_goal_policies(network: TicVla, tensors: Mapping[str, torch.Tensor]) -> Callable[[Scenario, int], PolicyFor]:
    net = PointGoalNet(network.config).eval()
    net.load_state_dict(dict(tensors))
    step_s = network.config.action.step_s
    return lambda scenario, place: lambda instruction: PointGoalRolloutPolicy(network.vision, net, _bounds(), step_s)


def _bounds() -> CommandLimits:
    limits = robot_config().limits
    return CommandLimits(limits.vx_max_mps, limits.wz_max_radps)


# One episode


@dataclass(frozen=True)
class DriveOptions:
    """Settings of driven episodes.

    `log_std` of the exploration, None to drive the mean; `drift`: name of the odometry drift; `max_s`: timeout, s.
    """

    image_px: int
    log_std: tuple[float, float] | None
    drift: str = "none"
    max_s: float = 120.0


def drive_episode(
    scenario: Scenario,
    policy_for: PolicyFor,
    limits: LimitsConfig,
    options: DriveOptions,
    rng: np.random.Generator,
) -> tuple[EpisodeSteps, EpisodeEnd]:
    """Drive one episode to its end with a policy made for one of its instructions; return its steps and outcome."""
    wording = int(rng.integers(len(scenario.wordings)))
    episode = replace(scenario.episode, timeout_s=min(scenario.episode.timeout_s, options.max_s))
    steps, limiter = EpisodeSteps(), CommandLimiter(limits)
    std = None if options.log_std is None else np.exp(np.asarray(options.log_std))
    env = DynaNavEnv(
        [episode], camera=(options.image_px,) * 2, drift=options.drift, scenes={episode.scene: scenario.scene}
    )
    try:
        _, info = env.reset(options={"episode": episode.id, "wording": wording})
        policy = policy_for(info["instruction"])
        recent_xy: deque[tuple[float, float]] = deque(maxlen=round(STUCK_S / CONTROL_S))
        total, cut, ended, timed_out = 0.0, "", False, False
        while not (ended or timed_out or cut):
            time_s, image, state, T_odom_base = _observation(env.world)
            goal_m = _goal_m(env.world.pose(), episode.goal_xy)
            visual = policy.observe(time_s, image, T_odom_base)
            chosen = policy.choose(visual, state, goal_m, time_s, T_odom_base)
            policy.start_generation(time_s)
            action = (0.0, 0.0) if chosen is None else _explored(chosen.mean, std, rng)
            scale = 1.0 if chosen is None else chosen.speed_scale
            _, reward, ended, timed_out, _ = env.step(np.array(limiter.limit(*action, scale), np.float32))
            total += reward
            if chosen is not None:
                goal = goal_features(*goal_m)
                steps.add(chosen, visual=visual[0], state=state, goal=goal, action=action, reward=reward)
            here = env.world.pose()
            recent_xy.append((here.x_m, here.y_m))
            cut = "no-reasoning" if policy.failure is not None else "stuck" if _is_stuck(recent_xy) else ""
        if not env.world.done:
            env.world.stop()
        time_s, image, state, T_odom_base = _observation(env.world)
        goal = goal_features(*_goal_m(env.world.pose(), episode.goal_xy))
        steps.after = {"visual": policy.observe(time_s, image, T_odom_base)[0], "state": state, "goal": goal}
        steps.semantic = list(policy.semantic)
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


class CommandLimiter:
    """Velocity and acceleration limits on commands, as in the runner's controller; remembers the last command."""

    def __init__(self, limits: LimitsConfig) -> None:
        self._limits = limits
        self._last = (0.0, 0.0)

    def limit(self, vx_mps: float, wz_radps: float, speed_scale: float = 1.0) -> tuple[float, float, float]:
        """Return (vx m/s, 0, wz rad/s) within the limits times `speed_scale`, never backwards."""
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


def _observation(world: EpisodeWorld) -> tuple[float, npt.NDArray[np.uint8], tuple[float, ...], SE2]:
    """Return time (s), image, body velocity and odometry pose now.

    Read from the world, as in the benchmark: the environment's float32 times would release generations a tick late.
    """
    now = world.observe()
    assert now.image is not None  # the environment was made with a camera
    return now.time_s, now.image, now.state, now.T_odom_base


def _goal_m(pose: SE2, goal_xy: tuple[float, float]) -> tuple[float, float]:
    there = pose.inverse() @ SE2(goal_xy[0], goal_xy[1], 0.0)
    return (there.x_m, there.y_m)


def _is_stuck(recent_xy: deque[tuple[float, float]]) -> bool:
    if recent_xy.maxlen is None or len(recent_xy) < recent_xy.maxlen:
        return False
    xy = np.array(recent_xy)
    return float(np.hypot(*(xy - xy[-1]).T).max()) < STUCK_M


COMMAND: Final[Sequence[str]] = (sys.executable, "-m", MODULE)


def split(order: RolloutOrder, per_job: int) -> list[RolloutOrder]:
    """Split an order into orders of at most `per_job` episodes, each with its own file below `order.out`.

    Each part keeps the position of its episodes in the whole order, so that every episode has its own random seed.
    """
    return [
        replace(
            order,
            numbers=order.numbers[first : first + per_job],
            first=order.first + first,
            out=str(Path(order.out) / f"{first // per_job:03d}.safetensors"),
        )
        for first in range(0, len(order.numbers), per_job)
    ]


def drive(
    order: RolloutOrder,
    *,
    jobs: int,
    per_job: int,
    finished: Callable[[bool], None] = lambda success: None,
    stopped: Callable[[], bool] = lambda: False,
    command: Sequence[str] = COMMAND,
) -> Rollout:
    """Drive an order's episodes; files of jobs that have finished before are reused.

    `finished` takes for each episode whether it succeeded. The number of jobs does not change the result. Raises
    StageFailedError, KeyboardInterrupt when `stopped`.
    """
    folder = Path(order.out)
    folder.mkdir(parents=True, exist_ok=True)
    orders = split(order, per_job)
    missing = [part for part in orders if not Path(part.out).is_file()]
    waiting = deque(
        WorkerJob(Path(part.out).stem, part.to_json(), Path(part.out).with_suffix(".log")) for part in missing
    )
    with Workers(command, jobs) as workers:
        for event in chain.from_iterable(workers.run(waiting, stopped)):
            if event.message is not None:
                finished(bool(event.message["success"]))
            elif event.failure:
                raise StageFailedError(f"rollout {event.key}: {event.failure}")
    return read([Path(part.out) for part in orders])


if __name__ == "__main__":
    sys.exit(worker_main(f"python -m {MODULE}", messages))
