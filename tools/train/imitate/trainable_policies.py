"""The policies that imitation trains: the action expert, or the paper's point-goal baseline without language (4.1)."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Iterable
from pathlib import Path
from typing import Final

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from export.core.tensor_file import replacing
from export.model.action import ActionExpert
from export.model.attention import projection
from export.model.config import TicVlaConfig
from tools.train.config.checks import TrainError
from tools.train.config.imitate import LossConfig
from tools.train.drives.walls import too_near
from tools.train.samples import action_batch
from tools.train.samples.action_batch import ActionBatch
from tools.train.samples.drive_frames import DriveFrames

FORMAT: Final = "tic-vla-edge-point-goal/1"
_KEY: Final = "point_goal"  # the only metadata key: the order of several keys would not be reproducible
GOAL_SCALE_M: Final = 10.0
"""Unit of the goal distance, m."""
GOAL_MOST: Final = 3.0
"""Clip of the goal distance, in units of GOAL_SCALE_M (30 m)."""


class PointGoalNet(nn.Module):
    """Maps visual tokens [n, N, D], state [n, 3] and goal [n, 2] m to plans [n, steps, 3], in the robot frame."""

    def __init__(self, config: TicVlaConfig) -> None:
        super().__init__()
        self.config = config
        width = config.value.channels
        layers: list[nn.Module] = []
        channels = config.vision.token_dim
        for _ in range(config.value.conv_layers):
            layers += [nn.Conv1d(channels, width, 3, stride=2, padding=1), nn.ReLU()]
            channels = width
        self.convolutions = nn.Sequential(*layers, nn.AdaptiveAvgPool1d(1), nn.Flatten())
        self.low_dimensional = projection(6, width)
        self.head = nn.Sequential(nn.Linear(2 * width, width), nn.ReLU())
        self.out = nn.Linear(width, 3 * config.action.steps)

    def features(self, visual_tokens: Tensor, state: Tensor, goal: Tensor) -> Tensor:
        """Compute the features [n, channels] from which the plan is computed."""
        distance = goal.norm(dim=-1, keepdim=True)
        # Separate direction and distance: both are distinguished equally well at every distance.
        direction = goal / distance.clamp(min=1e-3)
        low = torch.cat([state, (distance / GOAL_SCALE_M).clamp(max=GOAL_MOST), direction], dim=-1)
        seen = self.convolutions(visual_tokens.transpose(1, 2))
        plans: Tensor = self.head(torch.cat([seen, self.low_dimensional(low)], dim=-1))
        return plans

    def forward(self, visual_tokens: Tensor, state: Tensor, goal: Tensor) -> Tensor:
        steps = self.out(self.features(visual_tokens, state, goal)).float()
        return torch.cumsum(steps.unflatten(-1, (-1, 3)), dim=1)


def build_point_goal(config: TicVlaConfig, generator: torch.Generator) -> PointGoalNet:
    """Build an untrained network whose plan is a slow straight walk; weights depend on the generator alone."""
    network = PointGoalNet(config)
    with torch.no_grad():
        for module in network.modules():
            if isinstance(module, nn.Conv1d | nn.Linear):
                fan_in = module.weight[0].numel()
                # He initialisation, for ReLU activations.
                module.weight.normal_(0.0, (2.0 / fan_in) ** 0.5, generator=generator)
                if module.bias is not None:
                    module.bias.zero_()
        network.out.weight.mul_(1e-2)
        network.out.bias.copy_(torch.tensor(config.action.initial_step).repeat(config.action.steps))
    return network


def save_point_goal(network: PointGoalNet, path: Path, origin: str) -> None:
    """Write the weights atomically. Raises OSError."""
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in network.state_dict().items()}
    about = {"format": FORMAT, "config": network.config.to_dict(), "origin": origin}
    with replacing(path) as partial:
        save_file(tensors, str(partial), metadata={_KEY: json.dumps(about, sort_keys=True)})


def load_point_goal(path: Path, config: TicVlaConfig) -> PointGoalNet:
    """Load a network that `save_point_goal` wrote, in evaluation mode. Raises TrainError."""
    network = PointGoalNet(config)
    try:
        with safe_open(str(path), framework="pt") as file:
            if json.loads((file.metadata() or {}).get(_KEY, "{}")).get("format") != FORMAT:
                raise TrainError(f"{path}: expected a point-goal network of edge-train")
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 — not a mapping
    except (OSError, SafetensorError, json.JSONDecodeError) as error:
        raise TrainError(f"{path}: not readable ({error})") from error
    wanted = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    if {name: tuple(tensor.shape) for name, tensor in tensors.items()} != wanted:
        raise TrainError(f"{path}: expected tensors of another size; train the network again")
    network.load_state_dict(tensors)
    return network.eval()


def plan_loss(config: LossConfig, plan: Tensor, batch: ActionBatch) -> Tensor:
    """Compute the loss [B] of plans [B, steps, 3]: equation 4, plus a penalty for plans too close to walls."""
    loss = action_batch.smooth_l1(plan, batch, beta=config.beta, heading_weight=config.heading_weight)
    if not config.walls or batch.around is None:
        return loss
    return loss + config.walls * too_near(plan.float(), batch.target, batch.known, *batch.around, config.room_m)


class TrainablePolicy(ABC):
    """A policy that is trained on batches."""

    module: nn.Module
    """The trained network; all of its parameters are trained."""
    uses_semantics: bool
    """Whether the policy receives semantic states."""

    @abstractmethod
    def plan(self, batch: ActionBatch) -> Tensor:
        """Compute trajectories [B, steps, 3]."""

    @abstractmethod
    def errors(self, batch: ActionBatch, generator: torch.Generator) -> Tensor:
        """Compute the loss of every frame [B]."""

    @abstractmethod
    def begin(self, drives: Iterable[DriveFrames]) -> None:
        """Prepare for training on these drives, once before the first step."""


class ActionExpertPolicy(TrainablePolicy):
    """The action expert with any of its heads."""

    uses_semantics = True

    def __init__(self, action: ActionExpert, loss: LossConfig) -> None:
        self.module = self._action = action.eval()
        self._loss = loss

    def plan(self, batch: ActionBatch) -> Tensor:
        """Compute the plan with the batch's dropout masks."""
        return action_batch.plan(self._action, batch)

    def errors(self, batch: ActionBatch, generator: torch.Generator) -> Tensor:
        """Compute equation 4 and the wall penalty, or the objective of a diffusion or flow head (paper appendix D)."""
        if self._action.config.action.head == "query":
            return plan_loss(self._loss, self.plan(batch), batch)
        return action_batch.errors(self._action, batch, generator)

    def begin(self, drives: Iterable[DriveFrames]) -> None:
        """Compute mean and deviation of the labels for heads that normalise actions."""
        if self._action.scale is None:
            return
        labels = [(torch.from_numpy(drive.target), torch.from_numpy(drive.known)) for drive in drives]
        target = torch.cat([each for each, _ in labels])
        known = torch.cat([each for _, each in labels])[:, None] > torch.arange(target.shape[1])
        device = next(self._action.parameters()).device
        self._action.fit_actions(target.to(device), known.to(device))


class PointGoalNetPolicy(TrainablePolicy):
    """The point-goal network for behaviour cloning, with the action expert's state dropout."""

    uses_semantics = False

    def __init__(self, network: PointGoalNet, loss: LossConfig) -> None:
        self.module = self._network = network
        self._loss = loss

    def plan(self, batch: ActionBatch) -> Tensor:
        """Compute the plan from image, state and goal."""
        plans: Tensor = self._network(batch.visual_tokens, batch.state * batch.keep_state[:, None], batch.goal)
        return plans

    def errors(self, batch: ActionBatch, generator: torch.Generator) -> Tensor:
        """Compute equation 4 and the wall penalty."""
        return plan_loss(self._loss, self.plan(batch), batch)

    def begin(self, drives: Iterable[DriveFrames]) -> None:
        """Do nothing."""
