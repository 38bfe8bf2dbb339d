"""The settings of an export and the source of its weights, from the command line or from a directory's manifest."""

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
from export.evaluation.calibration import CalibrationError, CalibrationSet, load_calibration
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
DIRECTORY_FILES = ("config.json", "preprocessor_config.json", "tokenizer.json")
"""Files of a Hugging Face directory that are read beside its weights."""


class WeightSource:
    """Source of a network's weights: checkpoints or a seed; without either the shipped weights, else seed 0.

    The network is loaded when a stage first needs it.
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
        """Return the hashes of the files, the seed and the configuration, without loading the weights.

        Raises CheckpointError.
        """
        # A list in the order of reading: two checkpoints may have files of the same name.
        files: list[tuple[str, str]] = []
        for path in self._checkpoints:
            source = open_source(path)
            files += [(label, file_sha256(file)) for label, file in source.files.items()]
            if source.directory is not None:
                beside = [source.directory / name for name in DIRECTORY_FILES]
                files += [(f"{source.label}/{p.name}", file_sha256(p)) for p in beside if p.is_file()]
        return {"files": files, "seed": self._seed, "config": self.config.to_dict()}

    @cached_property
    def loaded(self) -> LoadedCheckpoint:
        """Network with its weights, and which tensors came from where. Raises CheckpointError."""
        if self._checkpoints:
            return load_checkpoint(self._checkpoints, self.config, fill_seed=self._seed)
        assert self._seed is not None
        info = WeightsInfo(trained=False, origin=f"random seed {self._seed}")
        seeded = dict.fromkeys(PARTS, self._seed)
        return LoadedCheckpoint(build(self.config, self._seed), info, Coverage(seeded=seeded), None)


@dataclass(frozen=True)
class ExportRequest:
    """Target, model and settings as the command line named them; `verify` loads both by these names again."""

    target: str | None = None
    """Name of a shipped target; None for the user's own file."""
    model: str | None = None
    """Name of a preset; None for the user's own file."""
    settings: tuple[str, ...] = ()
    """Every `--set`, in order."""


@dataclass(frozen=True)
class Job:
    """All inputs that determine an artifact directory."""

    target: Target
    weights: WeightSource
    calibration: CalibrationSet
    request: ExportRequest = ExportRequest()

    def __post_init__(self) -> None:
        check_clips(self.calibration, self.target.runtime.frame_offsets_s)

    @property
    def config(self) -> TicVlaConfig:
        """Configuration of the network."""
        return self.weights.config


def job_of(
    directory: Path, checkpoints: Sequence[Path], seed: int | None, calibration: str | None
) -> tuple[Job, list[str]]:
    """Return the job that a directory's manifest records, and notes for the user.

    Raises ArtifactError, WeightsError, CalibrationError. Target and network are loaded by the recorded names, with the
    recorded `--set`: the manifest's own copies could have been changed. The user must name weight files again, and a
    calibration of their own, because a manifest keeps no paths.
    """
    manifest = read_manifest(directory)
    where = directory / MANIFEST_NAME
    try:
        provenance = manifest["provenance"]
        request = _request(provenance["asked"])
        target, config = _target_and_config(manifest, request)
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
            raise WeightsError(f"{directory}: built from {origin}; pass these weights with --checkpoint PATH")
        else:
            seed = int(random[1])
    elif seed is None and filled is not None:
        seed = int(filled[1])
    if calibration is None and ":" in name:  # a manifest keeps no paths
        raise CalibrationError(f"{directory}: built with calibration {name}; pass the same with --calibration")
    found = load_calibration(calibration or name)
    if found.sha256 != sha256:
        raise ArtifactError(
            f"{where}: calibration set {name} has sha256 {sha256[:12]}…, found {found.sha256[:12]}…; "
            f"pass the set it was built with as --calibration"
        )
    return Job(target, WeightSource(config, checkpoints, seed), found, request), _notes(request)


def _request(content: Mapping[str, Any]) -> ExportRequest:
    settings = content["settings"]
    named = (content["target"], content["model"])
    if not isinstance(settings, list) or not all(isinstance(s, str) for s in settings):
        raise TypeError("asked.settings must be a list of texts")
    if not all(name is None or isinstance(name, str) for name in named):
        raise TypeError("asked.target and asked.model must be a name or null")
    return ExportRequest(*named, tuple(settings))


def _target_and_config(manifest: Mapping[str, Any], request: ExportRequest) -> tuple[Target, TicVlaConfig]:
    recorded = config_from_dict(manifest["model"]["config"])
    config = recorded
    if request.model is not None:
        config = with_overrides(config_for(request.model), model_settings(request.settings))
    # Parse the copy even if it is not used: an unreadable copy means a damaged manifest.
    target = parse_target(manifest["provenance"]["target"], "provenance.target")
    if request.target is not None:
        if request.target not in list_targets():
            raise TargetError(f"unknown target {request.target!r}")
        target = with_settings(load_target(request.target, config.name), request.settings)
    return target, config


def _notes(request: ExportRequest) -> list[str]:
    """Return notes about thresholds that differ from those of a shipped target."""
    if request.target is None:
        return ["note: built for the user's own target file; checked against the thresholds in the manifest"]
    moved = [setting for setting in request.settings if setting.strip().startswith("gates.")]
    return [f"note: thresholds were changed with --set for this build: {', '.join(moved)}"] if moved else []
