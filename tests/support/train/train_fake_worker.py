"""A worker that makes up its drives, and misbehaves as FAKE_WORKER says (a table such as {"die": [ids]}), for tests.

`die`: ends itself when it has begun that drive; `drop`: gives it up; `refuse`: refuses everything; `deaf`: ends before
it begins anything; `end_badly`: ends with an exit code after its last drive.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from sim_hil.benchmark.workers.worker_process import worker_main
from tools.train.drives.drive import About, Drive, Entry

BEGUN = "begun.txt"


def made_up(drive_id: str, seed: int) -> Drive:
    """Two frames that depend on the id and the seed."""
    value = float(sum(drive_id.encode()) + seed % 1000)
    about = About(
        id=drive_id, kind="office", layout_seed=100, scene="office-100", robot="go2", people=0, seed=seed,
        driver="expert", drift="none", goal_xy=(value, 0.0), threshold_m=1.5, outcome="reached", collided=False,
        wordings=(), told=(), traces=(),
    )  # fmt: skip
    return Drive(
        about=about, jpeg=np.arange(4, dtype=np.uint8), jpeg_end=np.array((2, 4)), pose=np.full((2, 3), value),
        pose_odom=np.zeros((2, 3)), state=np.zeros((2, 3), np.float32), future=np.zeros((2, 50, 3), np.float32),
        future_steps=np.zeros(2, np.int16), plan_xy=np.zeros((2, 3, 2), np.float32), by=np.zeros(2, np.uint8),
    )  # fmt: skip


def messages(job: dict[str, Any]) -> Iterator[Mapping[str, Any]]:
    """As the real worker's."""
    fault: Mapping[str, Any] = json.loads(os.environ.get("FAKE_WORKER", "{}"))
    folder = Path(job["folder"])
    if "deaf" in fault:
        sys.stderr.write("no hands\n")
        sys.exit(5)
    if "refuse" in fault:
        yield {"refused": "not these artifacts"}
        return
    for number in range(job["start"], job["start"] + job["count"]):
        drive_id = f"{job['prefix']}{number:05d}"
        if drive_id in job["skip"]:
            continue
        yield {"begun": drive_id}
        with (folder / BEGUN).open("a") as file:
            file.write(drive_id + "\n")
        if drive_id in fault.get("die", ()):
            os.kill(os.getpid(), signal.SIGKILL)
        if drive_id in fault.get("drop", ()):
            yield {"dropped": drive_id, "why": "it left the way"}
            continue
        drive = made_up(drive_id, job["seed"])
        path = folder / "drives" / f"{drive_id}.safetensors"
        drive.save(path)
        yield {"drive": asdict(Entry.of(drive, path))}
    if "end_badly" in fault:
        sys.exit(9)


if __name__ == "__main__":
    sys.exit(worker_main("fake", messages))
