"""Model variants: one artifact directory each, selected and checked by name.

`--policy artifacts:DIR --variant NAME` uses DIR/NAME if it exists, else DIR itself. For a name in the table below, the
manifest must describe that model. Any other name (`rl`, `no-rl`, ...) only selects a sub-directory.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from edge.artifacts.files import MANIFEST_NAME, read_manifest
from edge.artifacts.manifest import Artifacts
from sim_hil.benchmark.conditions.conditions import ConditionsError

_AS_IN_THE_PAPER: Mapping[str, Any] = {
    "semantic_interface": "kv",
    "latency_aware": True,
    "motion_offset": True,
    "horizon_s": 3.0,
    "layers": 6,
    "head": "query",
}
_CHANGED: Mapping[str, Mapping[str, Any]] = {
    "full": {},
    "waypoints": {"semantic_interface": "waypoints"},
    "waypoints-no-latency": {"semantic_interface": "waypoints", "latency_aware": False},
    "no-latency": {"latency_aware": False},
    "no-motion-offset": {"motion_offset": False},
    "horizon-1s": {"horizon_s": 1.0},
    "horizon-5s": {"horizon_s": 5.0},
    "depth-3": {"layers": 3},
    "depth-12": {"layers": 12},
    "diffusion": {"head": "diffusion"},
    "flow": {"head": "flow"},
}
VARIANTS = {name: {**_AS_IN_THE_PAPER, **changed} for name, changed in _CHANGED.items()}
"""Configuration of the action expert in each ablation of the paper (tables 2, 5, 6, 11, 13)."""


def artifact_directory(root: Path, variant: str | None) -> Path:
    """Return the artifact directory of a variant. Raises ConditionsError if there is none."""
    if variant is None:
        return root
    own = root / variant
    if (own / MANIFEST_NAME).is_file():
        return own
    if variant in VARIANTS and (root / MANIFEST_NAME).is_file():
        return root
    expected = f"{own}, or artifacts of that variant in {root}" if variant in VARIANTS else str(own)
    raise ConditionsError(f"--variant {variant}: expected {expected}; export it there (edge-export --out)")


def check_variant(artifacts: Artifacts, variant: str | None) -> None:
    """Raise ConditionsError if the model differs from the variant's entry in `VARIANTS`."""
    if variant is None or variant not in VARIANTS:
        return
    found = described(artifacts)
    for key, value in VARIANTS[variant].items():
        if found[key] != value:
            raise ConditionsError(
                f"--variant {variant}: expected a model with {key} {value}, {artifacts.directory} has {found[key]}"
            )


def described(artifacts: Artifacts) -> dict[str, Any]:
    """Read the action expert's configuration from the manifest, with the keys of `VARIANTS`.

    Raises ConditionsError.
    """
    try:
        action = read_manifest(artifacts.directory)["model"]["config"]["action"]
        horizon_s = round(float(action["steps"]) * float(action["step_s"]), 6)
        return {**_AS_IN_THE_PAPER, **action, "horizon_s": horizon_s}
    except (KeyError, TypeError, ValueError) as error:
        raise ConditionsError(
            f"{artifacts.directory}/{MANIFEST_NAME}: expected a description of the model ({error!r}); export again"
        ) from error
