"""Inference is tested with nano itself: its kernels and its sizes."""

from __future__ import annotations

from pathlib import Path

import pytest

from edge.artifacts.manifest import Artifacts, load_artifacts


@pytest.fixture(scope="session")
def artifacts_dir(nano_dir: Path) -> Path:
    """Nano's artifacts instead of the narrow network's."""
    return nano_dir


@pytest.fixture(scope="session")
def artifacts(nano_dir: Path) -> Artifacts:
    """The same, verified and loaded."""
    return load_artifacts(nano_dir)
