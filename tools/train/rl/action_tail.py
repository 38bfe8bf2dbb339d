"""The action expert split before its last cross-attention layer: the frozen prefix and the tail that PPO trains.

Paper, appendix D: "we finetune only the final cross-attention Transformer layer and the MLP decoder". The prefix is
frozen, so its output is computed once in a rollout and reused in every epoch of the optimisation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from edge.motion.controller import TARGET_TIME_S, TURN_IN_PLACE_M
from export.model.action import ActionExpert
from export.model.heads import integrated
from tools.train.config.checks import TrainError


def check_tail(expert: ActionExpert) -> None:
    """Raise TrainError unless the expert's last layer and head alone compute the trajectory (head `query`)."""
    head = getattr(expert.config.action, "head", "query")
    if head != "query":
        raise TrainError(f"action.head {head!r}: reinforcement learning trains the query head alone; end with imitate")
    if expert.config.action.semantic_interface == "waypoints":
        raise TrainError(
            "semantic_interface 'waypoints': reinforcement learning needs kv or values-only, which a generation fixes"
        )


def tail_parameters(expert: ActionExpert) -> dict[str, torch.nn.Parameter]:
    """Return the tail's parameters by the expert's names: last cross-attention layer, its keys and values, and head."""
    last = len(expert.layers) - 1
    trained = (f"layers.{last}.", f"key_values.{last}.", "norm.", "head.", "out.")
    return {name: each for name, each in expert.named_parameters() if name.startswith(trained)}


def freeze_all_but_tail(expert: ActionExpert) -> None:
    """Disable gradients of all parameters but the tail's."""
    trained = tail_parameters(expert)
    for name, each in expert.named_parameters():
        each.requires_grad_(name in trained)


def load_tail(expert: ActionExpert, tensors: Mapping[str, Tensor]) -> None:
    """Replace the tail's weights. Raises TrainError unless the names are exactly the tail's."""
    wanted = tail_parameters(expert)
    if set(tensors) != set(wanted):
        odd = sorted(set(tensors) ^ set(wanted))[0]
        raise TrainError(f"weights of the last layer and the head: {odd} is missing or unknown")
    with torch.no_grad():
        for name, each in wanted.items():
            each.copy_(tensors[name])


def semantic_of(expert: ActionExpert, last_layer_kv: Tensor) -> Tensor:
    """Compute semantic tokens [1, T, hidden] from a generation's K‖V [1, T, kv_dim], without gradients."""
    with torch.no_grad():
        return expert.semantic_tokens(last_layer_kv)


def now_of(expert: ActionExpert, visual_tokens: Tensor, state: Tensor, latency: Tensor) -> Tensor:
    """Compute the tokens of the current frame, state and latency [B, N + 2, hidden], without gradients."""
    with torch.no_grad():
        return expert.now_tokens(visual_tokens, state, latency)


def prefix(expert: ActionExpert, now: Tensor, semantic: Tensor) -> Tensor:
    """Compute the queries [B, steps, hidden] before the last layer, without gradients.

    `now` [B, N + 2, hidden]; `semantic` [B, T, hidden], of equal length T in the whole batch.
    """
    with torch.no_grad():
        x = expert.queries.detach().expand(now.shape[0], -1, -1)
        pairs = list(zip(expert.key_values, expert.layers, strict=True))
        for key_value, layer in pairs[:-1]:
            keys, values = key_value(torch.cat([now, semantic], dim=1))
            x = layer(x, keys, values)
        return x


def tail(expert: ActionExpert, x: Tensor, now: Tensor, semantic: Tensor, real: Tensor | None = None) -> Tensor:
    """Compute the trajectory [B, steps, 3] from the queries before the last layer.

    `real` [B, T] is False at padded semantic tokens; None if none is padded.
    """
    c = expert.config.action
    tokens = torch.cat([now, semantic], dim=1)
    keys, values = expert.key_values[-1](tokens)
    mask = None
    if real is not None:
        mask = torch.cat([real.new_ones(now.shape[:2]), real], dim=1)[:, None, None, :]
    out = expert.out(expert.head(expert.norm(expert.layers[-1](x, keys, values, mask))))
    return integrated(out, c.parameterisation)


def padded(sequences: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Stack sequences [T_i, h] as a batch [B, T, h] padded with zeros; return it and which tokens are real [B, T]."""
    lengths = torch.tensor([len(each) for each in sequences])
    batch = torch.nn.utils.rnn.pad_sequence(list(sequences), batch_first=True)
    return batch, torch.arange(batch.shape[1])[None] < lengths[:, None]


@dataclass(frozen=True)
class CommandLimits:
    """The robot's largest forward speed, m/s, and yaw rate, rad/s."""

    vx_max_mps: float
    wz_max_radps: float

    def __post_init__(self) -> None:
        if not (self.vx_max_mps > 0 and self.wz_max_radps > 0):
            raise ValueError("command limits must be above 0")


def command_mean(trajectory: Tensor, step_s: float, limits: CommandLimits) -> Tensor:
    """Compute (v m/s, ω rad/s) [B, 2] of trajectories [B, steps, 3]: the arc to the target 1 s ahead, within limits."""
    return within_limits(arc_command(trajectory, step_s), limits)


def arc_command(trajectory: Tensor, step_s: float) -> Tensor:
    """Compute (v m/s, ω rad/s) [B, 2] of the arc to the target 1 s ahead, without limits (`controller.arc_to`)."""
    index = min(trajectory.shape[1], max(1, round(TARGET_TIME_S / step_s))) - 1
    x, y, theta = trajectory[:, index].unbind(-1)
    distance = torch.sqrt(x * x + y * y + 1e-12)
    bearing = torch.atan2(y, x)
    small = bearing.abs() < 1e-3
    # Both branches of a `where` receive gradients, so the branch that is not taken must be finite.
    sine = torch.where(small, torch.ones_like(bearing), torch.sin(bearing))
    divisor = torch.where(sine.abs() < 1e-6, torch.ones_like(sine), sine)
    stretch = torch.where(small, 1 + bearing * bearing / 6, bearing / divisor)
    near, behind = distance < TURN_IN_PLACE_M, bearing.abs() > math.pi / 2
    still = near | behind
    speed = torch.where(still, torch.zeros_like(distance), distance * stretch / TARGET_TIME_S)
    turn = 2 * bearing / TARGET_TIME_S
    turn = torch.where(behind, torch.sign(bearing) * (math.pi / 2) / TARGET_TIME_S, turn)
    turn = torch.where(near, theta / TARGET_TIME_S, turn)
    return torch.stack([speed, turn], dim=-1)


def within_limits(arc: Tensor, limits: CommandLimits) -> Tensor:
    """Scale commands [B, 2] down along their arcs until they are within the limits.

    The scale is detached: with its gradient, a plan above the speed limit could not learn to go slower.
    """
    speed, turn = arc.unbind(-1)
    over = torch.maximum(speed / limits.vx_max_mps, turn.abs() / limits.wz_max_radps).clamp(min=1.0).detach()
    return arc / over[..., None]


def log_prob(action: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """Compute the log density [B] of actions [B, 2] under independent Gaussians; `log_std` [2]."""
    z = (action - mean) * torch.exp(-log_std)
    return (-0.5 * z * z - log_std - 0.5 * math.log(2 * math.pi)).sum(-1)


def entropy(log_std: Tensor) -> Tensor:
    """Compute the differential entropy [] of the Gaussian, nats."""
    return (log_std + 0.5 * math.log(2 * math.pi * math.e)).sum()
