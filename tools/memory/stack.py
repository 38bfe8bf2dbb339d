"""The real processes on a circle for minutes, each with a probe inside; parts of the runner can be switched off."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import tomli_w

from firmware_bridge.system.input_file import read_toml
from sim_hil.realtime.children import Child, Children
from sim_hil.realtime.robots import StackRobot
from sim_hil.soak.trends import Trend
from tools.faults.rig.processes import Rig
from tools.memory.gauge import LIMIT_MIB_PER_H, later_half

SWITCHES: Final[Mapping[str, str]] = {
    "recording": "no flight log",
    "reasoning": "no language model (--mode no-reasoning)",
    "visual-odometry": "no [mount] in the robot file",
}
"""Parts of the runner that can be switched off."""
JUDGED: Final = ("edge-run", "edge-bridge", "edge-hil")
COLUMNS: Final = ("rss", "pss", "private_dirty", "anonymous", "heap_used", "heap_free")
PERIOD_S: Final = 2.0
SETTLED_S: Final = 30.0
"""Time in which a process starts and arms, s."""


class ProbedChildren(Children):
    """Children whose Python modules run inside `tools.memory.probe`."""

    trace_frames = 0

    def start(
        self, step: str, command: Sequence[str], *, fifo_priority: int = 0, processors: Collection[int] = ()
    ) -> Child:
        """Start a step; raises StepError."""
        if command[1] == "-m" and step.startswith(JUDGED):
            frames = self.trace_frames if step.startswith("edge-run") else 0
            file = str(self.log_dir / f"memory-{step}.jsonl")
            probe = ["-m", "tools.memory.probe", file, str(PERIOD_S), str(frames)]
            command = [command[0], *probe, *command[2:]]
        return super().start(step, command, fifo_priority=fifo_priority, processors=processors)


@dataclass(frozen=True)
class StackRun:
    """Options of a run of the stack; `folder` receives logs and readings."""

    folder: Path
    artifacts: Path
    robot: StackRobot
    minutes: float
    without: tuple[str, ...] = ()
    trace_frames: int = 0


def drive(options: StackRun, say: Callable[[str], None]) -> dict[str, list[dict[str, int]]]:
    """Drive for so many minutes and return the readings by process; a runner that ends is replaced.

    Raises StepError, or FaultError if the robot's side does not answer.
    """
    children = ProbedChildren(options.folder, grace_s=12.0)
    children.trace_frames = options.trace_frames
    arguments = ("--mode", "no-reasoning") if "reasoning" in options.without else ()
    rig = Rig(
        options.folder,
        options.artifacts.absolute(),
        None,
        say,
        record="recording" not in options.without,
        stack_robot=options.robot,
        runner_arguments=arguments,
        children=children,
    )
    if "visual-odometry" in options.without:
        file = options.folder / "robot.toml"
        content = {key: value for key, value in read_toml(file).items() if key != "mount"}
        file.write_text(tomli_w.dumps(content), encoding="utf-8")
    with rig:
        rig.start()
        rig.ensure_moving()
        end_ns = time.monotonic_ns() + round(60e9 * options.minutes)
        while time.monotonic_ns() < end_ns:
            if not (rig.runner and rig.runner.running and rig.bridge and rig.bridge.running):
                say("a process has ended, as its log says; a new one drives on")
                rig.ensure_moving()
            time.sleep(0.5)
    return longest_lives(options.folder)


def longest_lives(folder: Path) -> dict[str, list[dict[str, int]]]:
    """Return the readings of the process that lived longest, by command, without its first SETTLED_S."""
    found: dict[str, list[dict[str, int]]] = {}
    for file in sorted(folder.glob("memory-*.jsonl")):
        readings = [json.loads(line) for line in file.read_text("ascii").splitlines()]
        name = next(one for one in JUDGED if file.stem.startswith(f"memory-{one}"))
        if len(readings) > len(found.get(name, ())):
            found[name] = readings
    return {
        name: [one for one in own if one["t_ns"] - own[0]["t_ns"] >= SETTLED_S * 1e9] for name, own in found.items()
    }


def trends_of(readings: Mapping[str, Sequence[dict[str, int]]]) -> dict[str, dict[str, Trend | None]]:
    """Return for each process and column its trend over the second half, MiB/h."""
    return {name: {column: later_half(own, column) for column in COLUMNS} for name, own in readings.items()}


def judged(trends: Mapping[str, Mapping[str, Trend | None]]) -> list[str]:
    """Return the processes whose private memory certainly grows by more than the limit: its interval is above."""
    found = {name: own["private_dirty"] for name, own in trends.items()}
    return [name for name, own in found.items() if own is not None and own.low > LIMIT_MIB_PER_H]


def table(trends: Mapping[str, Mapping[str, Trend | None]]) -> list[str]:
    """Return the lines of the table: MiB/h with the 95 % interval."""
    lines = ["MiB/h over the second half (95 % interval)".ljust(44)]
    for name, own in trends.items():
        lines.append(name)
        for column, one in own.items():
            text = "too few readings" if one is None else f"{one.per_h:+8.2f} ({one.low:+.2f} to {one.high:+.2f})"
            lines.append(f"  {column:<14} {text}")
    return lines


def as_json(readings: Mapping[str, Sequence[dict[str, int]]]) -> dict[str, Any]:
    """Return trends and readings for a result file."""
    trends = {
        name: {column: None if one is None else one._asdict() for column, one in own.items()}
        for name, own in trends_of(readings).items()
    }
    return {"mib_per_h": trends, "readings": {name: list(own) for name, own in readings.items()}}
