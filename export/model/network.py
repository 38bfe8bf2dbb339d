"""The assembled TIC-VLA network and its seeded initial weights."""

from __future__ import annotations

import torch
from torch import nn

from export.model.action import ActionExpert
from export.model.config import TicVlaConfig
from export.model.language import LanguageModel
from export.model.value import ValueNetwork
from export.model.vision import VisionEncoder

INIT_STD = 0.02
HEAD_STD = 3e-4


class TicVla(nn.Module):
    """Shared vision encoder, language model, action expert and (training only) value network."""

    def __init__(self, config: TicVlaConfig) -> None:
        super().__init__()
        self.config = config
        self.vision = VisionEncoder(config.vision)
        self.language = LanguageModel(config.language, config.vision.token_dim)
        self.action = ActionExpert(config)
        self.value = ValueNetwork(config)


def initialise(model: TicVla, seed: int) -> None:
    """Fill every weight from one generator, so that a seed names the same weights on every machine."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, module in model.named_modules():
            if isinstance(module, nn.Conv1d | nn.Conv2d):
                # He initialisation: with 0.02 the signal of a frame would fade to nothing in a stack of convolutions.
                fan_in = module.weight[0].numel()
                module.weight.normal_(0.0, (2.0 / fan_in) ** 0.5, generator=generator)
                if module.bias is not None:
                    module.bias.zero_()
            elif isinstance(module, nn.Linear):
                std = HEAD_STD if name == "action.out" else max(INIT_STD, module.in_features**-0.5)
                module.weight.normal_(0.0, std, generator=generator)
                if module.bias is not None:
                    module.bias.zero_()
            elif isinstance(module, nn.Embedding):
                module.weight.normal_(0.0, 1.0, generator=generator)
        for name, parameter in model.named_parameters():
            if name.endswith(("position", "cls", "queries")):
                parameter.normal_(0.0, 1.0 if name.endswith("queries") else INIT_STD, generator=generator)
        # The head starts near zero around a slow walk straight ahead, as policies usually start at their mean action.
        model.action.out.bias.copy_(torch.tensor(model.config.action.initial_step))


def build(config: TicVlaConfig, seed: int) -> TicVla:
    """An untrained network in evaluation mode with the weights that `seed` names."""
    model = TicVla(config)
    initialise(model, seed)
    return model.eval()
