"""What holds for every stage that learns in steps: ended or killed it goes on exactly, and two processes are as one."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import pytest
import torch

from tools.train.config.checks import TrainError
from tools.train.run.job import QuietProgress, StopFlag

ROOT = Path(__file__).parents[3]


class Run(NamedTuple):
    """What a run has left: the network's weights, its log, and its result."""

    weights: Mapping[str, torch.Tensor]
    lines: list[dict[str, Any]]
    result: dict[str, Any]


class StopAfter(QuietProgress):
    """Asks to end after so many steps of learning."""

    def __init__(self, steps: int) -> None:
        self.flag = StopFlag()
        self._steps = steps

    def update(self, done: int, total: int, **numbers: float) -> None:
        if "loss" in numbers and done == self._steps:
            self.flag.requested = True


class DiesAt(QuietProgress):
    """Ends the process's work in the middle of a step, as a signal would that nobody can answer."""

    def __init__(self, step: int) -> None:
        self._step = step

    def update(self, done: int, total: int, **numbers: float) -> None:
        if "loss" in numbers and done == self._step:
            raise OSError


class StageContract:
    """A module's class with `train`; the module has a fixture `whole`, a run of its CONFIG that nobody ended."""

    rank: ClassVar[str]
    """Module that is one of two processes: `python -m MODULE [DRIVES] OUT`."""
    other: ClassVar[Any]
    """Numbers of another recipe."""

    def train(self, out: Path, config: Any = None, **options: Any) -> Run:
        """Run the stage in a folder; `options` are the job's."""
        raise NotImplementedError

    def prepare(self, out: Path) -> list[str]:
        """Lay out what ranks share; gives what they are told before the folder."""
        return []

    @pytest.mark.parametrize("steps", [1, 3, 5])
    def test_a_run_that_was_ended_goes_on_as_if_it_had_not_been(self, tmp_path: Path, whole: Run, steps: int) -> None:
        stopping = StopAfter(steps)
        with pytest.raises(KeyboardInterrupt):
            self.train(tmp_path, progress=stopping, stop=stopping.flag)
        again = self.train(tmp_path, resume=True)
        assert again.lines == whole.lines and again.result == whole.result
        assert all(torch.equal(tensor, whole.weights[name]) for name, tensor in again.weights.items())

    def test_a_run_that_was_killed_goes_on_from_its_last_checkpoint(self, tmp_path: Path, whole: Run) -> None:
        with pytest.raises(OSError):
            self.train(tmp_path, progress=DiesAt(5))
        again = self.train(tmp_path, resume=True)
        assert again.lines == whole.lines and again.result == whole.result

    def test_a_finished_run_is_not_trained_again_and_no_other_recipe_goes_on_from_it(
        self, tmp_path: Path, whole: Run
    ) -> None:
        self.train(tmp_path)
        again = self.train(tmp_path, resume=True)
        assert again.lines == whole.lines and again.result == whole.result
        assert all(torch.equal(tensor, whole.weights[name]) for name, tensor in again.weights.items())
        with pytest.raises(TrainError, match="another recipe"):
            self.train(tmp_path, self.other, resume=True)

    @pytest.mark.slow
    def test_two_processes_have_the_loss_curve_of_one(self, tmp_path: Path, whole: Run) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        fixed = {
            "WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "OMP_NUM_THREADS": "1",
            "GLOO_SOCKET_IFNAME": "lo",
        }  # fmt: skip
        command = [sys.executable, "-m", self.rank, *self.prepare(tmp_path), str(tmp_path)]
        ranks = [
            subprocess.Popen(command, cwd=ROOT, env={**os.environ, **fixed, "RANK": str(rank), "LOCAL_RANK": str(rank)})
            for rank in range(2)
        ]
        try:
            assert [rank.wait(timeout=240) for rank in ranks] == [0, 0]
        finally:
            for rank in ranks:
                rank.kill()
        lines = self.train(tmp_path, resume=True).lines
        assert [line["step"] for line in lines] == [line["step"] for line in whole.lines]
        for key in ("loss", "held_loss"):
            expected = [line[key] for line in whole.lines if key in line]
            assert [line[key] for line in lines if key in line] == pytest.approx(expected, rel=1e-3)
