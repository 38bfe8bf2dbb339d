"""The torch model as `Stages`: in fp32 the reference of every task error, or with graphs rounded as they would ship."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import cast

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from edge.reasoning.prompt import Segment
from export.graphs.build import linear_layers
from export.model.network import TicVla
from export.quantize.precision import Precision
from export.quantize.rounding import Rounder

Floats = npt.NDArray[np.float32]


def prompt_tensors(model: TicVla, prompt: Sequence[Segment]) -> tuple[Tensor, Tensor]:
    """Ids [1, T] and visual tokens [F, N, D] of a whole prompt, for one call."""
    ids = torch.tensor([[token for segment in prompt for token in segment.ids]])
    frames = [torch.from_numpy(segment.tokens) for segment in prompt if segment.tokens is not None]
    vision = model.config.vision
    visual = torch.cat(frames) if frames else torch.zeros(1, vision.tokens, vision.token_dim)
    return ids, visual


def empty_past(model: TicVla) -> list[Tensor]:
    """KV caches before the first token."""
    c = model.config.language
    return [torch.zeros(1, c.kv_heads, 0, c.head_dim) for _ in range(2 * c.layers)]


class TorchStages:
    """`model` with the graphs named in `precisions` rounded; the others compute in fp32."""

    def __init__(
        self,
        model: TicVla,
        precisions: Mapping[str, Precision] | None = None,
        *,
        rounder: Rounder | None = None,
        activations: bool = True,
    ) -> None:
        self.model = model
        self._precisions = dict(precisions or {})
        self._rounder = rounder or Rounder()
        self._activations = activations

    def encode(self, frame: npt.NDArray[np.uint8]) -> Floats:
        """See `Stages`."""
        with torch.no_grad(), self._graph("vision_encoder", self.model.vision):
            return _array(self.model.vision(torch.from_numpy(frame)))

    def language(self, prompt: Sequence[Segment], new_tokens: int) -> tuple[Floats, tuple[int, ...]]:
        """See `Stages`; the prompt goes through one call, which chunks would not change."""
        ids, visual = prompt_tensors(self.model, prompt)
        language, end = self.model.language, self.model.config.language.im_end_id
        with torch.no_grad(), self._graph("language_model", language):
            if new_tokens == 0:
                return _array(language.hidden_states(ids, visual, empty_past(self.model))[2]), ()
            next_id, _, kv, *past = language(ids, visual, empty_past(self.model))
            found: list[int] = []
            while len(found) < new_tokens and int(next_id) != end:
                found.append(int(next_id))
                if len(found) < new_tokens:
                    next_id, _, _, *past = language(next_id, visual[:1], past)
        return _array(kv), tuple(found)

    def context(self, guidance: Floats) -> tuple[Floats, Floats]:
        """See `Stages`."""
        with torch.no_grad(), self._graph("semantic_context", self.model.action):
            keys, values = self.model.action.context(torch.from_numpy(guidance))
        return _array(keys), _array(values)

    def act(self, visual_tokens: Floats, state: Floats, latency: Floats, keys: Floats, values: Floats) -> Floats:
        """See `Stages`."""
        tensors = [torch.from_numpy(array) for array in (visual_tokens, state, latency, keys, values)]
        with torch.no_grad(), self._graph("action_expert", self.model.action):
            return _array(self.model.action(*tensors))

    def _graph(self, name: str, part: nn.Module) -> AbstractContextManager[None]:
        precision = self._precisions.get(name)
        if precision is None:
            return nullcontext()
        layers = linear_layers(self.model.config, name)
        return self._rounder.applied(part, precision, layers, activations=self._activations)


def _array(tensor: Tensor) -> Floats:
    return cast(Floats, np.ascontiguousarray(tensor.numpy()))
