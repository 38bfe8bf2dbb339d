"""The paper's point-goal baselines as a network: pictures, state and where the goal is, no words (section 4.1).

Behaviour cloning and reinforcement learning share it, so that what differs between their rows is how they were trained.
Its trunk is the value network's (appendix D: the baseline "shares the same architecture as the value network").
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Final

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from export.model.attention import projection
from export.model.config import TicVlaConfig

FORMAT: Final = "tic-vla-edge-point-goal/1"
_KEY: Final = "point_goal"  # the only metadata key: with two, the order of the bytes would be left to chance
GOAL_SCALE_M: Final = 10.0
GOAL_MOST: Final = 3.0
"""A goal further than 30 m is told as one 30 m away."""


class PointGoalFileError(ValueError):
    """A file that is not a point-goal network of ours, or one of another size; one line."""


class PointGoalNet(nn.Module):
    """Visual tokens [n, N, D], state [n, 3], goal [n, 2] m in the robot's frame → plan [n, steps, 3] in it."""

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
        """[n, channels]: what plan, policy or value are read off from."""
        distance = goal.norm(dim=-1, keepdim=True)
        # Direction and distance apart: near and far goals are told apart as well as left and right ones.
        direction = goal / distance.clamp(min=1e-3)
        low = torch.cat([state, (distance / GOAL_SCALE_M).clamp(max=GOAL_MOST), direction], dim=-1)
        seen = self.convolutions(visual_tokens.transpose(1, 2))
        plans: Tensor = self.head(torch.cat([seen, self.low_dimensional(low)], dim=-1))
        return plans

    def forward(self, visual_tokens: Tensor, state: Tensor, goal: Tensor) -> Tensor:
        steps = self.out(self.features(visual_tokens, state, goal)).float()
        return torch.cumsum(steps.unflatten(-1, (-1, 3)), dim=1)


def build_point_goal(config: TicVlaConfig, generator: torch.Generator) -> PointGoalNet:
    """An untrained network whose plan is a slow walk straight ahead; the same generator gives the same weights."""
    network = PointGoalNet(config)
    with torch.no_grad():
        for module in network.modules():
            if isinstance(module, nn.Conv1d | nn.Linear):
                fan_in = module.weight[0].numel()
                # He initialisation: a ReLU halves what passes it.
                module.weight.normal_(0.0, (2.0 / fan_in) ** 0.5, generator=generator)
                if module.bias is not None:
                    module.bias.zero_()
        network.out.weight.mul_(1e-2)
        network.out.bias.copy_(torch.tensor(config.action.initial_step).repeat(config.action.steps))
    return network


def save_point_goal(network: PointGoalNet, path: Path, origin: str) -> None:
    """Write the weights in one rename; raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in network.state_dict().items()}
    about = {"format": FORMAT, "config": network.config.to_dict(), "origin": origin}
    save_file(tensors, str(partial), metadata={_KEY: json.dumps(about, sort_keys=True)})
    partial.replace(path)


def load_point_goal(path: Path, config: TicVlaConfig) -> PointGoalNet:
    """The network that `save_point_goal` wrote, in evaluation mode; raises PointGoalFileError."""
    network = PointGoalNet(config)
    try:
        with safe_open(str(path), framework="pt") as file:
            if json.loads((file.metadata() or {}).get(_KEY, "{}")).get("format") != FORMAT:
                raise PointGoalFileError(f"{path}: expected a point-goal network of edge-train")
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 — not a mapping
    except (OSError, SafetensorError, json.JSONDecodeError) as error:
        raise PointGoalFileError(f"{path}: not readable ({error})") from error
    wanted = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    if {name: tuple(tensor.shape) for name, tensor in tensors.items()} != wanted:
        raise PointGoalFileError(f"{path}: made for a network of other sizes; train it again")
    network.load_state_dict(tensors)
    return network.eval()
