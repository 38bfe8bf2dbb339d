"""The error that training raises, number types with ranges that are checked, and the configuration of an optimiser."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Annotated, TypeAlias, get_args, get_type_hints


class TrainError(Exception):
    """Arguments, files, weights or data that cannot be used; one line: what, expected, found, what to do."""


def check_run_folder(out: Path) -> None:
    """Raise TrainError unless a folder is new, empty or that of a run."""
    if (out / "recipe.toml").exists() or not out.exists():
        return
    if not out.is_dir() or any(out.iterdir()):
        raise TrainError(f"{out}: expected a new or empty directory, or a run folder of edge-train")


def check_processes(environment: Mapping[str, str]) -> None:
    """Raise TrainError for variables with which torch could not join the processes that torchrun started."""
    for name in ("WORLD_SIZE", "RANK", "LOCAL_RANK", "LOCAL_WORLD_SIZE"):
        value = environment.get(name, "1")
        if not (value.isascii() and value.isdecimal() and len(value) <= 6) or (name == "WORLD_SIZE" and not int(value)):
            raise TrainError(f"{name} is {value!r:.80}, expected a number from torchrun; unset it to train alone")
    if int(environment.get("WORLD_SIZE", "1")) > 1:
        for name in ("RANK", "MASTER_ADDR", "MASTER_PORT"):
            if not environment.get(name):
                raise TrainError(f"WORLD_SIZE is set without {name}; start the processes with torchrun, or unset it")


@dataclass(frozen=True)
class Range:
    """Numbers from `low` to `high`; `above` excludes `low`, `below` excludes `high`."""

    low: float
    high: float = inf
    above: bool = False
    below: bool = False

    def __contains__(self, value: float) -> bool:
        over = value > self.low if self.above else value >= self.low
        return over and (value < self.high if self.below else value <= self.high)

    def __str__(self) -> str:
        low = f"above {self.low:g}" if self.above else f"from {self.low:g}"
        high = "on" if self.high == inf else f"to below {self.high:.7g}" if self.below else f"to {self.high:.7g}"
        return f"a number {low} {high}"


Share: TypeAlias = Annotated[float, Range(0, 1)]
Fraction: TypeAlias = Annotated[float, Range(0, 1, below=True)]
"""A share below 1."""
Positive: TypeAlias = Annotated[float, Range(0, above=True)]
Natural: TypeAlias = Annotated[int, Range(0)]
Count: TypeAlias = Annotated[int, Range(1)]
Jobs: TypeAlias = Annotated[int, Range(0, 1024)]
"""Number of parallel processes."""
Quality: TypeAlias = Annotated[int, Range(1, 100)]
"""JPEG quality."""


@functools.cache
def ranges_of(config: type) -> Mapping[str, Range]:
    """Return the range of every field of a class that has one."""
    hints = get_type_hints(config, include_extras=True)
    found = {name: [each for each in get_args(hint) if isinstance(each, Range)] for name, hint in hints.items()}
    return {name: ranges[0] for name, ranges in found.items() if ranges}


@dataclass(frozen=True)
class Checked:
    """A configuration whose numbers lie within the ranges of their types. Raises ValueError when it is built."""

    def __post_init__(self) -> None:
        for name, allowed in ranges_of(type(self)).items():  # type: ignore[arg-type]  # as in `typed.build`
            if (value := getattr(self, name)) not in allowed:
                raise ValueError(f"{name}: expected {allowed}, found {value:g}")


@dataclass(frozen=True)
class OptimConfig(Checked):
    """AdamW with warm-up and cosine decay; the defaults are the paper's for the action expert (Table 8)."""

    lr: Annotated[float, Range(0, 1, above=True, below=True)] = 2e-4
    final_lr_share: Share = 0.0
    """Final learning rate as a share of `lr`."""
    weight_decay: Fraction = 1e-2
    warmup_steps: Natural = 1000
    clip: Positive = 1.0
    beta1: Fraction = 0.9
    beta2: Fraction = 0.999
    bf16: bool = False
    """Compute forward passes in bfloat16; weights and moments stay float32."""
