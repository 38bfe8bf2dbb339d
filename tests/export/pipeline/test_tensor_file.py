"""Files of tensors replace earlier ones whole, with the permissions of any other file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from export.core.tensor_file import replacing

TENSORS = {"a": np.arange(3.0)}
FULL = "Error while serializing: I/O error: No space left on device (os error 28)"


def test_a_file_has_the_permissions_of_any_other_file(tmp_path: Path) -> None:
    path, other = tmp_path / "folder" / "model.safetensors", tmp_path / "other"
    other.touch()
    with replacing(path) as partial:
        save_file(TENSORS, partial)
    assert path.stat().st_mode == other.stat().st_mode
    assert list(load_file(path)) == ["a"] and list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("error", [SafetensorError(FULL), KeyboardInterrupt()])
def test_what_fails_leaves_the_earlier_file_and_nothing_else(tmp_path: Path, error: BaseException) -> None:
    path = tmp_path / "model.safetensors"
    path.write_text("earlier")
    with pytest.raises((OSError, KeyboardInterrupt)), replacing(path) as partial:
        partial.write_text("half")
        raise error
    assert path.read_text() == "earlier" and list(tmp_path.iterdir()) == [path]


def test_a_full_disk_is_an_os_error_that_names_the_file(tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    with pytest.raises(OSError, match="No space left on device") as found, replacing(path):
        raise SafetensorError(FULL)
    assert found.value.errno == 28 and found.value.filename == str(path)


def test_other_errors_stay_what_they_are(tmp_path: Path) -> None:
    with pytest.raises(SafetensorError, match="header"), replacing(tmp_path / "model.safetensors"):
        raise SafetensorError("invalid header")
