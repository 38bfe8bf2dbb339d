"""Generalised advantage estimation over episodes that end, are cut off, or go on (Schulman et al. 2016; Table 9)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def advantages(
    rewards: Array, values: Array, after: float, *, terminal: bool, gamma: float, lam: float
) -> tuple[Array, Array]:
    """Advantages and returns [S] of one episode's steps.

    `values` [S] are of the states that were acted in; `after` is that of the state after the last step, which counts
    unless the episode is over for good (`terminal`): a cut-off is no end, its future is worth what the value says.
    """
    if rewards.shape != values.shape or rewards.ndim != 1:
        raise ValueError(f"expected as many values as rewards, found {values.shape} and {rewards.shape}")
    found = np.zeros(len(rewards), dtype=np.float64)
    running, next_value = 0.0, 0.0 if terminal else after
    for step in range(len(rewards) - 1, -1, -1):
        error = rewards[step] + gamma * next_value - values[step]
        running = error + gamma * lam * running
        found[step] = running
        next_value = values[step]
    return found, found + values
