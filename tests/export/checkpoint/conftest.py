"""A small InternVL checkpoint."""

from __future__ import annotations

from pathlib import Path

import pytest
from torch import Tensor

from tests.support.export.internvl import hf_model, original_tensors, write_directory


@pytest.fixture(scope="session")
def original() -> dict[str, Tensor]:
    return original_tensors(hf_model())


@pytest.fixture
def vlm(original: dict[str, Tensor], tmp_path: Path) -> Path:
    """A directory in OpenGVLab's layout."""
    return write_directory(tmp_path / "vlm", original)
