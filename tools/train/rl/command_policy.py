"""A Gaussian over commands (v, ω) whose mean is the arc to the trajectory's point 1 s ahead (paper, appendix D).

Computes the same arc and limits as `edge.motion.controller`, in torch, so that training and driving agree.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from edge.motion.controller import TARGET_TIME_S, TURN_IN_PLACE_M


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
