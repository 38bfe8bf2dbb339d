"""References in files: test inputs with PyTorch's outputs, and PyTorch's plans on the calibration set."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load_file, save_file

from export.evaluation.metrics import Sample
from export.evaluation.task_error import StageOutputs


def save_samples(samples: Sequence[Sample], path: Path) -> None:
    """Write test inputs and expected outputs to one safetensors file."""
    tensors = {
        f"{index}/{kind}/{name}": np.ascontiguousarray(array)
        for index, sample in enumerate(samples)
        for kind, arrays in (("feed", sample.feeds), ("expected", sample.expected))
        for name, array in arrays.items()
    }
    save_file(tensors, path)


def load_samples(path: Path) -> list[Sample]:
    """Inverse of `save_samples`."""
    samples: dict[int, Sample] = {}
    for key, array in load_file(path).items():
        index, kind, name = key.split("/", 2)
        sample = samples.setdefault(int(index), Sample({}, {}))
        (sample.feeds if kind == "feed" else sample.expected)[name] = array
    return [samples[index] for index in sorted(samples)]


def save_outputs(outputs: StageOutputs, path: Path) -> None:
    """Write the reference of the task error to one safetensors file."""
    tensors = {
        f"{kind}/{index}": np.ascontiguousarray(array)
        for kind in ("visual", "kv", "trajectories", "swapped")
        for index, array in enumerate(getattr(outputs, kind))
    }
    tensors |= {f"token_ids/{index}": np.array(ids, dtype=np.int64) for index, ids in enumerate(outputs.token_ids)}
    save_file(tensors, path)


def load_outputs(path: Path) -> StageOutputs:
    """Inverse of `save_outputs`."""
    tensors = load_file(path)

    def of(kind: str) -> tuple[Any, ...]:
        count = sum(key.startswith(f"{kind}/") for key in tensors)
        return tuple(tensors[f"{kind}/{index}"] for index in range(count))

    token_ids = tuple(tuple(int(token) for token in ids) for ids in of("token_ids"))
    return StageOutputs(of("visual"), of("kv"), token_ids, of("trajectories"), of("swapped"))
