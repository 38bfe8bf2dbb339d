"""A `nano` export for `cpu` as its tests ask for it, and what it wrote."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from export.cli import DEFAULT_CALIBRATION
from export.evaluation.calibration import load_calibration
from export.model.config import PRESETS
from export.pipeline.build import build_stages
from export.pipeline.job import Job, WeightSource
from export.targets.file import load_target
from reporting.progress import BuildProgress

NANO = PRESETS["nano"]
TARGET = load_target("cpu", "nano")


def job(seed: int = 0) -> Job:
    """The export of the weights that a seed names."""
    return Job(TARGET, WeightSource(NANO, [], seed), load_calibration(DEFAULT_CALIBRATION))


def progress() -> BuildProgress:
    """Its progress, on standard error."""
    return BuildProgress("test", build_stages(job(), {}))


def manifest(directory: Path) -> dict[str, Any]:
    """The manifest of an artifact directory, unchecked."""
    content: dict[str, Any] = json.loads((directory / "manifest.json").read_text())
    return content
