"""Measures what the live view costs the runner: no view, a view without viewer, one viewer, five viewers.

    python -m tools.bench.live_cost --artifacts out/nano --rounds 5 --block 60 --json out/bench/live_cost.json
    python -m tools.bench.live_cost --artifacts out/nano --rounds 0 --memory 1800 --json out/bench/live_memory.json

Real processes on loopback: edge-hil, edge-bridge, the runner, its view, and the viewers in a process of their own on
the same machine. A round is one drive without the view and one with it, whose blocks are the other three conditions;
the order of drives and blocks turns from round to round. Of five viewers, two are pages, one is Foxglove with every
channel, one reads nothing and one reads 1 kB/s. Ratios are of conditions of one round. A tick is timed from its
deadline to its command. `--memory`: one more drive with five viewers, in which the memory of runner and view is sampled
once a second. As in tools.bench.contention, the plan is a circle.
"""

from __future__ import annotations

import itertools
import re
import statistics
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import psutil
from rich.console import Console
from rich.table import Table

from edge.core.cli import EXIT_CHECK_FAILED, EXIT_DONE, check_result_target, command_line, write_result
from edge.flightlog.reader import RecordingError, read_messages
from edge.run import command as runner
from sim_hil.realtime.children import Child, Children, StepError
from sim_hil.realtime.robots import GO2
from sim_hil.realtime.stack import ARMED_LINE, INSTRUCTION, socket_dir
from tools.bench import bad_input, command_parser
from tools.bench.contention import circling_plans
from tools.bench.live_viewers import VIEWERS
from tools.bench.stop import start_robot

NONE, ALONE, ONE, FIVE = "no view", "no viewer", "one viewer", "five viewers"
CONDITIONS: Final = (NONE, ALONE, ONE, FIVE)
SETTLE_S: Final = 3.0
"""Time ignored at the beginning of every block, s, in which viewers connect."""
START_S: Final = 90.0
OPEN: Final = ("--scene", "sidewalk", "--start", "28.7,20,0")
"""Start with 5 m of free floor around it: in 13 minutes the circle had drifted by 0.8 m, to the corridor's wall."""
DRIVE: Final = "--drive"
"""First argument that selects the runner's process."""
PERIOD_MS: Final = 100.0
_VIEW: Final = "edge.live.server"


@dataclass(frozen=True)
class Block:
    """One condition of one round: its time span and the processor time of runner and view meanwhile, s."""

    condition: str
    begin_ns: int
    end_ns: int
    runner_s: float
    view_s: float

    @property
    def seconds(self) -> float:
        """Length, s."""
        return (self.end_ns - self.begin_ns) / 1e9


@dataclass(frozen=True)
class Sample:
    """A block's figures: tick times, ms; periods without a tick; CPU of runner and view, % of a core."""

    condition: str
    ticks_ms: list[float]
    missed: int
    runner_cpu: float
    view_cpu: float


def sample_of(block: Block, ticks: Sequence[tuple[int, float]]) -> Sample:
    """Take the ticks (deadline ns, ms) of a block. Raises ValueError for a block without ticks."""
    chosen = [(at_ns, tick_ms) for at_ns, tick_ms in ticks if block.begin_ns <= at_ns < block.end_ns]
    if not chosen:
        raise ValueError(f"block {block.condition!r}: no tick; the run ended early")
    gaps = [(b - a) / 1e6 / PERIOD_MS for (a, _), (b, _) in itertools.pairwise(chosen)]
    missed = sum(max(0, round(gap) - 1) for gap in gaps)
    cpu = [100 * used / block.seconds for used in (block.runner_s, block.view_s)]
    return Sample(block.condition, [tick_ms for _, tick_ms in chosen], missed, *cpu)


def read_ticks(log: Path) -> list[tuple[int, float]]:
    """Return (deadline ns, time from it to the command, ms) of every tick of a flight log. Raises RecordingError."""
    return [
        (int(record["now_ns"]), float(record["late_ms"] + record["duration_ms"]))
        for topic, _, record in read_messages(log)
        if topic == "/tick"
    ]


def orders(rounds: int) -> Iterator[tuple[bool, tuple[str, ...]]]:
    """Yield for every round whether the drive without view comes first, and the order of the other's blocks."""
    watched = (ALONE, ONE, FIVE)
    for number in range(rounds):
        turn = number % len(watched)
        yield number % 2 == 0, watched[turn:] + watched[:turn]


def summarise(rounds: Sequence[Sequence[Sample]]) -> dict[str, Any]:
    """Return figures over all rounds, and each condition's median ratio to the drive without view of its round."""
    figures: dict[str, Any] = {}
    for condition in CONDITIONS:
        samples = [sample for one in rounds for sample in one if sample.condition == condition]
        if not samples:
            continue
        ticks = np.array([value for sample in samples for value in sample.ticks_ms])
        quantiles = np.percentile(ticks, (50, 99, 99.9, 100), method="inverted_cdf")
        named = zip(("p50", "p99", "p999", "max"), (round(float(value), 3) for value in quantiles), strict=True)
        figures[condition] = {
            "ticks": len(ticks),
            "tick_ms": dict(named),
            "missed": sum(sample.missed for sample in samples),
            "runner_cpu_percent": round(statistics.median(sample.runner_cpu for sample in samples), 2),
            "view_cpu_percent": round(statistics.median(sample.view_cpu for sample in samples), 2),
            "ratios": _ratios(rounds, condition),
        }
    missed = sum(figure["missed"] for figure in figures.values())
    return {"conditions": figures, "rounds": len(rounds), "missed": missed, "ok": missed == 0, "tagged": "measured"}


def _ratios(rounds: Sequence[Sequence[Sample]], condition: str) -> dict[str, float]:
    found: dict[str, list[float]] = {"p50": [], "p99": [], "runner_cpu": []}
    for one in rounds:
        pair = [next(sample for sample in one if sample.condition == name) for name in (condition, NONE)]
        for name, quantile in (("p50", 50), ("p99", 99)):
            a, b = (float(np.percentile(sample.ticks_ms, quantile, method="inverted_cdf")) for sample in pair)
            found[name].append(a / b)
        found["runner_cpu"].append(pair[0].runner_cpu / pair[1].runner_cpu)
    return {name: round(statistics.median(values), 4) for name, values in found.items()}


def slope_mib_per_h(samples: Sequence[tuple[float, float]]) -> float:
    """Return the slope of (s, MiB) by least squares over the last two thirds, MiB/h."""
    late = np.array([sample for sample in samples if sample[0] >= samples[0][0] + (samples[-1][0] - samples[0][0]) / 3])
    return float(np.polyfit(late[:, 0], late[:, 1], 1)[0] * 3600)


class Rig:
    """The simulated robot and its bridge, and drives of a runner; `folder` takes logs."""

    def __init__(self, children: Children, folder: Path, artifacts: Path) -> None:
        self._children, self._folder = children, folder
        self._link = start_robot(children, folder, GO2, OPEN)
        self._artifacts = artifacts
        self._drives = itertools.count(1)

    def drive(self, conditions: Sequence[str], block_s: float, memory: list[dict[str, float]] | None = None) -> Any:
        """Drive one block for each condition; return (Block, ticks) of each. Raises StepError or RecordingError."""
        number = next(self._drives)
        log = self._folder / f"flight-{number}.mcap"
        live = ["--live", "0"] if conditions != (NONE,) else []
        duration_s = len(conditions) * (block_s + SETTLE_S) + SETTLE_S
        command = [sys.executable, "-m", "tools.bench.live_cost", DRIVE, *self._link]
        command += ["--artifacts", str(self._artifacts), "--instruction", INSTRUCTION, "--duration", str(duration_s)]
        child = self._children.start(f"runner-{number}", [*command, "--record", str(log), *live])
        self._children.wait_until(child, lambda: ARMED_LINE in child.log.read_text(), START_S, "driving", lambda: None)
        blocks = [self._block(child, condition, block_s, memory) for condition in conditions]
        code = self._children.wait(child, duration_s + START_S, lambda: None)
        self._children.forget(child)
        if code != EXIT_DONE:
            raise child.failure(f"exit code {code}")
        ticks = read_ticks(log)
        log.unlink()
        return [sample_of(block, ticks) for block in blocks]

    def _block(self, child: Child, condition: str, block_s: float, memory: list[dict[str, float]] | None) -> Block:
        viewers = self._viewers(child, condition)
        try:
            time.sleep(SETTLE_S)
            process = psutil.Process(child.process.pid)
            views = [each for each in process.children() if _VIEW in each.cmdline()]
            begin_ns, before = time.monotonic_ns(), [_cpu_s([process]), _cpu_s(views)]
            while time.monotonic_ns() - begin_ns < block_s * 1e9:
                time.sleep(1.0)
                if memory is not None:
                    rss = {"runner": process.memory_info().rss, "view": sum(each.memory_info().rss for each in views)}
                    into_s = (time.monotonic_ns() - begin_ns) / 1e9
                    memory.append({"s": round(into_s, 2), **{name: value / 2**20 for name, value in rss.items()}})
            used = [_cpu_s([process]) - before[0], _cpu_s(views) - before[1]]
            return Block(condition, begin_ns, time.monotonic_ns(), *used)
        except psutil.NoSuchProcess as error:
            time.sleep(SETTLE_S)  # a runner ends its view first
            code = child.process.poll()
            raise child.failure("its view ended" if code is None else f"ended early, exit code {code}") from error
        finally:
            if viewers is not None:
                self._children.stop(viewers)

    def _viewers(self, child: Child, condition: str) -> Child | None:
        if condition not in VIEWERS:
            return None
        found = re.search(r"live view: (http\S+)", child.log.read_text())
        if found is None:
            raise child.failure("no address of the live view")
        command = [sys.executable, "-m", "tools.bench.live_viewers", found[1], condition]
        return self._children.start("viewers", command)


def _cpu_s(processes: Sequence[psutil.Process]) -> float:
    return sum(sum(process.cpu_times()[:2]) for process in processes)


def measure(artifacts: Path, rounds: int, block_s: float, memory_s: float) -> dict[str, Any]:
    """Drive all rounds and the memory's drive; return figures and raw samples. Raises StepError or RecordingError."""
    found: list[list[Sample]] = []
    memory: list[dict[str, float]] = []
    with socket_dir() as folder, Children(folder) as children:
        rig = Rig(children, folder, artifacts)
        for bare_first, watched in orders(rounds):
            drives = [(NONE,), watched] if bare_first else [watched, (NONE,)]
            found.append([sample for conditions in drives for sample in rig.drive(conditions, block_s)])
        if memory_s > 0:
            rig.drive((FIVE,), memory_s, memory)
    result = summarise(found)
    if memory:
        pairs = {name: [(each["s"], each[name]) for each in memory] for name in ("runner", "view")}
        result["memory"] = {
            name: {
                "first_mib": round(values[0][1], 2),
                "last_mib": round(values[-1][1], 2),
                "slope_mib_per_h": round(slope_mib_per_h(values), 3),
            }
            for name, values in pairs.items()
        }
    samples = [[vars(sample) for sample in one] for one in found]
    return {**result, "block_s": block_s, "samples": samples, "memory_samples": memory}


@command_line("live_cost")
def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    arguments = sys.argv[1:] if argv is None else argv
    if arguments[:1] == [DRIVE]:
        with circling_plans():
            return runner.main(arguments[1:])
    p = command_parser(__doc__, artifacts=True)
    p.add_argument("--rounds", type=int, default=5, metavar="N", help="default: 5")
    p.add_argument("--block", type=float, default=60.0, metavar="S", help="duration of a condition (default: 60)")
    p.add_argument("--memory", type=float, default=0.0, metavar="S", help="duration of the memory's drive (default: 0)")
    args = p.parse_args(arguments)
    try:
        if args.rounds < 0 or args.block < 5 or args.memory < 0 or (args.rounds == 0 and args.memory < 30):
            raise ValueError("expected --rounds of 0 or more, --block of 5 s or more, and a round or --memory of 30 s")
        check_result_target(args.json)
        result = measure(args.artifacts.absolute(), args.rounds, args.block, args.memory)
        write_result(args.json, result)
    except (StepError, RecordingError, OSError, ValueError) as error:
        return bad_input("live_cost", error)
    _print(result)
    return EXIT_DONE if result["ok"] else EXIT_CHECK_FAILED


def _print(result: Mapping[str, Any]) -> None:
    table = Table(title="the live view's cost: tick from its deadline to its command (ms), CPU (% of a core)")
    columns = ("condition", "ticks", "p50", "p99", "p99.9", "missed", "p50 ratio", "p99 ratio", "runner", "view")
    for column in columns:
        table.add_column(column, justify="left" if column == "condition" else "right")
    for name, figure in result["conditions"].items():
        tick, ratios = figure["tick_ms"], figure["ratios"]
        row = [figure["ticks"], tick["p50"], tick["p99"], tick["p999"], figure["missed"], ratios["p50"], ratios["p99"]]
        table.add_row(name, *map(str, (*row, figure["runner_cpu_percent"], figure["view_cpu_percent"])))
    console = Console(width=110)
    console.print(table)
    for name, figure in result.get("memory", {}).items():
        first, last, slope = figure["first_mib"], figure["last_mib"], figure["slope_mib_per_h"]
        console.print(f"memory of the {name}: {first} to {last} MiB, slope {slope} MiB/h")


if __name__ == "__main__":
    sys.exit(main())
