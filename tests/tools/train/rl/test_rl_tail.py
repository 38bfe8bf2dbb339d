"""Only the end of the action expert is trained, with the same commands as the whole; and the arithmetic of PPO."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from edge.core.geometry import SE2
from edge.motion.controller import arc_to, scale_to_limits
from export.model.config import TicVlaConfig
from export.model.network import TicVla, build
from firmware_bridge.core.config import LimitsConfig
from sim_hil.benchmark.policies.select import robot_config
from tests.support.train.train_drives import tiny_model
from tools.train.config.checks import TrainError
from tools.train.config.rl import PpoConfig
from tools.train.rl import rollout
from tools.train.rl.policies import (
    CommandLimits,
    check_tail,
    command_mean,
    entropy,
    load_tail,
    log_prob,
    now_of,
    prefix,
    semantic_of,
    tail,
    tail_parameters,
    within_limits,
)
from tools.train.rl.ppo import PpoOptimiser, PpoStats, TailLearner, advantages
from tools.train.rl.rollout import EpisodeEnd, EpisodeSteps, PolicyOutput

LIMITS = CommandLimits(1.0, 1.0)


pytestmark = pytest.mark.usefixtures("one_thread")


def tiny_config() -> TicVlaConfig:
    tiny = tiny_model()
    return dataclasses.replace(tiny, action=dataclasses.replace(tiny.action, layers=3))


def tiny_network(seed: int = 0) -> TicVla:
    network = build(tiny_config(), seed).eval()
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():  # away from a head that says the same whatever it sees
        network.action.out.weight.normal_(0.0, 0.05, generator=generator)
    return network


def _random(*shape: int, seed: int = 1) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def _whole(network: TicVla, visual: torch.Tensor, state: torch.Tensor, latency: torch.Tensor, kv: torch.Tensor):
    with torch.no_grad():
        return network.action(visual, state, latency, *network.action.context(kv))


def test_prefix_and_tail_are_the_whole_expert() -> None:
    network = tiny_network()
    c = network.config
    visual, kv = _random(1, c.vision.tokens, c.vision.token_dim), _random(1, 11, c.kv_dim, seed=2)
    state, latency = _random(1, 3, seed=3), _random(1, 4, seed=4)
    expert = network.action
    now, semantic = now_of(expert, visual, state, latency), semantic_of(expert, kv)
    with torch.no_grad():
        found = tail(expert, prefix(expert, now, semantic), now, semantic)
    assert torch.allclose(found, _whole(network, visual, state, latency, kv), atol=1e-5)


def test_another_networks_tail_is_refused() -> None:
    network = tiny_network()
    tensors = {name: each.detach().clone() for name, each in tail_parameters(network.action).items()}
    load_tail(network.action, tensors)
    tensors.pop("out.bias")
    with pytest.raises(TrainError, match=r"out\.bias is missing"):
        load_tail(network.action, tensors)


def test_an_expert_guided_by_waypoints_is_refused() -> None:
    tiny = tiny_config()
    config = dataclasses.replace(tiny, action=dataclasses.replace(tiny.action, semantic_interface="waypoints"))
    with pytest.raises(TrainError, match="waypoints"):
        check_tail(build(config, 0).action)


def tiny_episode(network: TicVla, steps: int, seed: int, *, reward: float = 0.1) -> tuple[EpisodeSteps, EpisodeEnd]:
    """Made-up steps whose frozen parts are the network's own; two generations of different lengths."""
    c, expert = network.config, network.action
    kept = EpisodeSteps()
    kept.semantic = [
        semantic_of(expert, _random(1, length, c.kv_dim, seed=seed + length))[0].numpy() for length in (4, 7)
    ]
    for step in range(steps):
        visual = _random(1, c.vision.tokens, c.vision.token_dim, seed=1000 * seed + step)
        state, latency, number = (0.5, 0.0, 0.1), (1.0, 0.2, 0.0, 0.1), int(step >= steps // 2)
        now = now_of(expert, visual, torch.tensor([state]), torch.tensor([latency]))
        queries = prefix(expert, now, torch.from_numpy(kept.semantic[number])[None])[0].numpy()
        chosen = PolicyOutput((0.0, 0.0), queries, latency, number)
        tokens, action = visual[0].numpy(), (0.4, 0.05 * step)
        kept.add(chosen, visual=tokens, state=state, goal=(0.5, 0.1), action=action, reward=reward * step)
    kept.after = {"visual": tokens, "state": (0.0, 0.0, 0.0), "goal": (0.0, 0.0)}
    end = EpisodeEnd(f"e{seed}", "office", 0, steps, "timeout", False, False, False, 1.0, 0.0, 0.1 * steps)
    return kept, end


def _rollout(network: TicVla, folder: Path) -> rollout.Rollout:
    empty = EpisodeSteps(), EpisodeEnd("none", "office", 0, 0, "stuck", False, False, False, 0.0, 0.0, 15.0)
    rollout.save(folder / "0.safetensors", [tiny_episode(network, 6, 1), empty])
    rollout.save(folder / "1.safetensors", [tiny_episode(network, 4, 2)])
    return rollout.read([folder / "0.safetensors", folder / "1.safetensors"])


def test_a_rollout_is_read_as_it_was_driven(tmp_path: Path) -> None:
    network = tiny_network()
    found = _rollout(network, tmp_path)
    assert [end.id for end in found.ends] == ["e1", "none", "e2"]
    assert [(steps.start, steps.stop, number) for steps, number, _ in found.episodes()] == [(0, 6, 0), (6, 10, 1)]
    assert found.arrays["generation"].tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 3, 3]
    assert [len(each) for each in found.semantic] == [4, 7, 4, 7]
    assert np.array_equal(found.arrays["visual"][6], tiny_episode(network, 4, 2)[0].rows["visual"][0])


def test_a_torn_rollout_is_named(tmp_path: Path) -> None:
    path = tmp_path / "0.safetensors"
    path.write_bytes(b"half")
    with pytest.raises(TrainError, match="not readable"):
        rollout.read([path])


def test_the_learner_commands_what_the_whole_expert_would(tmp_path: Path) -> None:
    network = tiny_network()
    learner = TailLearner(network, LIMITS, (-1.0, -1.0))
    found = _rollout(network, tmp_path)
    learner.take(found)
    rows = torch.tensor([0, 5, 9])
    t = {name: torch.from_numpy(array)[rows] for name, array in found.arrays.items() if len(array) == found.steps}
    expert = network.action
    for i, row in enumerate(rows.tolist()):
        semantic = torch.from_numpy(found.semantic[int(found.arrays["generation"][row])])[None]
        now = now_of(expert, t["visual"][i : i + 1], t["state"][i : i + 1], t["latency"][i : i + 1])
        with torch.no_grad():
            whole = tail(expert, prefix(expert, now, semantic), now, semantic)
            wanted = command_mean(whole, 0.1, LIMITS)
            assert torch.allclose(within_limits(learner.arcs(rows), LIMITS)[i], wanted[0], atol=1e-5)


@pytest.mark.slow
def test_an_update_moves_the_tail_and_the_value_and_nothing_else(tmp_path: Path) -> None:
    network = tiny_network()
    before = {name: each.detach().clone() for name, each in network.named_parameters()}
    learner = TailLearner(network, LIMITS, (-1.0, -1.0))
    learner.take(_rollout(network, tmp_path))
    advantages, returns = learner.estimates(gamma=0.99, lam=0.95, reward_scale=1.0)
    config = PpoConfig(batch=5, epochs=2, action_lr=1e-3)
    generator = torch.Generator().manual_seed(0)
    PpoOptimiser(learner, config).update(learner, advantages, returns, generator)
    moved = {name for name, each in network.named_parameters() if not torch.equal(each, before[name])}
    trained = {f"action.{name}" for name in tail_parameters(network.action)}
    assert moved <= trained | {name for name in before if name.startswith("value.")}
    assert {"action.out.weight", "value.head.0.weight"} <= moved


def test_a_plan_that_leaves_beyond_the_limits_pays_though_its_command_is_the_same(tmp_path: Path) -> None:
    network = tiny_network()
    with torch.no_grad():  # straight ahead, faster than the robot can
        network.action.out.weight.zero_()
        network.action.out.bias.copy_(torch.tensor([0.3, 0.0, 0.0]).repeat(len(network.action.out.bias) // 3))
    learner = TailLearner(network, LIMITS, (-1.0, -1.0), imitation=1.0)
    learner.take(_rollout(network, tmp_path))
    rows = torch.arange(4)
    with torch.no_grad():
        before, asked = within_limits(learner.arcs(rows), LIMITS), learner.arcs(rows)
        assert float(asked[:, 0].min()) > LIMITS.vx_max_mps
        network.action.out.bias *= 2.0
        assert torch.allclose(within_limits(learner.arcs(rows), LIMITS), before, atol=1e-5)
    assert float(learner.act(rows)[2].detach()) > 0.0


def test_advantages_are_those_worked_out_by_hand() -> None:
    rewards, values = np.array([1.0, 0.0, 2.0]), np.array([0.5, 1.0, 1.5])
    found, returns = advantages(rewards, values, 3.0, terminal=False, gamma=0.9, lam=0.5)
    last = 2.0 + 0.9 * 3.0 - 1.5
    middle = 0.0 + 0.9 * 1.5 - 1.0 + 0.45 * last
    first = 1.0 + 0.9 * 1.0 - 0.5 + 0.45 * middle
    assert found == pytest.approx([first, middle, last])
    assert returns == pytest.approx(found + values)


def test_a_terminal_step_has_no_future_reward_but_a_cut_off_one_has() -> None:
    one = np.array([0.0])
    over, _ = advantages(one, one, 10.0, terminal=True, gamma=1.0, lam=1.0)
    cut, _ = advantages(one, one, 10.0, terminal=False, gamma=1.0, lam=1.0)
    assert (over[0], cut[0]) == (0.0, 10.0)


_M = st.floats(-2.0, 2.0, allow_nan=False)


@pytest.mark.slow
@given(_M, _M, st.floats(-3.0, 3.0))
def test_the_mean_command_is_the_controllers_own_arc_within_its_limits(x: float, y: float, theta: float) -> None:
    limits = _limits()
    trajectory = torch.zeros(1, 30, 3, dtype=torch.float64)
    trajectory[0, 9] = torch.tensor([x, y, theta])
    bounds = CommandLimits(limits.vx_max_mps, limits.wz_max_radps)
    speed, turn = arc_to(SE2(x, y, theta), 1.0)
    expected = scale_to_limits(speed, turn, limits, 1.0)
    found = command_mean(trajectory, 0.1, bounds)[0]
    # Where a target lies on the border between two rules, rounding may choose the other one.
    if abs(math.hypot(x, y) - 0.05) > 1e-6 and abs(abs(math.atan2(y, x)) - math.pi / 2) > 1e-6:
        assert found.tolist() == pytest.approx(expected, abs=2e-5)


def test_the_gradient_of_the_mean_is_finite_wherever_the_target_is() -> None:
    points = torch.tensor([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.02, 0.0], [1.0, 1e-9]])
    trajectory = torch.zeros(len(points), 30, 3)
    trajectory[:, 9, :2] = points
    trajectory.requires_grad_()
    command_mean(trajectory, 0.1, CommandLimits(1.0, 1.0)).sum().backward()
    assert trajectory.grad is not None and bool(torch.isfinite(trajectory.grad).all())


def test_a_plan_beyond_the_speed_limit_can_learn_to_go_slower() -> None:
    trajectory = torch.zeros(1, 30, 3)
    trajectory[0, 9, 0] = 2.0
    trajectory.requires_grad_()
    limits = CommandLimits(1.0, 1.0)
    speed = command_mean(trajectory, 0.1, limits)[0, 0]
    speed.backward()
    assert float(speed.detach()) == 1.0
    assert trajectory.grad is not None and float(trajectory.grad[0, 9, 0]) > 0.1


def _limits() -> LimitsConfig:
    return robot_config().limits


@dataclass
class _OneNumber:
    """Reward is highest where the action is 0.7; there is no state."""

    mean: torch.nn.Parameter
    log_std: torch.nn.Parameter
    worth: torch.nn.Parameter
    actions: Tensor

    @property
    def actor_parameters(self) -> list[torch.nn.Parameter]:
        return [self.mean, self.log_std]

    @property
    def critic_parameters(self) -> list[torch.nn.Parameter]:
        return [self.worth]

    def act(self, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        density = log_prob(self.actions[rows], self.mean.expand(len(rows), 2), self.log_std)
        return density, entropy(self.log_std), self.mean.new_zeros(())

    def value(self, rows: Tensor) -> Tensor:
        return self.worth.expand(len(rows))


def _one_number() -> _OneNumber:
    parameter = torch.nn.Parameter
    return _OneNumber(
        parameter(torch.zeros(2)), parameter(torch.full((2,), -1.0)), parameter(torch.zeros(())), torch.zeros(1, 2)
    )


def _train(updates: int, config: PpoConfig) -> tuple[_OneNumber, list[float]]:
    learner, generator = _one_number(), torch.Generator().manual_seed(3)
    optimiser = PpoOptimiser(learner, config)
    seen = []
    for _ in range(updates):
        noise = torch.randn(128, 2, generator=generator)
        learner.actions = (learner.mean + learner.log_std.exp() * noise).detach()
        reward = -((learner.actions - 0.7) ** 2).sum(-1)
        seen.append(float(reward.mean()))
        optimiser.update(learner, reward - learner.worth.detach(), reward, generator)
    return learner, seen


@pytest.mark.slow
def test_ppo_finds_the_action_that_pays() -> None:
    learner, seen = _train(40, PpoConfig(action_lr=0.02, value_lr=0.02, entropy=0.0))
    assert learner.mean.detach().tolist() == pytest.approx([0.7, 0.7], abs=0.1)
    assert np.mean(seen[-5:]) > np.mean(seen[:5]) + 0.5


@pytest.mark.slow
def test_a_policy_that_has_moved_far_enough_stays_while_the_value_learns_on() -> None:
    def update(target_kl: float) -> tuple[_OneNumber, PpoStats]:
        learner, generator = _one_number(), torch.Generator().manual_seed(0)
        learner.actions = torch.randn(128, 2, generator=generator)
        config = PpoConfig(action_lr=0.1, value_lr=0.05, batch=16, target_kl=target_kl)
        optimiser = PpoOptimiser(learner, config)
        return learner, optimiser.update(learner, learner.actions[:, 0], torch.ones(128), generator)

    far, all_of_it = update(0.0)
    near, some = update(0.005)
    assert 0 < some.moved < all_of_it.moved == 5 * 8
    assert near.mean.detach().norm() < far.mean.detach().norm() / 2
    assert torch.equal(near.worth, far.worth)


def test_a_gradient_that_is_not_finite_changes_nothing() -> None:
    learner, generator = _one_number(), torch.Generator().manual_seed(0)
    learner.actions = torch.zeros(64, 2)
    learner.actions[0] = float("nan")
    stats = PpoOptimiser(learner, PpoConfig()).update(learner, torch.ones(64), torch.full((64,), 1.0), generator)
    assert stats.skipped > 0
    assert bool(torch.isfinite(learner.mean).all())
