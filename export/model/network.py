"""The assembled TIC-VLA network and its seeded initial weights."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import torch
from torch import nn
from torch.overrides import TorchFunctionMode

from export.model.action import ActionExpert
from export.model.config import TicVlaConfig
from export.model.language import LanguageModel
from export.model.places import RMS, grid_codes, line_codes
from export.model.value import ValueNetwork
from export.model.vision import VisionEncoder

INIT_STD = 0.02
HEAD_STD = 3e-4
PARTS = ("vision", "language", "action", "value")


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
    """Leaves out torch's own random initial weights: at paper size they cost seconds and are overwritten anyway."""

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
    """A network in evaluation mode whose random weights are still to be written (its norms and buffers are set)."""
    with _SkipRandomInit():
        return TicVla(config).eval()


def initialise(model: TicVla, seed: int, parts: Sequence[str] = PARTS) -> None:
    """Fill every weight of `parts` from one generator, so that a seed names the same weights on every machine."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, module in model.named_modules():
            if name.split(".")[0] not in parts:
                continue
            if isinstance(module, nn.Conv1d | nn.Conv2d):
                # He initialisation: with 0.02 the signal of a frame would fade to nothing in a stack of convolutions.
                fan_in = module.weight[0].numel()
                module.weight.normal_(0.0, (2.0 / fan_in) ** 0.5, generator=generator)
                if module.bias is not None:
                    module.bias.zero_()
            elif isinstance(module, nn.Linear):
                # What a head gives starts near zero; `ActionExpert.start` says around what.
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
            semantic += line_codes(*semantic.shape).flip(0)  # place 0 is the last token
            # Two tokens among hundreds, state and latency: they are to be found before they are understood.
            model.action.metadata_position.mul_(RMS / INIT_STD)
            model.action.start(generator)


def build(config: TicVlaConfig, seed: int) -> TicVla:
    """An untrained network in evaluation mode with the weights that `seed` names."""
    model = empty_network(config)
    initialise(model, seed)
    return model
