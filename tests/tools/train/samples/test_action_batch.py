"""A batch with shared and padded states gives every frame the plan that `ActionExpert` gives it alone."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from export.model.action import ActionExpert
from export.model.config import TicVlaConfig
from export.model.network import build
from tests.support.train.train_drives import tiny_model
from tools.train.config.imitate import LossConfig
from tools.train.imitate.trainable_policies import ActionExpertPolicy
from tools.train.samples.action_batch import Group, collate, plan, smooth_l1

CPU = torch.device("cpu")
LENGTHS = (5, 9, 1)


pytestmark = pytest.mark.usefixtures("one_thread")


def model_with(**action: Any) -> TicVlaConfig:
    model = tiny_model()
    return dataclasses.replace(model, action=dataclasses.replace(model.action, layers=2, **action))


def expert(config: TicVlaConfig) -> ActionExpert:
    """With a head that says something: as it is initialised all plans are about the same."""
    action = build(config, 3).action
    generator = torch.Generator().manual_seed(4)
    with torch.no_grad():
        for name, parameter in action.named_parameters():
            if name.endswith("out.weight"):
                parameter.normal_(0.0, 0.3, generator=generator)
    return action.eval()


def group(seed: int, tokens: int, config: TicVlaConfig, size: int = 3) -> Group:
    rng = np.random.default_rng(seed)
    steps = config.action.steps

    def normal(*shape: int) -> np.ndarray:
        return rng.standard_normal(shape).astype(np.float32)

    by_points = config.action.semantic_interface == "waypoints"
    guidance = normal(size, 3, 2) if by_points else normal(1, tokens, config.kv_dim).astype(np.float16)
    return Group(
        visual_tokens=normal(size, config.vision.tokens, config.vision.token_dim).astype(np.float16),
        state=normal(size, 3),
        latency=normal(size, 4),
        guidance=guidance,
        goal=normal(size, 2),
        keep_guidance=np.ones(guidance.shape[:2], bool),
        keep_state=np.ones(size, bool),
        target=normal(size, steps, 3),
        known=np.ones((size, steps), bool),
    )


def alone(action: ActionExpert, one: Group, i: int) -> torch.Tensor:
    """Frame i of a group through the network by itself, as it runs on a robot."""

    def row(array: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(array[i : i + 1].astype(np.float32))

    guidance = torch.from_numpy(one.guidance[min(i, len(one.guidance) - 1)][None].astype(np.float32))
    keys, values = action.context(guidance)
    return action(row(one.visual_tokens), row(one.state), row(one.latency), keys, values)[0]


VARIANTS = [
    {},
    {"semantic_interface": "values-only"},
    {"semantic_interface": "waypoints"},
    {"parameterisation": "offsets"},
    {"latency_aware": False},
    {"motion_offset": False},
    {"steps": 10},
    {"steps": 50},
    {"head": "diffusion"},
    {"head": "flow"},
]


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda variant: "-".join(map(str, variant.values())) or "paper")
def test_every_frames_plan_is_that_of_the_frame_alone(variant: dict[str, Any]) -> None:
    config = model_with(**variant)
    action = expert(config)
    groups = [group(seed, tokens, config) for seed, tokens in enumerate(LENGTHS)]
    with torch.no_grad():
        plans = plan(action, collate(groups, CPU))
    assert plans.shape == (9, config.action.steps, 3)
    for number, one in enumerate(groups):
        for i in range(3):
            # A diffusion passes through the layers five times, and its actions are larger.
            close = 2e-5 if config.action.head == "query" else 1e-3
            torch.testing.assert_close(plans[3 * number + i], alone(action, one, i).detach(), atol=close, rtol=1e-4)


def test_gradients_of_a_padded_batch_are_those_of_its_frames_alone() -> None:
    config = model_with()
    action = expert(config)
    groups = [group(seed, tokens, config) for seed, tokens in enumerate(LENGTHS)]

    def gradients(planned: Callable[[], torch.Tensor]) -> list[torch.Tensor]:
        action.zero_grad()
        planned().square().sum().backward()
        return [weight.grad for weight in action.parameters() if weight.grad is not None]

    together = gradients(lambda: plan(action, collate(groups, CPU)))
    apart = gradients(lambda: torch.stack([alone(action, one, i) for one in groups for i in range(3)]))
    assert len(together) == len(apart) > 20
    # The bias of keys has no gradient but rounding errors, of the size of the others'.
    rounding = 1e-6 * max(float(expected.abs().max()) for expected in apart)
    torch.testing.assert_close(together, apart, atol=rounding, rtol=1e-3)


def test_a_dropped_token_is_one_without_content_and_a_dropped_state_is_not_seen() -> None:
    config = model_with()
    action = expert(config)
    one = group(1, 6, config)
    keep = np.array([[True, False, True, True, False, True]])
    with torch.no_grad():
        dropped = plan(action, collate([dataclasses.replace(one, keep_guidance=keep)], CPU))
        tokens = action.semantic_tokens(torch.from_numpy(one.guidance).float()) * torch.from_numpy(keep)[..., None]
        keys, values = action.context_of(tokens)
        inputs = [torch.from_numpy(array).float() for array in (one.visual_tokens, one.state, one.latency)]
        expected = action(*inputs, keys.expand(-1, 3, -1, -1, -1), values.expand(-1, 3, -1, -1, -1))
        torch.testing.assert_close(dropped, expected, atol=2e-5, rtol=1e-4)

        unseen = dataclasses.replace(one, keep_state=np.array([True, False, True]))
        plans = plan(action, collate([unseen], CPU))
        others = plan(action, collate([dataclasses.replace(unseen, state=one.state + 1)], CPU))
    assert torch.equal(plans[1], others[1])
    assert not torch.allclose(plans[0], others[0], atol=1e-4)


def test_the_loss_is_smooth_l1_over_the_known_steps() -> None:
    config = model_with()
    one = group(2, 4, config)
    known = np.ones((3, 30), bool)
    known[1, 12:] = False
    batch = collate([dataclasses.replace(one, known=known)], CPU)
    planned = batch.target + torch.tensor([0.5, -2.0, 0.1])
    terms = [0.5 * 0.5**2, 2.0 - 0.5, 3 * 0.5 * 0.1**2]
    loss = smooth_l1(planned, batch, beta=1.0, heading_weight=3.0)
    torch.testing.assert_close(loss, sum(terms) * torch.tensor([1.0, 12 / 30, 1.0]))
    planned[1, 12:] = 1e6
    torch.testing.assert_close(smooth_l1(planned, batch, beta=1.0, heading_weight=3.0), loss)


@pytest.mark.parametrize("head", ["query", "diffusion", "flow"])
def test_the_error_of_every_head_is_per_frame_and_reaches_its_weights(head: str) -> None:
    config = model_with(head=head)
    action = expert(config)
    one = group(3, 4, config)
    if action.scale is not None:
        action.fit_actions(torch.randn(50, 30, 3, generator=torch.Generator().manual_seed(1)))
    other = dataclasses.replace(one, target=np.concatenate([one.target[:2], one.target[2:] + 1]))

    def value(given: Group) -> torch.Tensor:
        generator = torch.Generator().manual_seed(5)
        return ActionExpertPolicy(action, LossConfig()).errors(collate([given], CPU), generator)

    first, second = value(one), value(other)
    assert first.shape == (3,) and torch.isfinite(first).all()
    assert torch.equal(first[:2], second[:2]) and first[2] != second[2]
    first.sum().backward()
    learned = [name for name, each in action.named_parameters() if each.grad is not None and each.grad.any()]
    assert {"semantic_projection.0.weight", "visual_position", "latency_projection.2.bias"} <= set(learned)
