"""One rank of a small training, started by a test: shares of a batch, averaged gradients; losses as JSON."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import torch

from tools.train.config.checks import OptimConfig
from tools.train.run.distributed import BatchOrder, Ranks, leave, ranks_of_environment
from tools.train.run.loop import Optimiser

SAMPLES, BATCH, EPOCHS = 50, 8, 3


def train(ranks: Ranks) -> list[float]:
    """Mean loss of every global batch."""
    data = torch.randn(SAMPLES, 4, generator=torch.Generator().manual_seed(1))
    target = data @ torch.tensor([1.0, -2.0, 0.5, 3.0])
    model = torch.nn.Linear(4, 1)
    torch.nn.init.constant_(model.weight, 0.1 * (1 + ranks.rank))
    torch.nn.init.zeros_(model.bias)
    # Ranks that began apart begin alike.
    ranks.copy_parameters(model.parameters())
    order = BatchOrder(SAMPLES, BATCH, EPOCHS, seed=7)
    optimiser = Optimiser(model.parameters(), OptimConfig(lr=0.05, warmup_steps=2), order.steps, ranks)
    losses = []
    for step in range(order.steps):
        # The last batch of an epoch has two samples: with three ranks, one of them has none.
        mine = torch.from_numpy(ranks.share(order.indices(step)))
        loss = torch.zeros(())
        if len(mine):
            loss = (model(data[mine])[:, 0] - target[mine]).pow(2).mean()
            loss.backward()
        losses.append(ranks.mean(float(loss.detach()), len(mine)))
        optimiser.step(weight=len(mine))
    return losses


def main() -> int:
    """Write the losses; every rank to its own file."""
    with ranks_of_environment() as ranks:
        losses = train(ranks)
        Path(sys.argv[1], f"{ranks.rank}.json").write_text(json.dumps(losses))
    return 0


if __name__ == "__main__":
    leave(main())
