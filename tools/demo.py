"""The demo: export the graphs, start a simulated robot and the bridge, drive for a minute, write a report.

It starts the commands that a user would type, in this order, and reads their result files:
edge-export → edge-hil → edge-bridge → edge-run → report.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from edge.artifacts.files import MANIFEST_NAME, read_manifest
from edge.core.cli import (
    EXIT_BAD_INPUT,
    EXIT_CHECK_FAILED,
    EXIT_DONE,
    EXIT_INTERRUPTED,
    check_result_target,
    command_line,
    messages,
    write_result,
)
from export.checkpoint.load import shipped_weights
from export.model.config import PRESETS
from export.model.weights import CheckpointError
from firmware_bridge.core.config import BRIDGE_PRIORITY, ConfigError, load_robot_config
from firmware_bridge.system.input_file import read_json
from firmware_bridge.system.terminal import CommandParser
from reporting.progress import Progress
from sim_hil.realtime.children import Child, Children, StepError
from sim_hil.realtime.robots import BRIDGE_SOCKET, GO2, ROBOTS, RunAddress, StackRobot, StackRobotError, free_domain
from sim_hil.realtime.stack import COMMANDS, INSTRUCTION, READY_LINE, ROBOT_PRIORITY, socket_dir
from sim_hil.realtime.truth import LineTail
from tools.report.demo_report import RunFiles, write_report
from tools.report.machine import machine_facts
from tools.report.run_data import Record, ReportError

RELEASE_DELAY_S = 2
MODEL = "nano"
UNTRAINED_SPEED_MPS = 0.14
"""Distance limit for untrained weights, 8 m in a minute: they reach the corridor's wall after 9 m.

A robot that stays at a wall is stopped until the next arming (`odometry-stays-frozen`, `robot-stays-blocked`).
"""

EXPORT_TIMEOUT_S = 1800.0
READY_TIMEOUT_S = 90.0
BRIDGE_TIMEOUT_S = 30.0
STARTUP_TIMEOUT_S = 120.0
LAST_COMMANDS_S = 0.5  # between the bridge's end and the robot's, so that its last commands are in the trace

_print = messages("demo")

EXAMPLES = """examples:
  python -m tools.demo --out out/demo
  python -m tools.demo --out out/crowd --duration 120 --seed 3 --people 8
  python -m tools.demo --out out/can --robot carter-can

exit codes: 0 done, 1 a step or an acceptance check failed, 2 bad arguments, 130 interrupted
"""


@dataclass(frozen=True)
class DemoOptions:
    """Options of the demo; times in s, `domain` is the DDS domain of all processes."""

    out: Path
    artifacts: Path
    duration_s: float
    seed: int
    people: int
    domain: int
    robot: StackRobot = GO2
    live: bool = False
    """Whether the runner serves a live view."""

    def __post_init__(self) -> None:
        if not 5.0 <= self.duration_s <= 86_400.0:
            raise ValueError(f"--duration must be 5 to 86400 s, found {self.duration_s:g}")
        if not 0 <= self.seed < 2**31 or self.people < 0:
            raise ValueError(f"--seed and --people must not be negative, found {self.seed} and {self.people}")
        if not 0 <= self.domain <= 232:
            raise ValueError(f"--domain must be 0 to 232 (DDS), found {self.domain}")

    def as_json(self) -> Record:
        """Return the options for settings.json."""
        return {
            "duration_s": self.duration_s,
            "seed": self.seed,
            "people": self.people,
            "domain": self.domain,
            "robot": self.robot.name,
            "protocol": self.robot.protocol,
            "bridge_growth": _bridge_growth(self.robot.file),
            "artifacts": self._artifacts_from_out(),
        }

    def _artifacts_from_out(self) -> str:
        """Return the artifacts' path, relative if inside `out`, so that the folder can be moved, else absolute."""
        out, artifacts = Path(os.path.realpath(self.out)), Path(os.path.realpath(self.artifacts))
        return str(artifacts.relative_to(out) if artifacts.is_relative_to(out) else artifacts)

    @property
    def log_dir(self) -> Path:
        """Folder of the steps' logs."""
        return self.out / "log"

    @property
    def files(self) -> RunFiles:
        """Paths of the run's files."""
        return RunFiles(self.out, self.artifacts)


def _bridge_growth(robot_file: Path) -> list[float]:
    """Return by how much the bridge lets a command grow in one of its periods: m/s, m/s, rad/s."""
    config = load_robot_config(robot_file)
    speed, turn = (value / config.bridge.rate_hz for value in (config.limits.accel_mps2, config.limits.alpha_radps2))
    return [speed, speed, turn]


class TraceTail(LineTail):
    """Follows edge-hil's trace while it is written: motion requests received and metres driven so far."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._last: tuple[float, float] | None = None
        self._last_ns = 0
        self.moves = 0
        self.walked_m = 0.0

    def update(self) -> None:
        """Count the records since the last call."""
        for line in self.lines():
            if line["kind"] == "wire" and line["velocity"] is not None:
                self.moves += 1
            elif line["kind"] == "pose" and line["t_ns"] - self._last_ns >= 1_000_000_000:
                # One-second steps, so that swaying in place does not count as walking.
                position = (line["x"], line["y"])
                self.walked_m += 0.0 if self._last is None else math.dist(position, self._last)
                self._last, self._last_ns = position, line["t_ns"]


def run_demo(
    options: DemoOptions,
    commands: Mapping[str, Sequence[str]] = COMMANDS,
    report: Callable[..., Record] = write_report,
) -> Record:
    """Run every step into existing folders; returns the content of demo.json.

    Raises StepError or ReportError; ends all its processes.
    """
    started_ns = time.monotonic_ns()
    for old in options.files.of_a_run():
        old.unlink(missing_ok=True)
    settings = {"instruction": INSTRUCTION, "release_delay_s": RELEASE_DELAY_S, **options.as_json()}
    write_result(str(options.files.settings), {**settings, "machine": machine_facts()})
    # The socket's folder is removed last: until then a child may still write to it.
    with socket_dir() as socket_folder, Children(options.log_dir) as children:
        _export(options, commands["edge-export"], children)
        _drive(options, commands, children, RunAddress.free(socket_folder, options.domain))
    _print("writing the report")
    return report(options.files, wall_s=(time.monotonic_ns() - started_ns) / 1e9)


def _export(options: DemoOptions, command: Sequence[str], children: Children) -> None:
    """Build the artifacts unless valid ones exist."""
    artifacts, ours = str(options.artifacts), options.artifacts == options.out / "artifacts"
    if options.artifacts.exists():
        if ours and not trained(options.artifacts) and shipped_weights(PRESETS[MODEL]) is not None:
            why = "have untrained weights although trained ones are shipped"
        else:
            child = children.start("edge-export-verify", [*command, "verify", artifacts])
            if _run_to_end(children, child, f"checking the artifacts in {artifacts}") == 0:
                _print(f"artifacts in {artifacts} verified, not exported again")
                return
            why = f"do not verify (see {child.log})"
        _print(f"artifacts in {artifacts} {why}, exporting again")
        if ours:
            shutil.rmtree(options.artifacts)  # edge-export refuses any other directory
    result = str(options.files.result("edge-export"))
    arguments = ["--target", "cpu", "--model", MODEL, "--out", artifacts, "--json", result]
    child = children.start("edge-export", [*command, *arguments])
    code = _run_to_end(children, child, "exporting the graphs")
    if code != 0:
        raise child.failure(f"exit code {code}")


def trained(artifacts: Path) -> bool:
    """Return whether the manifest records trained weights; False if it cannot be read."""
    try:
        return read_json(artifacts / MANIFEST_NAME)["model"]["trained"] is True
    except (OSError, ValueError, KeyError, TypeError):
        return False


def _progress(describe: Callable[[float], str]) -> Progress:
    """Show `describe(elapsed_s)` while a step runs."""
    started_ns = time.monotonic_ns()
    return Progress("demo: ", lambda: describe((time.monotonic_ns() - started_ns) / 1e9))


def _run_to_end(children: Children, child: Child, what: str) -> int:
    with _progress(lambda elapsed_s: f"{what}, {elapsed_s:.0f} s") as progress:
        code = children.wait(child, EXPORT_TIMEOUT_S, progress.tick)
    children.forget(child)
    return code


def _drive(
    options: DemoOptions, commands: Mapping[str, Sequence[str]], children: Children, address: RunAddress
) -> None:
    """Start robot, bridge and runner; stop them in the order in which each can write its result."""
    files, socket = options.files, address.folder / BRIDGE_SOCKET
    limit_mps = None if trained(options.artifacts) else UNTRAINED_SPEED_MPS
    common = ["--robot", str(options.robot.write_file(files.robot, address, limit_mps))]
    command = [*commands["edge-hil"], *_hil_arguments(options, address)]
    hil = children.start("edge-hil", command, fifo_priority=ROBOT_PRIORITY)
    with _progress(lambda elapsed_s: f"starting the simulated robot, {elapsed_s:.0f} s") as progress:
        children.wait_until(hil, lambda: _says_ready(hil.log), READY_TIMEOUT_S, "ready line", progress.tick)
    bridge_result = ["--json", str(files.result("edge-bridge"))]
    command = [*commands["edge-bridge"], *common, *bridge_result]
    bridge = children.start("edge-bridge", command, fifo_priority=BRIDGE_PRIORITY)
    with _progress(lambda elapsed_s: f"starting the bridge, {elapsed_s:.0f} s") as progress:
        children.wait_until(bridge, socket.exists, BRIDGE_TIMEOUT_S, f"socket {socket}", progress.tick)
    run = children.start("edge-run", [*commands["edge-run"], *common, *_run_arguments(options)])
    if options.live:
        children.wait_until(run, lambda: _live_line(run.log) is not None, STARTUP_TIMEOUT_S, "live view", lambda: None)
        _print(_live_line(run.log) or "")
    trace = TraceTail(files.trace)

    def describe(elapsed_s: float) -> str:
        trace.update()
        return (
            f"driving {elapsed_s:.0f} s of {options.duration_s:.0f} s and start-up · "
            f"{trace.moves} commands · {trace.walked_m:.1f} m driven"
        )

    with _progress(describe) as progress:
        code = children.wait(run, options.duration_s + STARTUP_TIMEOUT_S, progress.tick)
    if code == EXIT_CHECK_FAILED and files.result("edge-run").exists():
        # A fault ended the run early: write the report all the same; it shows the fault and its checks fail.
        _print(str(run.failure("a fault ended the run")))
    elif code != 0:
        raise run.failure(f"exit code {code}")
    children.forget(run)
    _stop(children, bridge)
    time.sleep(LAST_COMMANDS_S)
    children.check_others(None)
    _stop(children, hil)


def _stop(children: Children, child: Child) -> None:
    code = children.stop(child)
    if code not in (EXIT_DONE, EXIT_INTERRUPTED):
        raise child.failure(f"exit code {code} when stopped")


def _hil_arguments(options: DemoOptions, address: RunAddress) -> list[str]:
    files = options.files
    # A backstop only: the demo stops the robot itself.
    longest_s = options.duration_s + READY_TIMEOUT_S + BRIDGE_TIMEOUT_S + STARTUP_TIMEOUT_S
    return [
        *options.robot.hil_arguments(address),
        *("--scene", "corridor"),
        *("--people", str(options.people), "--seed", str(options.seed), "--duration", str(longest_s)),
        *("--trace", str(files.trace), "--json", str(files.result("edge-hil"))),
    ]


def _run_arguments(options: DemoOptions) -> list[str]:
    files = options.files
    return [
        *("--artifacts", str(options.artifacts), "--instruction", INSTRUCTION, "--mode", "async"),
        *("--duration", str(options.duration_s), "--release-delay", str(RELEASE_DELAY_S)),
        *("--record", str(files.flight_log), "--json", str(files.result("edge-run"))),
        *(("--live", "0") if options.live else ()),
    ]


def _live_line(log: Path) -> str | None:
    """Return the runner's line with the live view's address."""
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
    return next((line.partition("edge-run: ")[2] for line in lines if "live view: http" in line), None)


def _says_ready(log: Path) -> bool:
    return READY_LINE in log.read_text(encoding="utf-8", errors="replace")


def parser() -> argparse.ArgumentParser:
    """Return the argument parser."""
    p = CommandParser(
        "python -m tools.demo",
        description=__doc__,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    p.add_argument("--out", type=Path, default=Path("out/demo"), help="folder for all results (default: out/demo)")
    p.add_argument("--artifacts", type=Path, metavar="DIR", help="artifact directory (default: OUT/artifacts)")
    p.add_argument("--duration", type=float, default=60.0, metavar="S", help="time to drive in s (default: 60)")
    p.add_argument("--seed", type=int, default=0, help="seed of the simulated world (default: 0)")
    p.add_argument("--people", type=int, default=4, help="walking people (default: 4)")
    p.add_argument("--robot", choices=tuple(ROBOTS), default=GO2.name, help=f"robot to drive (default: {GO2.name})")
    p.add_argument("--domain", type=int, help="DDS domain of a robot with DDS (default: a free one)")
    p.add_argument("--live", action="store_true", help="serve a live view while it drives, and print its address")
    p.add_argument("--json", metavar="FILE|-", help="also write demo.json's content to this file; - is stdout")
    return p


@command_line("demo")
def main(argv: Sequence[str] | None = None, commands: Mapping[str, Sequence[str]] = COMMANDS) -> int:
    """Run the command; returns its exit code."""
    args = parser().parse_args(argv)
    try:
        domain = free_domain() if args.domain is None else args.domain
        artifacts = args.artifacts or args.out / "artifacts"
        check_result_target(args.json)
        if args.artifacts is not None and artifacts.exists():  # the demo's own are exported again if they do not fit
            read_manifest(artifacts)
        options = DemoOptions(
            args.out, artifacts, args.duration, args.seed, args.people, domain, ROBOTS[args.robot], args.live
        )
        _make_folder(options.log_dir)
    except (ValueError, OSError) as error:
        _print(str(error))
        return EXIT_BAD_INPUT
    # SIGINT too: a shell starts background jobs with SIGINT ignored, and children inherit that.
    before = {number: signal.signal(number, _interrupt) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        summary = run_demo(options, commands)
        write_result(args.json, summary)
    except KeyboardInterrupt:
        _print("interrupted, all processes ended")
        return EXIT_INTERRUPTED
    except (StepError, StackRobotError, ConfigError, ReportError, CheckpointError, OSError) as error:
        _print(str(error))
        return EXIT_CHECK_FAILED
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    failed = [name for name, check in summary["checks"].items() if not check["pass"]]
    for name in failed:
        _print(f"check {name} failed: {json.dumps(summary['checks'][name])}")
    (sys.stderr if args.json == "-" else sys.stdout).write(f"{options.files.report}\n")
    return EXIT_CHECK_FAILED if failed else EXIT_DONE


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = error.strerror or str(error)
        raise ValueError(f"--out: cannot make the folder {folder} ({reason}); name a writable one") from error


def _interrupt(number: int, frame: object) -> None:
    raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(main())
