"""Measures the effect of the reasoning thread on the control thread in one drive with the VLM alternately on and off.

    python -m tools.bench.contention --artifacts out/demo/artifacts --duration 600 --json out/bench/contention.json

Real processes on loopback: edge-hil, edge-bridge and the runner. Two parts of the runner are replaced. Its reasoning
budget alternates between blocks with and without reasoning. Its plan is a circle, because an untrained network would
walk into a wall; the network still runs. While allowed, generations follow one another without a pause. A tick is timed
from its deadline to its command.
"""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table

from edge.core.cli import EXIT_CHECK_FAILED, EXIT_DONE, check_result_target, command_line, write_result
from edge.core.geometry import SE2
from edge.flightlog.reader import RecordingError, read_messages
from edge.inference.policy import Policy
from edge.inference.warm_up import Opened, open_proven
from edge.power.monitor import PowerMonitor
from edge.reasoning.generation_cycle import UNLIMITED, ReasoningBudget
from edge.run import command as runner
from edge.run import session
from edge.state.semantic import SemanticState
from sim_hil.realtime.children import Children, StepError
from sim_hil.realtime.robots import GO2
from sim_hil.realtime.stack import INSTRUCTION, socket_dir
from tools.bench import bad_input, command_parser
from tools.bench.stop import start_robot
from tools.faults.rig import circle

BLOCK_S = 8.0
"""Length of a block, s: shorter than the age of a semantic state at which the robot slows down."""
SETTLE_S = 1.0
"""Time ignored after every change, s, in which the current generation ends."""
P999_MS = 100.0
RATIO = 1.25
STEP_S = 0.1
RIPPLE_RAD = 0.7
Floats = npt.NDArray[np.float32]
State = tuple[float, float, float]
DRIVE = "--drive"
"""First argument that selects the runner's process."""


@dataclass(frozen=True)
class Tick:
    """Tick of the log."""

    start_ns: int
    tick_ms: float
    reasoning: bool | None
    """Whether reasoning was allowed; None shortly after a change."""


def allowed(now_ns: int) -> bool:
    """Return whether the block allows reasoning; runner and report share the monotonic clock."""
    return int(now_ns / 1e9 / BLOCK_S) % 2 == 0


@contextmanager
def circling_plans() -> Iterator[None]:
    """Replace the plans of a runner in this process by a circle; its network still runs."""
    act, calls = Policy.act, itertools.count()

    def circling(
        policy: Policy, tokens: Floats, state: State, delay_s: float, offset: SE2, semantic: SemanticState
    ) -> Floats:
        planned = act(policy, tokens, state, delay_s, offset, semantic)
        pose = semantic.T_odom_anchor @ offset
        return circle.plan(pose, len(planned), STEP_S, RIPPLE_RAD * next(calls))

    def open_circling(*args: Any, **kwargs: Any) -> Opened:
        opened = open_proven(*args, **kwargs)  # the self-test judges the graphs' own plans
        stack.enter_context(mock.patch.object(Policy, "act", circling))
        return opened

    with ExitStack() as stack:
        stack.enter_context(mock.patch.object(session, "open_proven", open_circling))
        yield


def drive(arguments: Sequence[str]) -> int:
    """Run `edge-run` with a power governor that allows reasoning in every other block."""

    def budget(_monitor: PowerMonitor) -> ReasoningBudget:
        return UNLIMITED if allowed(time.monotonic_ns()) else ReasoningBudget(allowed=False)

    with mock.patch.object(PowerMonitor, "budget", budget), circling_plans():
        return runner.main(list(arguments))


def read_ticks(log: Path) -> tuple[list[Tick], int, float]:
    """Read a flight log's ticks, its number of generations, and their share of allowed time. Raises RecordingError."""
    ticks: list[Tick] = []
    generations, busy_ns = 0, 0
    for topic, _, record in read_messages(log):
        if topic == "/semantic":
            generations += 1
            busy_ns += record["finished_ns"] - record["started_ns"]
        elif topic == "/tick":
            start_ns = int(record["start_ns"])
            into_s = start_ns / 1e9 % BLOCK_S
            phase = allowed(start_ns) if into_s >= SETTLE_S else None
            ticks.append(Tick(start_ns, record["late_ms"] + record["duration_ms"], phase))
    seconds = sum(1 for tick in ticks if allowed(tick.start_ns)) * 0.1
    return ticks, generations, busy_ns / 1e9 / seconds if seconds else 0.0


def block_ratios(ticks: Sequence[Tick]) -> list[float]:
    """Return the ratio of medians with and without reasoning for every pair of neighbouring blocks."""
    blocks: dict[int, list[float]] = {}
    for tick in ticks:
        if tick.reasoning is not None:
            blocks.setdefault(int(tick.start_ns / 1e9 / BLOCK_S), []).append(tick.tick_ms)
    medians = {number: float(np.median(values)) for number, values in blocks.items() if len(values) >= 40}
    pairs = [(n, n + 1) if n % 2 == 0 else (n + 1, n) for n in medians if n + 1 in medians]
    return [medians[on] / medians[off] for on, off in pairs]


def summarise(ticks: Sequence[Tick], missed: int, generations: int, busy: float) -> dict[str, object]:
    """Compute figures and verdicts. Raises ValueError for a log without both phases."""
    figures: dict[str, dict[str, float]] = {}
    phases = {"all": (True, False, None), "reasoning": (True,), "alone": (False,)}
    for name, phase in phases.items():
        values = np.array([tick.tick_ms for tick in ticks if tick.reasoning in phase])
        if not len(values):
            raise ValueError(f"no ticks of the phase {name!r}: drive for at least {3 * BLOCK_S:g} s")
        quantiles = np.percentile(values, (50, 99, 99.9, 100), method="inverted_cdf")
        named = zip(("p50", "p99", "p999", "max"), (round(float(value), 3) for value in quantiles), strict=True)
        figures[name] = {"n": len(values), **dict(named)}
    ratios = block_ratios(ticks)
    ratio = float(np.median(ratios)) if ratios else figures["reasoning"]["p50"] / figures["alone"]["p50"]
    checks = {
        "p999_ms": figures["all"]["p999"] <= P999_MS,
        "missed": missed == 0,
        "ratio": ratio <= RATIO,
    }
    return {
        "tick_ms": figures,
        "missed": missed,
        "ratio": round(ratio, 4),
        "block_ratios": [round(value, 4) for value in ratios],
        "generations": generations,
        "reasoning_share": round(busy, 3),
        "bounds": {"p999_ms": P999_MS, "missed": 0, "ratio": RATIO},
        "checks": checks,
        "ok": all(checks.values()),
        "tagged": "measured",
    }


def _run(artifacts: Path, duration_s: float, folder: Path) -> tuple[list[Tick], int, float, int]:
    with Children(folder) as children:
        link = start_robot(children, folder, GO2)
        log = folder / "flight.mcap"
        run = [sys.executable, "-m", "tools.bench.contention", DRIVE, *link, "--artifacts", str(artifacts)]
        run += ["--instruction", INSTRUCTION, "--duration", str(duration_s), "--record", str(log)]
        child = children.start("runner", run)
        code = children.wait(child, duration_s + 120.0, lambda: None)
        children.forget(child)
        if code != EXIT_DONE:
            raise child.failure(f"exit code {code}")
        missed = next((int(r["control"]["missed"]) for topic, _, r in read_messages(log) if topic == "/result"), -1)
        return *read_ticks(log), missed


@command_line("contention")
def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    arguments = sys.argv[1:] if argv is None else argv
    if arguments[:1] == [DRIVE]:
        return drive(arguments[1:])
    p = command_parser(__doc__, artifacts=True)
    p.add_argument("--duration", type=float, default=600.0, metavar="S", help="default: 600")
    args = p.parse_args(arguments)
    try:
        check_result_target(args.json)
        with socket_dir() as folder:
            ticks, generations, busy, missed = _run(args.artifacts.absolute(), args.duration, folder)
        result = summarise(ticks, missed, generations, busy)
        write_result(args.json, {**result, "samples": [list(asdict(tick).values()) for tick in ticks]})
    except (StepError, RecordingError, OSError, ValueError) as error:
        return bad_input("contention", error)
    _print(result)
    return EXIT_DONE if result["ok"] else EXIT_CHECK_FAILED


def _print(result: dict[str, object]) -> None:
    table = Table(title="tick, from its deadline to its command (ms)")
    for column in ("phase", "n", "p50", "p99", "p99.9", "max"):
        table.add_column(column, justify="left" if column == "phase" else "right")
    figures = result["tick_ms"]
    assert isinstance(figures, dict)
    for name, row in figures.items():
        table.add_row(name, f"{row['n']:.0f}", *(f"{row[key]:.1f}" for key in ("p50", "p99", "p999", "max")))
    console = Console(stderr=True)
    console.print(table)
    console.print(
        f"missed {result['missed']}; median with reasoning over alone {result['ratio']} (bound {RATIO}); "
        f"{result['generations']} generations, which took {result['reasoning_share']} of the allowed time"
    )


if __name__ == "__main__":
    sys.exit(main())
