"""The action expert split before its last cross-attention layer: the frozen prefix and the tail that PPO trains.

Paper, appendix D: "we finetune only the final cross-attention Transformer layer and the MLP decoder". The prefix is
frozen, so its output is computed once in a rollout and reused in every epoch of the optimisation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

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
