"""A worker process of reinforcement learning: drives some scenarios with one policy and leaves a rollout file.

With `artifacts` the action expert is driven beside its asynchronous mind, without them a point-goal network.

`python -m tools.train.rl_worker`; a fresh process a job, so that physics begin fresh and a run resumes exactly.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from edge.manifest import load_artifacts
from export.model.config_file import config_from_dict
from export.model.network import TicVla
from sim_hil.benchmark.latency import LatencyProfile, LatencySampler
from sim_hil.benchmark.policies import robot_config
from tools.train import checkpoint, rollout
from tools.train.action_tail import check_tail, load_tail
from tools.train.async_mind import Models
from tools.train.command_policy import CommandLimits
from tools.train.network_file import read_network
from tools.train.point_goal_net import PointGoalNet
from tools.train.rl_drive import DriveOptions, Pilot, drive_episode
from tools.train.rl_pilots import PointGoalPilot, TailPilot
from tools.train.scenarios import Scenario, training_episodes
from tools.train.workers import Message, worker_main

MODULE: Final = "tools.train.rl_worker"
_TAG: Final = 0x71


@dataclass(frozen=True)
class RolloutOrder:
    """Scenarios `numbers` of `scenario_seed`, driven with the weights of `policy`; the steps go to `out`.

    `network` are the weights before reinforcement learning, `model` their configuration, `policy` what is trained on
    top of them with its `log_std`, `artifacts` the exported encoder and language model (empty: a point-goal network is
    trained), `kinds` shares of scenes. `explore` False drives the mean. `generation_s`: reasoning times to draw from.
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
    generation_s: tuple[float, ...]
    explore: bool
    drift: str
    max_s: float
    seed: int

    def to_json(self) -> dict[str, Any]:
        """What `of_json` reads."""
        return asdict(self)

    @staticmethod
    def of_json(content: dict[str, Any]) -> RolloutOrder:
        """An order that `to_json` has written; raises TypeError."""
        tuples = {key: tuple(content[key]) for key in ("numbers", "generation_s")}
        return RolloutOrder(**{**content, **tuples})


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
    for number, scenario in zip(order.numbers, _scenarios(order), strict=True):
        rng = np.random.default_rng((order.seed, number, _TAG))
        driven.append(drive_episode(scenario, pilots(scenario, number), limits, options, rng))
        yield asdict(driven[-1][1])
    rollout.save(Path(order.out), driven)


PilotFor = Callable[[str], Pilot]


def _tail_pilots(
    order: RolloutOrder, network: TicVla, tensors: Mapping[str, torch.Tensor]
) -> Callable[[Scenario, int], PilotFor]:
    models, expert = Models(load_artifacts(Path(order.artifacts))), network.action
    check_tail(expert)
    load_tail(expert, tensors)
    profile = LatencyProfile("training", "drawn", order.generation_s)

    def pilots(scenario: Scenario, number: int) -> PilotFor:
        draw = LatencySampler(profile, order.seed + number, scenario.episode.id).draw
        return lambda instruction: TailPilot(models, expert, _bounds(), instruction, draw)

    return pilots


def _point_goal_pilots(network: TicVla, tensors: Mapping[str, torch.Tensor]) -> Callable[[Scenario, int], PilotFor]:
    net = PointGoalNet(network.config).eval()
    net.load_state_dict(dict(tensors))
    step_s = network.config.action.step_s
    return lambda scenario, number: lambda instruction: PointGoalPilot(network.vision, net, _bounds(), step_s)


def _bounds() -> CommandLimits:
    limits = robot_config().limits
    return CommandLimits(limits.vx_max_mps, limits.wz_max_radps)


def _scenarios(order: RolloutOrder) -> Iterator[Scenario]:
    """Neighbours are drawn together: they share a layout."""
    first, count = order.numbers[0], len(order.numbers)
    if order.numbers == tuple(range(first, first + count)):
        yield from training_episodes(order.scenario_seed, count, order.kinds, start=first)
        return
    for number in order.numbers:
        yield from training_episodes(order.scenario_seed, 1, order.kinds, start=number)


if __name__ == "__main__":
    sys.exit(worker_main(f"python -m {MODULE}", messages))
