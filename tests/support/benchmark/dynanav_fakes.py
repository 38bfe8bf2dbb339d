"""Made-up results, tasks and a worker for tests of the benchmark's machinery, which need no physics."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from edge.inference.start_guard import end_process
from sim_hil.benchmark.conditions.conditions import Conditions, PolicySpec
from sim_hil.benchmark.results.record import EpisodeResult
from sim_hil.benchmark.suite.episode import Episode
from sim_hil.benchmark.workers.task import EpisodeTask
from sim_hil.processes.child_process import end_with_parent

STILL = Conditions(PolicySpec("still"))

SUITE = """
format = 1
name = "corridor"
version = 1
[[tasks]]
task = "corridor"
scene = "corridor"
start_deg = [1.0, 0.0, 0.0]
goal_xy = [4.0, 0.0]
threshold_m = 1.5
goal_landmark = "bench"
landmarks = ["bench"]
instructions = ["walk on", "walk ahead", "go on", "go ahead"]
"""


def suite_text(*ids: str, timeout_s: float = 2.0, people: int = 0, robot: str = "carter") -> str:
    """A suite of short episodes in the corridor."""
    rows = [
        f'[[tasks.episodes]]\nid = "{name}"\nrobot = "{robot}"\npeople = {people}\nseed = {number}\n'
        f"timeout_s = {timeout_s}\nshortest_m = 3.0\n"
        for number, name in enumerate(ids, 1)
    ]
    return SUITE + "".join(rows)


def episode(name: str, **changed: Any) -> Episode:
    """An episode that nobody simulates."""
    made = Episode(
        id=name, task="t", scene="corridor", robot="go2", people=0, seed=1, start=(0.0, 0.0, 0.0), goal_xy=(4.0, 0.0),
        instructions=("walk on", "go on"), timeout_s=20.0, threshold_m=1.5, shortest_m=3.0, landmarks=("bench",),
        goal_landmark="bench",
    )  # fmt: skip
    return replace(made, **changed)


def task(name: str, folder: Path, conditions: Conditions = STILL) -> EpisodeTask:
    """A task for that episode, its folders made."""
    for part in ("episodes", "videos"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    return EpisodeTask(episode(name), conditions, folder)


def result(name: str, **changed: Any) -> EpisodeResult:
    """A result: by default reached, without a collision."""
    values: dict[str, Any] = {
        "id": name, "task": name, "scene": "corridor", "people": 0, "robot": "go2", "seed": 1, "wording": 0,
        "instruction": "walk on", "success": True, "ne_m": 1.0, "spl": 80.0, "collided": False, "collisions": (),
        "first_collision_s": None, "fell": False, "end": "reached", "path_m": 4.0, "shortest_m": 3.0, "time_s": 9.0,
        "timeout_s": 20.0, "trajectory_sha256": hashlib.sha256(name.encode()).hexdigest(), "delay_s": None,
        "generations": None, "stopped_by": "", "clock": "lockstep", "wall_s": 1.0, "attempts": 1, "host": "here",
    }  # fmt: skip
    return EpisodeResult(**{**values, **changed})


def missed(name: str, **changed: Any) -> EpisodeResult:
    """The same, not reached."""
    return result(name, **{"success": False, "spl": 0.0, "ne_m": 7.0, "end": "timeout", **changed})


def main() -> int:
    """A worker that behaves as the episode's id says."""
    options = dict(zip(sys.argv[1::2], sys.argv[2::2], strict=True))
    asked = EpisodeTask.of_json(json.loads(sys.stdin.read()))
    name = asked.episode.id
    end_with_parent(int(options["--parent"]))
    if name == "dies" or (name == "dies-once" and asked.attempt == 1):
        sys.stderr.write("out of luck\n")
        sys.stderr.flush()
        os.kill(os.getpid(), signal.SIGKILL)
    if name == "guarded":
        end_process("nano: self-test: not done after its limit of 9 s")
    if "--pids" in options:
        (Path(options["--pids"]) / f"{name}.{asked.attempt}").write_text(options["--parent"])
    if name == "hangs" or (name == "hangs-once" and asked.attempt == 1):
        time.sleep(600)
    with os.fdopen(int(options["--fd"]), "w") as lines:
        if name == "refuses":
            lines.write(json.dumps({"refused": "no such scene", "code": 2}) + "\n")
        elif name == "half":
            lines.write('{"result": {"id": "ha')
        else:
            asked.log_path.write_text("{}")
            made = result(name, attempts=asked.attempt)
            lines.write(json.dumps({"time_s": 1.0}) + "\n" + json.dumps({"result": made.as_json()}) + "\n")
    if name == "lingers":
        time.sleep(0.5)
    return 0


if __name__ == "__main__":
    sys.exit(main())
