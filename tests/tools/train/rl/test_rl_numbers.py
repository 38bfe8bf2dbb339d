"""The arithmetic of reinforcement learning: advantages, densities, arcs, and PPO on a one-parameter problem."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from edge.core.geometry import SE2
from edge.motion.controller import arc_to, scale_to_limits
from firmware_bridge.core.config import LimitsConfig
from sim_hil.benchmark.policies.select import robot_config
from tools.train.config.rl import PpoConfig
from tools.train.rl.action_tail import CommandLimits, command_mean, entropy, log_prob
from tools.train.rl.ppo import PpoOptimiser, PpoStats, advantages

pytestmark = pytest.mark.usefixtures("one_thread")


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


def test_the_warm_up_trains_the_value_alone() -> None:
    learner, generator = _one_number(), torch.Generator().manual_seed(0)
    learner.actions = torch.randn(128, 2, generator=generator)
    optimiser = PpoOptimiser(learner, PpoConfig(value_lr=0.05))
    optimiser.update(learner, torch.randn(128, generator=generator), torch.ones(128), generator, policy=False)
    assert float(learner.worth.detach()) > 0.1 and not learner.mean.detach().any()


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
