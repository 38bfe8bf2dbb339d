"""Measures how soon the robot receives zero velocity after the runner is killed or frozen while driving.

    python -m tools.bench.stop --artifacts out/demo/artifacts --runs 20 --json out/bench/stop.json

Real processes on loopback: edge-hil, edge-bridge, and one edge-run per sample, which gets SIGKILL or SIGSTOP
alternately. The figure is the time from the signal to the first zero command after which the robot receives only zeros,
from the simulated robot's trace.
"""

from __future__ import annotations

import json
import random
import signal
import statistics
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from edge.core.cli import EXIT_CHECK_FAILED, EXIT_DONE, check_result_target, command_line, write_result
from firmware_bridge.core.config import BRIDGE_PRIORITY
from sim_hil.realtime.children import Child, Children, StepError
from sim_hil.realtime.robots import GO2, ROBOTS, RunAddress, StackRobot
from sim_hil.realtime.stack import COMMANDS, INSTRUCTION, READY_LINE, ROBOT_PRIORITY, socket_dir
from tools.bench import bad_input, command_parser

SIGNALS = (signal.SIGKILL, signal.SIGSTOP)
BOUND_MS = 300.0
DRIVING_S = (0.5, 1.5)
"""Driving time before the signal, s; its phase to tick and deadman is random."""
AFTERMATH_S = 0.8


Moves = list[tuple[int, tuple[float, float, float]]]


def received_moves(trace: Path) -> Moves:
    """Return (stamp ns, velocity) of every motion request in a trace of edge-hil; ignores an incomplete last line."""
    moves: Moves = []
    for line in trace.read_text(encoding="utf-8").split("\n")[:-1]:
        record = json.loads(line)
        if record["kind"] == "wire" and record["velocity"] is not None:
            vx_mps, vy_mps, wz_radps = record["velocity"]
            moves.append((record["t_ns"], (vx_mps, vy_mps, wz_radps)))
    return moves


def lasting_zero_ms(moves: Moves, signal_ns: int) -> float:
    """Return the time from the signal to the lasting zero, ms. Raises ValueError if there is none."""
    after = [move for move in moves if move[0] >= signal_ns]
    last_motion = max((i for i, (_, velocity) in enumerate(after) if any(velocity)), default=-1)
    if last_motion + 1 >= len(after):
        raise ValueError("the robot was not stopped at all")
    return (after[last_motion + 1][0] - signal_ns) / 1e6


def start_robot(children: Children, folder: Path, robot: StackRobot, options: Sequence[str] = ()) -> list[str]:
    """Start edge-hil with its options and edge-bridge; returns the runner's arguments to reach them."""
    address = RunAddress.free(folder)
    link = ["--robot", str(robot.write_file(folder / "robot.toml", address))]
    scene = [*robot.hil_arguments(address), "--scene", "corridor", "--people", "0"]
    hil = children.start("edge-hil", [*COMMANDS["edge-hil"], *scene, *options], fifo_priority=ROBOT_PRIORITY)
    children.wait_until(hil, lambda: READY_LINE in hil.log.read_text(), 90.0, "ready line", lambda: None)
    children.start("edge-bridge", [*COMMANDS["edge-bridge"], *link], fifo_priority=BRIDGE_PRIORITY)
    return link


def stop_once(children: Children, runner: list[str], trace: Path, number: signal.Signals, driving_s: float) -> float:
    """Start a runner, let it drive, send the signal; returns the latency in ms."""
    child: Child = children.start("edge-run", runner)
    before = len(received_moves(trace))

    def is_moving() -> bool:
        return any(any(velocity) for _, velocity in received_moves(trace)[before:])

    children.wait_until(child, is_moving, 60.0, "motion", lambda: None)
    time.sleep(driving_s)
    signal_ns = time.monotonic_ns()
    child.process.send_signal(number)
    time.sleep(AFTERMATH_S)
    child.process.kill()
    child.process.wait()
    children.forget(child)
    return lasting_zero_ms(received_moves(trace), signal_ns)


@command_line("stop")
def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    p = command_parser(__doc__, artifacts=True)
    p.add_argument("--runs", type=int, default=20, help="runs of each signal (default: 20)")
    p.add_argument("--robot", choices=tuple(ROBOTS), default=GO2.name, help=f"robot (default: {GO2.name})")
    args = p.parse_args(argv)
    rng = random.Random(0)
    samples: dict[str, list[float]] = {number.name: [] for number in SIGNALS}
    try:
        check_result_target(args.json)
        if args.runs < 1:
            raise ValueError(f"--runs {args.runs}: expected at least 1")
        with socket_dir() as folder, Children(folder) as children:
            trace = folder / "trace.jsonl"
            link = start_robot(children, folder, ROBOTS[args.robot], ["--trace", str(trace)])
            runner = [*COMMANDS["edge-run"], *link, "--artifacts", str(args.artifacts), "--instruction", INSTRUCTION]
            for index in range(args.runs):
                for number in SIGNALS:
                    latency_ms = stop_once(children, runner, trace, number, rng.uniform(*DRIVING_S))
                    samples[number.name].append(latency_ms)
                    sys.stderr.write(f"run {index + 1}/{args.runs}: {number.name} {latency_ms:.1f} ms\n")
    except (StepError, OSError, ValueError) as error:
        return bad_input("stop", error)
    summary = {
        name: {"n": len(values), "p50": statistics.median(values), "max": max(values)}
        for name, values in samples.items()
    }
    ok = all(row["max"] <= BOUND_MS for row in summary.values())
    result = {
        "robot": args.robot,
        "stop_ms": summary,
        "bound_ms": BOUND_MS,
        "ok": ok,
        "samples_ms": samples,
        "tagged": "measured",
    }
    write_result(args.json, result)
    if args.json != "-":
        for name, row in summary.items():
            print(f"{name}: n {row['n']}, p50 {row['p50']:.1f} ms, max {row['max']:.1f} ms (bound {BOUND_MS:.0f} ms)")
    return EXIT_DONE if ok else EXIT_CHECK_FAILED


if __name__ == "__main__":
    sys.exit(main())
