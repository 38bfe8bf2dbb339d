"""What an existing directory was made of, read from its manifest, so that all of it can be checked once more."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from edge.artifacts.files import MANIFEST_NAME, ArtifactError, read_manifest
from export.checkpoint.load import shipped_weights
from export.evaluation.calibration import load_calibration
from export.model.config import (
    ModelConfigError,
    TicVlaConfig,
    config_for,
    config_from_dict,
    model_settings,
    with_overrides,
)
from export.model.weights import WeightsError
from export.pipeline.job import Asked, Job, WeightSource
from export.target.file import Target, TargetError, list_targets, load_target, parse_target, with_settings

WHOLLY_RANDOM = re.compile(r"random seed (\d{1,19})")
FILLED = re.compile(r"(?:^|; )action: random seed (\d{1,19})")
SHOWN_CHARACTERS = 60


def job_of(
    directory: Path, checkpoints: Sequence[Path], seed: int | None, calibration: str | None
) -> tuple[Job, list[str]]:
    """The job that a directory's manifest tells of, and notes for the user; raises ArtifactError, WeightsError.

    Target and network are today's of the names that were asked for, with the `--set` of then: what the manifest says of
    them vouches for nothing. Weights from files have to be named again: a manifest keeps no paths.
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


def first_difference(found: object, expected: object, key: str) -> str | None:
    """The first key at which two JSON values differ, with both, in words; None when they are the same."""
    if isinstance(found, dict) and isinstance(expected, dict):
        for name in [*expected, *(name for name in found if name not in expected)]:
            below = f"{key}.{name}"
            if name not in found:
                return f"{below} is missing"
            if name not in expected:
                return f"{below} is of no export"
            said = first_difference(found[name], expected[name], below)
            if said is not None:
                return said
        # Of a precision's exceptions the first that matches wins.
        return None if list(found) == list(expected) or not key.endswith("overrides") else f"{key} is in another order"
    same = type(found) is type(expected) and found == expected
    return None if same else f"{key} is {_shown(found)}, this export writes {_shown(expected)}"


def _shown(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= SHOWN_CHARACTERS else f"{text[:SHOWN_CHARACTERS]}…"
