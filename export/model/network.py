"""The assembled TIC-VLA network and its seeded initial weights."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from math import isqrt, pi
from typing import Any, Final

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from export.model.action import ActionExpert
from export.model.attention import projection
from export.model.config import TicVlaConfig
from export.model.language import LanguageModel
from export.model.vision import VisionEncoder

INIT_STD = 0.02
HEAD_STD = 3e-4
PLACE_RMS: Final = 0.5
"""Initial magnitude of a position's code; token values are about 1.

Position codes that started near zero were still negligible after 1000 steps, beside tokens forty times as large.
"""
_SHORTEST: Final = 4.0  # wavelength, positions
PARTS = ("vision", "language", "action", "value")


def line_codes(count: int, width: int) -> Tensor:
    """Return sinusoidal codes of the positions 0, 1, … on a line: [count, width] float32."""
    pairs = (width + 1) // 2
    lengths = _SHORTEST * float(count) ** (torch.arange(pairs) / max(pairs - 1, 1))
    angle = 2 * pi * torch.arange(count)[:, None] / lengths
    return (PLACE_RMS * 2**0.5 * torch.stack([angle.sin(), angle.cos()], dim=-1)).flatten(1)[:, :width]


def grid_codes(count: int, width: int) -> Tensor:
    """Return codes of a square's positions, row by row, [count, width] float32; half of each code is the row's.

    Raises ValueError if `count` is no square.
    """
    side = isqrt(count)
    if side * side != count:
        raise ValueError(f"positions: expected a square number of tokens, found {count}")
    rows, columns = line_codes(side, width // 2), line_codes(side, width - width // 2)
    return torch.cat([rows.repeat_interleave(side, 0), columns.repeat(side, 1)], dim=1)


class ValueNetwork(nn.Module):
    """Visual tokens [n, N, D], state [n, 3], relative goal [n, 2] → value [n] (paper Fig. 3b); never exported."""

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


class TicVla(nn.Module):
    """Shared vision encoder, language model, action expert and (training only) value network."""

    def __init__(self, config: TicVlaConfig) -> None:
        super().__init__()
        self.config = config
        self.vision = VisionEncoder(config.vision)
        self.language = LanguageModel(config.language, config.vision.token_dim)
        self.action = ActionExpert(config)
        self.value = ValueNetwork(config)


class _SkipRandomInit(TorchFunctionMode):
    """Skips torch's random initial weights, which take seconds at paper size and are overwritten."""

    SKIPPED = (nn.init.kaiming_uniform_, nn.init.uniform_, nn.init.normal_)

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Collection[type],
        args: Sequence[Any] = (),
        kwargs: Mapping[str, object] | None = None,
    ) -> Any:
        if func in self.SKIPPED:
            return args[0] if args else (kwargs or {})["tensor"]
        return func(*args, **(kwargs or {}))


def empty_network(config: TicVlaConfig) -> TicVla:
    """Create a network in evaluation mode with unset weights; norms and buffers are set."""
    with _SkipRandomInit():
        return TicVla(config).eval()


def initialise(model: TicVla, seed: int, parts: Sequence[str] = PARTS) -> None:
    """Fill every weight of `parts` from one generator, so that a seed gives the same weights on every machine."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, module in model.named_modules():
            if name.split(".")[0] not in parts:
                continue
            if isinstance(module, nn.Conv1d | nn.Conv2d):
                # He initialisation: with 0.02 a frame's signal would vanish in a stack of convolutions.
                fan_in = module.weight[0].numel()
                module.weight.normal_(0.0, (2.0 / fan_in) ** 0.5, generator=generator)
                if module.bias is not None:
                    module.bias.zero_()
            elif isinstance(module, nn.Linear):
                # Outputs of a head start near zero; `ActionExpert.start` sets their centre.
                ends = name.startswith("action.") and name.endswith(".out")
                std = HEAD_STD if ends else max(INIT_STD, module.in_features**-0.5)
                module.weight.normal_(0.0, std, generator=generator)
                if module.bias is not None:
                    module.bias.zero_()
            elif isinstance(module, nn.Embedding):
                module.weight.normal_(0.0, 1.0, generator=generator)
        for name, parameter in model.named_parameters():
            if name.split(".")[0] in parts and name.endswith(("position", "cls", "queries")):
                parameter.normal_(0.0, 1.0 if name.endswith("queries") else INIT_STD, generator=generator)
        if "vision" in parts:
            model.vision.position[0, 1:] += grid_codes(
                model.vision.position.shape[1] - 1, model.vision.position.shape[2]
            )
        if "action" in parts:
            visual, semantic = model.action.visual_position[0], model.action.semantic_position[0]
            visual += grid_codes(*visual.shape)
            semantic += line_codes(*semantic.shape).flip(0)  # position 0 is the last token
            # State and latency are two tokens among hundreds: larger initial codes let attention find them.
            model.action.metadata_position.mul_(PLACE_RMS / INIT_STD)
            model.action.start(generator)


def build(config: TicVlaConfig, seed: int) -> TicVla:
    """Create an untrained network in evaluation mode with the weights of a seed."""
    model = empty_network(config)
    initialise(model, seed)
    return model
