"""What an existing directory was made of, read from its manifest, so that all of it can be checked once more."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from edge.artifact_files import MANIFEST_NAME, ArtifactError, read_manifest
from export.calibration import load_calibration
from export.job import Job, WeightSource
from export.model.config import ModelConfigError
from export.model.config_file import config_from_dict
from export.model.weights import WeightsError
from export.target import Target, TargetError, list_targets, load_target, parse_target

WHOLLY_RANDOM = re.compile(r"random seed (\d{1,19})")
FILLED = re.compile(r"(?:^|; )action: random seed (\d{1,19})")


def job_of(
    directory: Path, checkpoints: Sequence[Path], seed: int | None, calibration: str | None
) -> tuple[Job, list[str]]:
    """The job that a directory's manifest tells of, and notes for the user; raises ArtifactError, WeightsError.

    Its thresholds are those it was built under. Weights from files have to be named again: a manifest keeps no paths.
    """
    manifest = read_manifest(directory)
    where = directory / MANIFEST_NAME
    try:
        provenance = manifest["provenance"]
        target = parse_target(provenance["target"], "provenance.target")
        config = config_from_dict(manifest["model"]["config"])
        recorded, origin = provenance["calibration"], str(provenance["weights_origin"])
        name, sha256 = str(recorded["name"]), str(recorded["sha256"])
    except (KeyError, TypeError, AttributeError, TargetError, ModelConfigError) as error:
        raise ArtifactError(f"{where}: provenance cannot be read ({error!s}); export again") from error
    if set(target.graph_names) != set(manifest["graphs"]):
        raise ArtifactError(f"{where}: graphs are not those of provenance.target; export again")
    random = WHOLLY_RANDOM.fullmatch(origin)
    filled = FILLED.search(origin)
    if seed is None and not checkpoints:
        if random is None:
            raise WeightsError(f"{directory}: was made from {origin}; give that with --checkpoint PATH")
        seed = int(random[1])
    elif seed is None and filled is not None:
        seed = int(filled[1])
    found = load_calibration(calibration or name)
    if found.sha256 != sha256:
        raise ArtifactError(
            f"{where}: calibration set {name} has sha256 {sha256[:12]}…, found {found.sha256[:12]}…; "
            f"name the one it was built with by --calibration"
        )
    return Job(target, WeightSource(config, checkpoints, seed), found), _notes(target, config.name)


def _notes(target: Target, model: str) -> list[str]:
    """Thresholds that today's target of that name would ask for instead."""
    if target.name not in list_targets():
        return []
    today = load_target(target.name, model)
    if (today.gates, today.task_gate) == (target.gates, target.task_gate):
        return []
    return [f"note: checked against the thresholds it was built under; target {target.name} has others now"]
