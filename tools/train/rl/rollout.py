"""Recorded steps of rollouts: everything that PPO needs, with the outputs of frozen layers computed once.

Each worker job writes one safetensors file with S steps of E episodes and G generations.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save_file

from export.core.tensor_file import replacing
from tools.train.config.checks import TrainError

FORMAT: Final = "tic-vla-edge-rollout/1"
GOAL_SCALE_M: Final = 10.0
"""Unit of goal coordinates for the value network, m."""
GOAL_FARTHEST_M: Final = 40.0
"""Goals farther away are clipped to this distance for the value network, m."""

Floats = npt.NDArray[np.float32]


@dataclass(frozen=True)
class EpisodeEnd:
    """Outcome of one driven episode. `terminal`: the goal was reached or the robot fell; otherwise it was cut off."""

    id: str
    kind: str
    people: int
    steps: int
    end: str
    terminal: bool
    success: bool
    collided: bool
    reward: float
    spl: float
    time_s: float


@dataclass(frozen=True)
class PolicyOutput:
    """A policy's mean command (v m/s, ω rad/s) in one control period, and what PPO needs beside the observation."""

    mean: tuple[float, float]
    queries: Floats | None = None
    latency: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    generation: int = 0
    speed_scale: float = 1.0
    """Share of the speed limits, 0 to 1, that the robot's monitor leaves; below 1 if the semantic state is too old."""


@dataclass
class EpisodeSteps:
    """Steps of one episode while it is driven; a step is one control period with a semantic state to act on.

    `rows` by name: `visual` tokens [N, D], `state`, `latency`, `goal`, `action`, `reward`, `generation` (index into
    `semantic`) and, of a policy with frozen layers, `queries` [steps, hidden] before its last layer. `semantic`: tokens
    [T, hidden] of each generation. `after`: `visual`, `state` and `goal` after the last step.
    """

    rows: dict[str, list[Any]] = field(default_factory=dict)
    semantic: list[Floats] = field(default_factory=list)
    after: dict[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.rows.get("reward", ()))

    def add(self, chosen: PolicyOutput, **values: Any) -> None:
        """Append a step in which the policy acted; `values`: `visual`, `state`, `goal`, `action` and `reward`."""
        values |= {"latency": chosen.latency, "generation": chosen.generation}
        if chosen.queries is not None:
            values["queries"] = chosen.queries
        for name, value in values.items():
            self.rows.setdefault(name, []).append(value)


def goal_features(x_m: float, y_m: float) -> tuple[float, float]:
    """Convert a goal in the robot frame to the value network's input: clipped to 40 m, in tens of metres."""
    distance = float(np.hypot(x_m, y_m))
    share = min(1.0, GOAL_FARTHEST_M / max(distance, 1e-9)) / GOAL_SCALE_M
    return (x_m * share, y_m * share)


def save(path: Path, episodes: Sequence[tuple[EpisodeSteps, EpisodeEnd]]) -> None:
    """Write a job's episodes atomically; of an episode without steps only its end is written."""
    driven = [steps for steps, _ in episodes if len(steps)]
    arrays: dict[str, npt.NDArray[Any]] = {}
    if driven:
        firsts = np.cumsum([0, *(len(steps.semantic) for steps in driven)])
        for name in driven[0].rows:
            arrays[name] = np.concatenate([np.array(steps.rows[name], np.float32) for steps in driven])
        for name in ("visual", "state", "goal"):
            arrays[f"after_{name}"] = np.array([steps.after[name] for steps in driven], np.float32)
        numbers = [np.array(steps.rows["generation"], np.int64) for steps in driven]
        arrays["generation"] = np.concatenate([each + first for each, first in zip(numbers, firsts, strict=False)])
        if "queries" in arrays:
            semantic = [each for steps in driven for each in steps.semantic]
            arrays["semantic"] = np.concatenate(semantic).astype(np.float32)
            arrays["semantic_end"] = np.cumsum([len(each) for each in semantic]).astype(np.int64)
    ends = [asdict(end) for _, end in episodes]
    with replacing(path) as partial:
        save_file(arrays, str(partial), metadata={"format": FORMAT, "ends": json.dumps(ends)})


@dataclass(frozen=True)
class Rollout:
    """All steps of one iteration, episode after episode. Shapes as in `EpisodeSteps`, stacked over S steps."""

    arrays: dict[str, npt.NDArray[Any]]
    semantic: tuple[Floats, ...]
    ends: tuple[EpisodeEnd, ...]

    @property
    def steps(self) -> int:
        """Number of steps."""
        return len(self.arrays["reward"]) if self.arrays else 0

    def episodes(self) -> Iterator[tuple[slice, int, EpisodeEnd]]:
        """Yield each episode that has steps: its slice of steps, its row in `after_*`, and its end."""
        start = number = 0
        for end in self.ends:
            if end.steps:
                yield slice(start, start + end.steps), number, end
                start, number = start + end.steps, number + 1


def read(paths: Sequence[Path]) -> Rollout:
    """Read the jobs' files as one rollout, in the order given. Raises TrainError, OSError."""
    parts: list[dict[str, npt.NDArray[Any]]] = []
    semantic: list[Floats] = []
    ends: list[EpisodeEnd] = []
    for path in paths:
        arrays, found = _read(path)
        ends += found
        if not arrays:
            continue
        if "semantic" in arrays:
            rows = np.split(arrays.pop("semantic"), arrays.pop("semantic_end")[:-1])
            arrays["generation"] = arrays["generation"] + len(semantic)
            semantic += rows
        parts.append(arrays)
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]} if parts else {}
    if joined and sum(end.steps for end in ends) != len(joined["reward"]):
        raise TrainError(f"rollout {paths[0].parent}: the number of steps differs from the sum over its episodes")
    return Rollout(joined, tuple(semantic), tuple(ends))


def _read(path: Path) -> tuple[dict[str, npt.NDArray[Any]], list[EpisodeEnd]]:
    try:
        with safe_open(str(path), framework="np") as file:
            header = file.metadata() or {}
            if header.get("format") != FORMAT:
                raise TrainError(f"rollout {path}: expected format {FORMAT}, found {header.get('format')}")
            ends = [EpisodeEnd(**end) for end in json.loads(header["ends"])]
            return {name: file.get_tensor(name) for name in file.keys()}, ends  # noqa: SIM118 — not a mapping
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        raise TrainError(f"rollout {path}: not readable ({error})") from error
