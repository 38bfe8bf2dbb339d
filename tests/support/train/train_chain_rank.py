"""One rank of a whole run whose stages only say who did them: `python -m tests.support.train.train_chain_rank OUT HOW`.

HOW: the name of a stage that fails on the first rank that comes to it; `stop`, where the second rank alone is asked to
stop during `encoder`; or `done`.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch

from tools.train import cli
from tools.train.config.checks import TrainError
from tools.train.pipeline import chain
from tools.train.pipeline.chain import Step
from tools.train.run.distributed import leave
from tools.train.run.job import StageJob


def main() -> int:
    """Exit code of `edge-train all`; each rank's file has a line for every step: stage, rank/world, threads."""
    out, how = Path(sys.argv[1]), sys.argv[2]
    here = os.environ["RANK"]

    def note(name: str, job: StageJob) -> dict[str, Any]:
        with (out / f"{here}.txt").open("a", encoding="utf-8") as file:
            file.write(f"{name} {job.ranks.rank}/{job.ranks.world} {torch.get_num_threads()}\n")
        if name == how:
            raise TrainError(f"{name} has failed")
        if how == "stop" and name == "encoder" and here == "1":
            job.stop.requested = True
        job.ranks.barrier()
        return {"stage": name}

    def stage(name: str) -> Callable[[StageJob], dict[str, Any]]:
        return lambda job: note(name, job)

    def round_of(job: StageJob, step: Step) -> dict[str, Any]:
        return note(step.stage, job)

    stages = {name: stage(name) for name in chain.RUNS}
    with patch.dict(chain.RUNS, stages), patch.object(chain, "_round", round_of):
        return cli.main(["all", "--preset", "tiny", "--set", "dagger.rounds=1", "--out", str(out / "run"), "--resume"])


if __name__ == "__main__":
    leave(main())
