"""Value network of the reinforcement-learning stage (paper Fig. 3b, appendix A); never exported."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from export.model.attention import projection
from export.model.config import TicVlaConfig


class ValueNetwork(nn.Module):
    """Visual tokens [n, N, D], state [n, 3], relative goal [n, 2] → value [n]."""

    def __init__(self, config: TicVlaConfig) -> None:
        super().__init__()
        width = config.value.channels
        layers: list[nn.Module] = []
        channels = config.vision.token_dim
        for _ in range(config.value.conv_layers):
            layers += [nn.Conv1d(channels, width, 3, stride=2, padding=1), nn.ReLU()]
            channels = width
        self.convolutions = nn.Sequential(*layers, nn.AdaptiveAvgPool1d(1), nn.Flatten())
        self.low_dimensional = projection(5, width)
        self.head = nn.Sequential(nn.Linear(2 * width, width), nn.ReLU(), nn.Linear(width, 1))

    def forward(self, visual_tokens: Tensor, state: Tensor, goal: Tensor) -> Tensor:
        seen = self.convolutions(visual_tokens.transpose(1, 2))
        known = self.low_dimensional(torch.cat([state, goal], dim=-1))
        values: Tensor = self.head(torch.cat([seen, known], dim=-1))
        return values.squeeze(-1)
