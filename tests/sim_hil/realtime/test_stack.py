"""The stack as a context manager, without its processes."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import pytest

from sim_hil.realtime.robots import GO2, StackRobotError
from sim_hil.realtime.stack import Stack, StackOptions


def test_a_stack_whose_robot_file_cannot_be_written_leaves_no_folder_of_sockets(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sockets = tmp_path / "tmp"
    sockets.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(sockets))
    robot = replace(GO2, shipped="nowhere.toml")
    with pytest.raises(StackRobotError, match="cannot be read"):
        Stack(StackOptions(tmp_path, tmp_path, "office", (0.0, 0.0, 0.0), 0, 0, 1, robot=robot))
    assert list(sockets.iterdir()) == []
