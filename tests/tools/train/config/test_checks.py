"""Checks of folder and environment, which `edge-train` makes before it loads torch."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.train.config.checks import TrainError, check_processes, check_run_folder

TORCHRUN = {"WORLD_SIZE": "2", "RANK": "0", "LOCAL_RANK": "0", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "29500"}


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({"WORLD_SIZE": "x"}, "WORLD_SIZE is 'x', expected a number from torchrun"),
        ({"WORLD_SIZE": "0"}, "WORLD_SIZE is '0'"),
        ({"WORLD_SIZE": "9" * 5000}, "WORLD_SIZE is '9"),
        ({"RANK": "-1"}, "RANK is '-1'"),
        ({"LOCAL_WORLD_SIZE": "\N{ARABIC-INDIC DIGIT THREE}"}, "LOCAL_WORLD_SIZE is"),
        ({"WORLD_SIZE": "2"}, "WORLD_SIZE is set without RANK"),
        ({"WORLD_SIZE": "2", "RANK": "0"}, "WORLD_SIZE is set without MASTER_ADDR"),
    ],
)
def test_variables_that_torchrun_does_not_set_so_are_refused(variables: dict[str, str], message: str) -> None:
    with pytest.raises(TrainError, match=message):
        check_processes(variables)


@pytest.mark.parametrize("variables", [{}, {"WORLD_SIZE": "1"}, TORCHRUN])
def test_a_process_alone_or_from_torchrun_is_accepted(variables: dict[str, str]) -> None:
    check_processes(variables)


def test_a_folder_with_other_files_is_no_run_folder(tmp_path: Path) -> None:
    check_run_folder(tmp_path / "new")
    check_run_folder(tmp_path)
    (tmp_path / "mine").touch()
    with pytest.raises(TrainError, match="expected a new or empty directory, or a run folder"):
        check_run_folder(tmp_path)
    (tmp_path / "recipe.toml").touch()
    check_run_folder(tmp_path)
