"""What an export is asked for, and where its weights come from: loaded when a stage needs them, not before."""

from __future__ import annotations

import gc
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from export.checkpoint.load import Coverage, LoadedCheckpoint, load_checkpoint, shipped_weights
from export.checkpoint.sources import open_source
from export.core.cache import file_sha256
from export.evaluation.calibration import CalibrationSet
from export.evaluation.task_samples import check_clips
from export.model.config import TicVlaConfig
from export.model.network import PARTS, build
from export.model.weights import CheckpointError, WeightsInfo
from export.target.file import Target

DEFAULT_SEED = 0
DIRECTORY_FILES = ("config.json", "tokenizer.json")
"""What a Hugging Face directory says beside its weights."""


class WeightSource:
    """Checkpoints, or a seed, or neither: the weights that ship, if there are some, else a seed.

    The network is in memory only between `get` and `release`.
    """

    def __init__(self, config: TicVlaConfig, checkpoints: Sequence[Path], seed: int | None) -> None:
        if seed is not None and not 0 <= seed < 2**63:
            raise CheckpointError(f"--random-weights {seed}: expected a seed between 0 and 2^63 - 1")
        self.config = config
        if seed is None and not checkpoints and (shipped := shipped_weights(config)) is not None:
            checkpoints = (shipped,)
        self._checkpoints = tuple(checkpoints)
        self._seed = DEFAULT_SEED if seed is None and not checkpoints else seed
        self._loaded: LoadedCheckpoint | None = None

    def fingerprint(self) -> dict[str, object]:
        """What identifies the weights without loading them: the files' hashes and the seed; raises CheckpointError."""
        files: dict[str, str] = {}
        for path in self._checkpoints:
            source = open_source(path)
            files |= {label: file_sha256(file) for label, file in source.files.items()}
            if source.directory is not None:
                beside = [source.directory / name for name in DIRECTORY_FILES]
                files |= {f"{source.label}/{p.name}": file_sha256(p) for p in beside if p.is_file()}
        return {"files": files, "seed": self._seed, "config": self.config.to_dict()}

    def get(self) -> LoadedCheckpoint:
        """The network and the account of its weights; raises CheckpointError."""
        if self._loaded is None:
            self._loaded = self._load()
        return self._loaded

    def release(self) -> None:
        """Give the network's memory back."""
        self._loaded = None
        gc.collect()

    def _load(self) -> LoadedCheckpoint:
        if self._checkpoints:
            return load_checkpoint(self._checkpoints, self.config, fill_seed=self._seed)
        assert self._seed is not None
        info = WeightsInfo(trained=False, origin=f"random seed {self._seed}")
        seeded = dict.fromkeys(PARTS, self._seed)
        return LoadedCheckpoint(build(self.config, self._seed), info, Coverage(seeded=seeded), None)


@dataclass(frozen=True)
class Asked:
    """What the command line named, by which `verify` finds target and network again without trusting their copies."""

    target: str | None = None
    """A target that is shipped; None for a file of the user's."""
    model: str | None = None
    """A preset; None for a file of the user's."""
    settings: tuple[str, ...] = ()
    """Every `--set`, in order."""


@dataclass(frozen=True)
class Job:
    """Everything that an artifact directory follows from."""

    target: Target
    weights: WeightSource
    calibration: CalibrationSet
    asked: Asked = Asked()

    def __post_init__(self) -> None:
        check_clips(self.calibration, self.target.runtime)

    @property
    def config(self) -> TicVlaConfig:
        """The network's numbers."""
        return self.weights.config
