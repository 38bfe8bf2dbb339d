"""What an export is asked for and where its weights come from, by the command line or by a directory's manifest."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from edge.artifacts.files import MANIFEST_NAME, ArtifactError, read_manifest
from export.checkpoint.load import Coverage, LoadedCheckpoint, load_checkpoint, shipped_weights
from export.checkpoint.sources import open_source
from export.core.cache import file_sha256
from export.evaluation.calibration import CalibrationSet, load_calibration
from export.evaluation.task_samples import check_clips
from export.model.config import (
    ModelConfigError,
    TicVlaConfig,
    config_for,
    config_from_dict,
    model_settings,
    with_overrides,
)
from export.model.network import PARTS, build
from export.model.weights import CheckpointError, WeightsError, WeightsInfo
from export.targets.file import Target, list_targets, load_target, parse_target, with_settings
from export.targets.sections import TargetError

DEFAULT_SEED = 0
WHOLLY_RANDOM = re.compile(r"random seed (\d{1,19})")
FILLED = re.compile(r"(?:^|; )action: random seed (\d{1,19})")
DIRECTORY_FILES = ("config.json", "tokenizer.json")
"""Read from a Hugging Face directory beside its weights."""


class WeightSource:
    """Checkpoints, or a seed, or neither: the weights that ship, if there are some, else a seed.

    The network is loaded when a stage needs it, not before.
    """

    def __init__(self, config: TicVlaConfig, checkpoints: Sequence[Path], seed: int | None) -> None:
        if seed is not None and not 0 <= seed < 2**63:
            raise CheckpointError(f"--random-weights {seed}: expected a seed between 0 and 2^63 - 1")
        self.config = config
        if seed is None and not checkpoints and (shipped := shipped_weights(config)) is not None:
            checkpoints = (shipped,)
        self._checkpoints = tuple(checkpoints)
        self._seed = DEFAULT_SEED if seed is None and not checkpoints else seed

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

    @cached_property
    def loaded(self) -> LoadedCheckpoint:
        """The network and the account of its weights; raises CheckpointError."""
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
        check_clips(self.calibration, self.target.runtime.frame_offsets_s)

    @property
    def config(self) -> TicVlaConfig:
        """The network's numbers."""
        return self.weights.config


def job_of(
    directory: Path, checkpoints: Sequence[Path], seed: int | None, calibration: str | None
) -> tuple[Job, list[str]]:
    """The job of a directory's manifest, and notes for the user; raises ArtifactError, WeightsError.

    Target and network are today's of the names that were asked for, with the `--set` of then: the manifest's own copies
    vouch for nothing. Weights from files have to be named again: a manifest keeps no paths.
    """
    manifest = read_manifest(directory)
    where = directory / MANIFEST_NAME
    try:
        provenance = manifest["provenance"]
        asked = _asked(provenance["asked"])
        target, config = _target_and_config(manifest, asked)
        recorded, origin = provenance["calibration"], str(provenance["weights_origin"])
        name, sha256 = str(recorded["name"]), str(recorded["sha256"])
    except (KeyError, TypeError, AttributeError, TargetError, ModelConfigError) as error:
        raise ArtifactError(f"{where}: provenance cannot be read ({error!s}); export again") from error
    if set(target.graph_names) != set(manifest["graphs"]):
        raise ArtifactError(f"{where}: graphs are not those of target {target.name}; export again")
    random = WHOLLY_RANDOM.fullmatch(origin)
    filled = FILLED.search(origin)
    if seed is None and not checkpoints:
        if random is None and (shipped := shipped_weights(config)) is not None:
            checkpoints = (shipped,)
        elif random is None:
            raise WeightsError(f"{directory}: was made from {origin}; give that with --checkpoint PATH")
        else:
            seed = int(random[1])
    elif seed is None and filled is not None:
        seed = int(filled[1])
    found = load_calibration(calibration or name)
    if found.sha256 != sha256:
        raise ArtifactError(
            f"{where}: calibration set {name} has sha256 {sha256[:12]}…, found {found.sha256[:12]}…; "
            f"name the one it was built with by --calibration"
        )
    return Job(target, WeightSource(config, checkpoints, seed), found, asked), _notes(asked)


def _asked(content: Mapping[str, Any]) -> Asked:
    settings = content["settings"]
    named = (content["target"], content["model"])
    if not isinstance(settings, list) or not all(isinstance(s, str) for s in settings):
        raise TypeError("asked.settings must be a list of texts")
    if not all(name is None or isinstance(name, str) for name in named):
        raise TypeError("asked.target and asked.model must be a name or null")
    return Asked(*named, tuple(settings))


def _target_and_config(manifest: Mapping[str, Any], asked: Asked) -> tuple[Target, TicVlaConfig]:
    recorded = config_from_dict(manifest["model"]["config"])
    config = recorded
    if asked.model is not None:
        config = with_overrides(config_for(asked.model), model_settings(asked.settings))
    # Read in any case: a manifest whose copy cannot be read is damaged.
    target = parse_target(manifest["provenance"]["target"], "provenance.target")
    if asked.target is not None:
        if asked.target not in list_targets():
            raise TargetError(f"target {asked.target!r} is not known")
        target = with_settings(load_target(asked.target, config.name), asked.settings)
    return target, config


def _notes(asked: Asked) -> list[str]:
    """Where a directory is held to something else than what a shipped target asks for."""
    if asked.target is None:
        return ["note: built for a target file of its own; checked against the thresholds that the manifest gives"]
    moved = [setting for setting in asked.settings if setting.strip().startswith("gates.")]
    return [f"note: thresholds were set when it was built: {', '.join(moved)}"] if moved else []
