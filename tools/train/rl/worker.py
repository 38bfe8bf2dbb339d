"""A worker process of reinforcement learning: drives some scenarios with one policy and leaves a rollout file.

With `artifacts` the action expert is driven beside its asynchronous mind, without them a point-goal network.

`python -m tools.train.rl.worker`; a fresh process a job, so that physics begin fresh and a run resumes exactly.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from edge.artifacts.manifest import load_artifacts
from export.model.config_file import config_from_dict
from export.model.network import TicVla
from sim_hil.benchmark.conditions.latency import LatencyProfile, LatencySampler
from sim_hil.benchmark.policies.select import robot_config
from sim_hil.benchmark.workers.worker_process import worker_main
from sim_hil.processes.child_process import Message
from tools.train.config.scenes import TASKS_PER_SCENE
from tools.train.imitate.point_goal_net import PointGoalNet
from tools.train.rl import rollout
from tools.train.rl.action_tail import check_tail, load_tail
from tools.train.rl.command_policy import CommandLimits
from tools.train.rl.drive import DriveOptions, Pilot, drive_episode
from tools.train.rl.policies import PointGoalPilot, TailPilot
from tools.train.rl.virtual_time_reasoner import Models
from tools.train.run import checkpoint
from tools.train.run.network_file import read_network
from tools.train.scenes.scenarios import FIRST_SEED, Scenario, training_episodes

MODULE: Final = "tools.train.rl.worker"
_TAG, _CROWD, _DELAYS = 0x71, 0xC0, 0xDE


@dataclass(frozen=True)
class RolloutOrder:
    """Scenarios `numbers` of `scenario_seed`, driven with the weights of `policy`; the steps go to `out`.

    `network` are the weights before reinforcement learning, `model` their configuration, `policy` what is trained on
    top of them with its `log_std`, `artifacts` the exported encoder and language model (empty: a point-goal network is
    trained), `kinds` shares of scenes. `explore` False drives the mean. `delays`: reasoning times to draw from.
    `first`: place of the first of `numbers` among all that are driven with this `seed`; all that is random is of seed
    and place, so that a scenario that comes again is not the same episode again.
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
        """What `of_json` reads."""
        return {**asdict(self), "delays": self.delays.as_json()}

    @staticmethod
    def of_json(content: dict[str, Any]) -> RolloutOrder:
        """An order that `to_json` has written; raises TypeError, LatencyError."""
        made = {"numbers": tuple(content["numbers"]), "delays": LatencyProfile.of_json(content["delays"])}
        return RolloutOrder(**{**content, **made})


def messages(content: Message) -> Iterator[Message]:
    """Drive an order's scenarios; one message an episode, the file last."""
    torch.set_num_threads(1)
    order = RolloutOrder.of_json(content)
    limits = robot_config().limits
    network = read_network(Path(order.network), config_from_dict(order.model), order.network_seed).eval()
    tensors, meta = checkpoint.load(Path(order.policy))
    log_std = (float(meta["log_std"][0]), float(meta["log_std"][1])) if order.explore else None
    options = DriveOptions(network.config.vision.image_px, log_std, order.drift, order.max_s)
    pilots = _tail_pilots(order, network, tensors) if order.artifacts else _point_goal_pilots(network, tensors)
    driven = []
    for place, scenario in scenarios(order):
        rng = np.random.default_rng((order.seed, place, _TAG))
        driven.append(drive_episode(scenario, pilots(scenario, place), limits, options, rng))
        yield asdict(driven[-1][1])
    rollout.save(Path(order.out), driven)


def scenarios(order: RolloutOrder) -> Iterator[tuple[int, Scenario]]:
    """(place, scenario) of each episode. Exploring, each has a crowd and an odometry of its own.

    A scenario is drawn once however often it comes; neighbours, which share a layout, are drawn together.
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
    """The same task among other people: its episode's seed is of an order's seed and a place in it."""
    crowd = FIRST_SEED + int(np.random.default_rng((seed, place, _CROWD)).integers(2**40))
    return replace(scenario, episode=replace(scenario.episode, seed=crowd))


def delays(order: RolloutOrder, scenario: Scenario, place: int) -> LatencySampler:
    """Reasoning times of one episode."""
    seed = int(np.random.default_rng((order.seed, place, _DELAYS)).integers(2**40))
    return LatencySampler(order.delays, seed, scenario.episode.id)


PilotFor = Callable[[str], Pilot]


def _tail_pilots(
    order: RolloutOrder, network: TicVla, tensors: Mapping[str, torch.Tensor]
) -> Callable[[Scenario, int], PilotFor]:
    models, expert = Models(load_artifacts(Path(order.artifacts))), network.action
    check_tail(expert)
    load_tail(expert, tensors)

    def pilots(scenario: Scenario, place: int) -> PilotFor:
        draw = delays(order, scenario, place).draw
        return lambda instruction: TailPilot(models, expert, _bounds(), instruction, draw)

    return pilots


def _point_goal_pilots(network: TicVla, tensors: Mapping[str, torch.Tensor]) -> Callable[[Scenario, int], PilotFor]:
    net = PointGoalNet(network.config).eval()
    net.load_state_dict(dict(tensors))
    step_s = network.config.action.step_s
    return lambda scenario, place: lambda instruction: PointGoalPilot(network.vision, net, _bounds(), step_s)


def _bounds() -> CommandLimits:
    limits = robot_config().limits
    return CommandLimits(limits.vx_max_mps, limits.wz_max_radps)


if __name__ == "__main__":
    sys.exit(worker_main(f"python -m {MODULE}", messages))
