"""The three heads of the action expert: what they are trained to, what they give, and that batches change nothing."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812 - torch's own idiom

from export.checkpoint.load import load_checkpoint
from export.model.action import ActionExpert
from export.model.config import PRESETS, ModelConfigError, config_from_dict
from export.model.heads import ActionScale, Diffusion, cosine_schedule, ddim_steps, differentiated, integrated
from export.model.network import build
from export.model.weights import CheckpointError, WeightsInfo, save_weights, weights_sha256
from tests.support.export.action_heads import HEADS, TINY, drives, expert, instants, lively, normal, states, with_head

pytestmark = pytest.mark.usefixtures("one_thread")  # many threads on tiny tensors cost more than they give

PARAMETERISATIONS = ("increments", "offsets")


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def plan(action: ActionExpert, batch: int = 1, tokens: int = 6, mask: Tensor | None = None) -> Tensor:
    with torch.no_grad():
        return action(*instants(batch), *action.context(states(batch, tokens)), mask)


# The query head is what it was


def test_a_configuration_reads_back_and_one_without_a_head_has_the_query_head() -> None:
    for head in HEADS:
        config = with_head(TINY, head, ddim_steps=7, couplings=3)
        assert config_from_dict(json.loads(json.dumps(config.to_dict()))) == config
    content = PRESETS["nano"].to_dict()
    assert not {"head", "diffusion_steps", "ddim_steps", "couplings"} & set(content["action"])
    assert config_from_dict(content) == PRESETS["nano"]


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"head": "guess"}, "head 'guess': expected one of"),
        ({"ddim_steps": 101}, "ddim_steps 101 are more than the 100"),
        ({"head": "diffusion", "hidden": 33, "heads": 3}, "hidden 33 must be even"),
        ({"head": "flow", "steps": 1}, "steps is 1"),
        ({"couplings": 0}, "couplings is 0"),
    ],
)
def test_a_head_that_cannot_be_is_refused(fields: dict, message: str) -> None:
    with pytest.raises(ModelConfigError, match=message):
        dataclasses.replace(TINY.action, **fields)


@pytest.mark.parametrize("head", HEADS)
def test_weights_of_every_head_come_back_and_another_head_is_refused(tmp_path: Path, head: str) -> None:
    config = with_head(TINY, head)
    model, path = lively(config, 4), tmp_path / "whole.safetensors"
    save_weights(model, path, WeightsInfo(True, ""))
    assert weights_sha256(load_checkpoint([path], config, fill_seed=None).model) == weights_sha256(model)
    other = HEADS[(HEADS.index(head) + 1) % 3]
    with pytest.raises(CheckpointError, match=f"action.head is '{head}', expected '{other}'"):
        load_checkpoint([path], with_head(TINY, other), fill_seed=None)


# Plans


@pytest.mark.parametrize("head", HEADS)
@pytest.mark.parametrize("index", range(4))
def test_every_input_reaches_the_plan(head: str, index: int) -> None:
    action = expert(head)
    inputs = [*instants(1), states(1, 6)]
    changed = [x + 1.0 if i == index else x for i, x in enumerate(inputs)]
    with torch.no_grad():
        a, b = (action(*x[:3], *action.context(x[3])) for x in (inputs, changed))
    assert (a - b).abs().max() > 1e-5


def test_a_step_is_denoised_in_the_knowledge_of_its_neighbours() -> None:
    action = expert("diffusion")
    before = differentiated(plan(action), "increments")
    noise = action.diffusion.noise.clone()
    noise[0, 3] += 1.0
    action.load_state_dict({**action.state_dict(), "diffusion.noise": noise})
    moved = (differentiated(plan(action), "increments") - before).abs().amax(dim=-1)[0]
    assert (moved > 1e-6).all()


# Batches


@pytest.mark.parametrize("head", HEADS)
def test_a_batch_gives_every_row_what_it_gives_alone(head: str) -> None:
    action = expert(head)
    inputs, kv = instants(3), states(3, 6)
    with torch.no_grad():
        whole = action(*inputs, *action.context(kv))
        rows = [action(*(x[i : i + 1] for x in inputs), *action.context(kv[i : i + 1])) for i in range(3)]
    assert whole.shape == (3, 11, 3)
    torch.testing.assert_close(whole, torch.cat(rows), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("head", HEADS)
def test_padding_on_the_left_changes_no_row(head: str) -> None:
    action = expert(head)
    inputs, kv, lengths = instants(3), states(3, 9), (9, 4, 1)
    mask = torch.arange(9)[None] >= 9 - torch.tensor(lengths)[:, None]
    with torch.no_grad():
        whole = action(*inputs, *action.context(kv), mask)
        rows = [
            action(*(x[i : i + 1] for x in inputs), *action.context(kv[i : i + 1, 9 - n :]))
            for i, n in enumerate(lengths)
        ]
    torch.testing.assert_close(whole, torch.cat(rows), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("head", HEADS)
def test_instants_in_a_row_may_share_a_state(head: str) -> None:
    action = expert(head)
    kv, mask = states(2, 6), torch.tensor([[True] * 6, [False] * 3 + [True] * 3])
    with torch.no_grad():
        shared = action(*instants(6), *action.context(kv), mask)
        apart = action(*instants(6), *action.context(kv.repeat_interleave(3, 0)), mask.repeat_interleave(3, 0))
    torch.testing.assert_close(shared, apart, atol=1e-6, rtol=1e-5)


# Losses


def errors(
    action: ActionExpert, inputs: tuple[Tensor, ...], kv: Tensor, target: Tensor, generator: torch.Generator | None
) -> Tensor:
    keys, values = action.context(kv, generator)
    return action.errors(action.trunk(action.now_tokens(*inputs, generator), keys, values), target, generator)


def loss(action: ActionExpert, generator: torch.Generator | None = None, target: Tensor | None = None) -> Tensor:
    return errors(action, instants(3), states(3, 6), drives(3) if target is None else target, generator).mean()


def test_the_query_heads_loss_is_equation_4() -> None:
    action = expert("query")
    expected = F.smooth_l1_loss(plan(action, 3), drives(3))
    assert float(loss(action).detach()) == pytest.approx(float(expected), rel=1e-5)


@pytest.mark.parametrize("head", HEADS)
def test_a_whole_turn_more_is_the_same_heading(head: str) -> None:
    action = expert(head)
    turned = drives(3)
    turned[:, 4:, 2] -= 2 * math.pi
    with torch.no_grad():
        a, b = (loss(action, seeded(1), target) for target in (drives(3), turned))
    assert float(a) == pytest.approx(float(b), rel=1e-3)


@pytest.mark.parametrize("head", HEADS)
def test_a_target_of_another_length_is_refused(head: str) -> None:
    with pytest.raises(ValueError, match=r"target is \[3, 12, 3\], expected \[3, 11, 3\]"):
        loss(expert(head), target=drives(3, 12))


@pytest.mark.parametrize("head", HEADS)
def test_in_training_all_chance_comes_from_the_generator(head: str) -> None:
    action = expert(head).train()
    with torch.no_grad():
        torch.manual_seed(0)
        first = loss(action, seeded(1))
        torch.manual_seed(1)
        again, other = loss(action, seeded(1)), loss(action, seeded(2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


@pytest.mark.parametrize("head", HEADS)
def test_every_weight_learns(head: str) -> None:
    action = expert(head)
    loss(action, seeded(0)).backward()
    # What is added to all keys alike changes no softmax.
    learning = {n: p for n, p in action.named_parameters() if not n.endswith(".k.bias")}
    idle = [n for n, p in learning.items() if p.grad is None or not p.grad.abs().sum() > 0]
    assert idle == []


LEFT = torch.stack([torch.full((11,), 0.05), 0.01 * torch.arange(11), torch.full((11,), 0.04)], dim=-1)
TWO_WAYS = torch.stack([LEFT, LEFT * torch.tensor([1.0, -1.0, -1.0])]).cumsum(dim=1)
"""Half a metre to the left, and the same to the right."""


def trained(head: str, inputs: tuple[Tensor, ...], kv: Tensor, target: Tensor) -> ActionExpert:
    action = build(with_head(TINY, head), 0).action
    action.fit_actions(target)
    optimiser = torch.optim.AdamW(action.parameters(), lr=3e-3)
    generator = seeded(0)
    for _ in range(150):
        optimiser.zero_grad()
        errors(action, inputs, kv, target, generator).mean().backward()
        torch.nn.utils.clip_grad_norm_(action.parameters(), 1.0)
        optimiser.step()
    return action


@pytest.mark.slow
@pytest.mark.parametrize("head", HEADS)
def test_a_head_learns_the_action_of_each_state(head: str) -> None:
    inputs, kv = instants(2), states(2, 6)
    action = trained(head, inputs, kv, TWO_WAYS)
    with torch.no_grad():
        found = action(*inputs, *action.context(kv))
    assert float((found - TWO_WAYS).abs().max()) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("head", ["diffusion", "flow"])
def test_of_two_equal_trajectories_one_is_predicted_and_not_their_mean(head: str) -> None:
    inputs = tuple(x.expand(8, *x.shape[1:]) for x in instants(1))
    action = trained(head, inputs, states(1, 6), TWO_WAYS.repeat(4, 1, 1))
    noise = {"diffusion": action.diffusion, "flow": action.flow}[head].noise
    ends = []
    for seed in range(20):
        noise.normal_(generator=seeded(seed))
        ends.append(float(plan(action)[0, -1, 1]))
    # Half a metre to a side; the mean of both is what a query learns.
    assert min(ends) < -0.4
    assert max(ends) > 0.4
    assert sum(0.4 < abs(end) < 0.7 for end in ends) >= 14


# Actions and their scale


@pytest.mark.parametrize("parameterisation", PARAMETERISATIONS)
def test_a_trajectory_is_taken_apart_and_put_together_again(parameterisation: str) -> None:
    trajectory = drives(3)
    actions = differentiated(trajectory, parameterisation)
    torch.testing.assert_close(integrated(actions, parameterisation), trajectory, atol=1e-6, rtol=1e-5)


def test_every_step_is_normalised_by_the_data_sets_own_steps() -> None:
    action, trajectories = expert("diffusion"), drives(200)
    action.fit_actions(trajectories)
    normalised = action.scale.normalised(differentiated(trajectories, "increments"))
    torch.testing.assert_close(normalised.mean(dim=0), torch.zeros(11, 3), atol=1e-4, rtol=0)
    torch.testing.assert_close(normalised.std(dim=0, correction=0), torch.ones(11, 3), atol=1e-4, rtol=0)


def test_unknown_steps_do_not_change_the_scale() -> None:
    known = torch.arange(11)[None].expand(40, -1) < torch.arange(40)[:, None]
    known[:, 0] = known[39] = True
    wild = drives(40)
    wild = torch.where(known[..., None], wild, wild + 100.0)
    scales = []
    for trajectories in (drives(40), wild):
        scale = ActionScale(TINY.action)
        # After a step that is not known none is, so no difference of known ones reaches into the wild.
        scale.fit(differentiated(trajectories, "increments"), known)
        scales.append(scale)
    assert torch.equal(scales[0].mean, scales[1].mean)
    assert torch.equal(scales[0].std, scales[1].std)


def test_a_step_that_is_never_known_is_refused() -> None:
    known = torch.ones(5, 11, dtype=torch.bool)
    known[:, 10] = False
    with pytest.raises(ValueError, match="at least one known for every step"):
        expert("flow").fit_actions(drives(5), known)


# Diffusion


def test_the_schedule_is_the_cosine_of_the_paper() -> None:
    shares = cosine_schedule(100)
    assert len(shares) == 100
    assert all(a > b > 0 for a, b in pairwise(shares))
    assert shares[0] > 0.999
    assert shares[-1] < 1e-6
    assert [time for time, _, _ in ddim_steps(100, 5)] == [99, 79, 59, 39, 19]

    def squared_cosine(level: int) -> float:
        return math.cos((level / 100 + 0.008) / 1.008 * math.pi / 2) ** 2

    assert shares[49] == pytest.approx(squared_cosine(50) / squared_cosine(0))


def ideal(mean: float, std: float, levels: int) -> Callable[[Tensor, Tensor], Tensor]:
    """The best denoiser of data that is Gaussian: its posterior mean."""
    shares = torch.tensor(cosine_schedule(levels), dtype=torch.float32)

    def denoise(noisy: Tensor, times: Tensor) -> Tensor:
        share = shares[times][:, None, None]
        gain = share.sqrt() * std**2 / (share * std**2 + 1 - share)
        return mean + gain * (noisy - share.sqrt() * mean)

    return denoise


def test_ddim_with_the_best_denoiser_maps_noise_onto_the_data() -> None:
    config = with_head(TINY, "diffusion", diffusion_steps=1000, ddim_steps=1000).action
    diffusion = Diffusion(config)
    diffusion.start(seeded(0))
    found = diffusion.sample(ideal(0.4, 0.5, 1000), 1)
    torch.testing.assert_close(found, 0.4 + 0.5 * diffusion.noise, atol=0.02, rtol=0)


def test_training_draws_every_noise_level_with_its_own_noise() -> None:
    diffusion = Diffusion(with_head(TINY, "diffusion", diffusion_steps=10).action)
    noisy, times = diffusion.corrupted(torch.full((4000, 11, 3), 2.0), seeded(0))
    shares = torch.tensor(cosine_schedule(10))
    assert torch.bincount(times, minlength=10).min() > 300
    for level in range(10):
        at_level = noisy[times == level]
        assert float(at_level.mean()) == pytest.approx(2 * float(shares[level]) ** 0.5, abs=0.05)
        assert float(at_level.var()) == pytest.approx(1 - float(shares[level]), abs=0.05)


# Flow


@pytest.mark.parametrize("steps", [4, 5])
def test_the_likelihood_is_exact(steps: int) -> None:
    """−log p by the inverse flow is that of the change of variables, with the whole Jacobian of the sampling."""
    flow = expert("flow", steps=steps).flow
    features = normal(1, 1, steps, 32)

    def sampled(noise: Tensor) -> Tensor:
        flow.noise = noise.reshape(1, steps, 3)
        return flow.sample(features).reshape(-1)

    noise = normal(2, 3 * steps)
    jacobian = torch.autograd.functional.jacobian(sampled, noise)
    expected = 0.5 * noise.square().sum() + 1.5 * steps * math.log(2 * math.pi) + jacobian.det().abs().log()
    with torch.no_grad():
        found = flow.surprise(sampled(noise).reshape(1, steps, 3), features).sum()
    assert float(found) == pytest.approx(float(expected), rel=1e-4)
