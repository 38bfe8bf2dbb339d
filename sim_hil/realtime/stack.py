"""The stack: simulated robot, bridge and runner as real processes, started and ended as by a user."""

from __future__ import annotations

import math
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Literal

from edge.live.options import LiveOptions
from edge.state.switches import SwitchOptions
from firmware_bridge.core.config import BRIDGE_PRIORITY
from sim_hil.protocols.fault_socket import FaultClient
from sim_hil.realtime.children import Child, Children, Tick, uninterrupted
from sim_hil.realtime.host_stall import STALL_PRIORITY
from sim_hil.realtime.robots import BRIDGE_SOCKET, GO2, RunAddress, StackRobot

ProcessName = Literal["robot", "bridge", "runner"]
READY_LINE = "edge-hil: ready"
STALLS = "stalls.jsonl"
ARMED_LINE = "armed and driving"

# Run as modules of this interpreter, so that any virtual environment will do, activated or not.
COMMANDS: Mapping[str, Sequence[str]] = {
    "edge-export": (sys.executable, "-m", "export.cli"),
    "edge-hil": (sys.executable, "-m", "sim_hil.hil.command"),
    "edge-bridge": (sys.executable, "-m", "firmware_bridge.bridge"),
    "edge-run": (sys.executable, "-m", "edge.run.command"),
}

INSTRUCTION = "walk down the corridor and stop at the vending machine"
"""Instruction of the demo, the faults and the measurements in the scene `corridor`."""

ROBOT_PRIORITY = 35
"""Real-time priority of the robot's side where permitted: a robot has a computer of its own, so neither ordinary
programs nor reasoning, which computes for long, may slow it. Ticks and the bridge come first.
"""
READY_TIMEOUT_S = 120.0
BRIDGE_TIMEOUT_S = 30.0
GRACE_S = 12.0
"""Time for a process to end, s; the runner may take 7 s (edge.run.session.END_S)."""


@dataclass(frozen=True)
class StackOptions:
    """Options of a stack; `folder` exists and receives results and logs."""

    folder: Path
    artifacts: Path
    scene: str
    start: tuple[float, float, float]
    people: int
    seed: int
    domain: int
    robot: StackRobot = GO2
    mode: str = "async"
    release_delay: str = "0"
    odometry_noise: str = "none"
    speed_limit_mps: float | None = None
    """Forward speed limit, m/s; None: the robot file's."""
    faults: bool = False
    instructions: bool = False
    """Whether the runner accepts further instructions while driving."""
    switches: SwitchOptions = field(default_factory=SwitchOptions)
    """Decoding rules and recoveries requested from the runner."""
    live: LiveOptions | None = None
    """Where the runner's live view listens; None: there is none."""
    pose_hz: int | None = None
    """Poses a second in the trace; None: edge-hil's default."""

    def __post_init__(self) -> None:
        if self.speed_limit_mps is not None and not 0.01 <= self.speed_limit_mps <= 1.5:
            raise ValueError(f"speed limit: expected 0.01 to 1.5 m/s, found {self.speed_limit_mps}")
        if self.people < 0 or self.seed < 0 or not all(map(math.isfinite, self.start)):
            raise ValueError(f"stack: expected people and seed of 0 or more and a finite start, found {self}")


class Stack:
    """Running stack: a context manager that ends exactly the processes that it started, the runner first."""

    def __init__(self, options: StackOptions) -> None:
        self.options = options
        self.runs = 0
        """Number of started runners; also the number in the newest runner's file names."""
        self.robot: Child | None = None
        self.bridge: Child | None = None
        self.runner: Child | None = None
        self.faults: FaultClient | None = None
        self._watch: Child | None = None
        self._children = Children(options.folder, grace_s=GRACE_S)
        self._sockets = Path(tempfile.mkdtemp(prefix="tic-"))
        file = options.folder / "robot.toml"
        try:
            self._address = RunAddress.free(self._sockets, options.domain)
            self.robot_file = options.robot.write_file(file, self._address, options.speed_limit_mps)
            """The run's own robot file."""
        except BaseException:
            shutil.rmtree(self._sockets, ignore_errors=True)
            raise

    def __enter__(self) -> Stack:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with uninterrupted():
            self._children.__exit__(kind, error, trace)
            if self._watch is not None:
                self._children.end(self._watch)
            if self.faults is not None:
                self.faults.close()
            shutil.rmtree(self._sockets, ignore_errors=True)

    @property
    def trace(self) -> Path:
        """Trace with the ground truth, written by edge-hil."""
        return self.options.folder / "trace.jsonl"

    @property
    def instructions(self) -> Path:
        """Instruction socket of the newest runner."""
        return self._sockets / f"say{self.runs}"

    def flight_log(self, run: int) -> Path:
        """Return the flight log of a runner; runners are numbered from 1."""
        return self.options.folder / f"flight-{run}.mcap"

    def result(self, name: str) -> Path:
        """Return the result file of a process: edge-hil, edge-bridge-N or edge-run-N."""
        return self.options.folder / f"{name}.json"

    def processes(self) -> dict[str, int]:
        """Return the ids of the running processes by command name."""
        found = {"edge-hil": self.robot, "edge-bridge": self.bridge, "edge-run": self.runner}
        return {name: child.process.pid for name, child in found.items() if child is not None and child.running}

    @property
    def stalls(self) -> Path:
        """The machine's stalls, written since `watch_stalls`; see `sim_hil.realtime.host_stall.read_stalls`."""
        return self.options.folder / STALLS

    def watch_stalls(self) -> None:
        """Start the process that measures the machine's own stalls; its end ends nothing else. Raises StepError."""
        command = [sys.executable, "-m", "sim_hil.realtime.host_stall", str(self.stalls)]
        self._watch = self._children.start("host-stall", command, fifo_priority=STALL_PRIORITY)
        self._children.forget(self._watch)

    def start_robot(self, tick: Tick) -> None:
        """Start the simulated robot and wait until it is ready. Raises StepError."""
        options = self.options
        x_m, y_m, theta_rad = options.start
        command = [
            *COMMANDS["edge-hil"],
            *options.robot.hil_arguments(self._address),
            *("--scene", options.scene),
            # One argument, because the value may begin with a minus.
            f"--start={x_m!r},{y_m!r},{math.degrees(theta_rad)!r}",
            *("--people", str(options.people), "--seed", str(options.seed)),
            *("--odometry-noise", options.odometry_noise),
            *("--trace", str(self.trace), "--json", str(self.result("edge-hil"))),
        ]
        if options.pose_hz is not None:
            command += ["--pose-hz", str(options.pose_hz)]
        faults = self._sockets / "faults"
        if options.faults:
            command += ["--faults", str(faults)]
        robot = self.robot = self._children.start("edge-hil", command, fifo_priority=ROBOT_PRIORITY)
        ready = lambda: READY_LINE in _text(robot.log)  # noqa: E731 - one line, used once
        self._children.wait_until(robot, ready, READY_TIMEOUT_S, "ready line", tick)
        if options.faults:
            self.faults = FaultClient(faults, self._sockets / "asked")

    def start_bridge(self, tick: Tick) -> None:
        """Start the bridge, with its service's real-time priority if permitted, and wait for its socket.

        Beside the watch for stalls the bridge stays on one processor. From a processor that the watch interrupts the
        kernel moves it to another one, where it can wait for 10 to 28 ms: a virtual machine's processors interrupt
        each other late, and by then the watch has interrupted that one, too. Raises StepError.
        """
        socket = self._sockets / BRIDGE_SOCKET
        socket.unlink(missing_ok=True)  # left by a killed bridge
        name = f"edge-bridge-{self.runs + 1}"
        command = [*COMMANDS["edge-bridge"], *self._link(), "--json", str(self.result(name))]
        processors = (max(os.sched_getaffinity(0)),) if self._is_watched() else ()
        bridge = self.bridge = self._children.start(name, command, fifo_priority=BRIDGE_PRIORITY, processors=processors)
        self._children.wait_until(bridge, socket.exists, BRIDGE_TIMEOUT_S, f"socket {socket}", tick)

    def _is_watched(self) -> bool:
        """Whether the watch for stalls interrupts the bridge: it may use its priority."""
        with suppress(ProcessLookupError):
            return self._watch is not None and os.sched_getscheduler(self._watch.process.pid) == os.SCHED_FIFO
        return False

    def start_runner(self, instruction: str) -> Child:
        """Start the runner, which arms and drives by itself (see `armed`)."""
        options = self.options
        self.runs += 1
        name = f"edge-run-{self.runs}"
        command = [
            *COMMANDS["edge-run"],
            *self._link(),
            *("--artifacts", str(options.artifacts), "--instruction", instruction, "--mode", options.mode),
            *("--release-delay", options.release_delay),
            *("--record", str(self.flight_log(self.runs)), "--json", str(self.result(name))),
        ]
        if options.instructions:
            command += ["--instructions", str(self.instructions)]
        command += options.live.arguments() if options.live else []
        asked = options.switches
        command += ["--decoding", asked.decoding.value] if asked.decoding else []
        command += ["--recovery", asked.recovery.value] if asked.recovery else []
        command += ["--speculation", asked.speculation.value] if asked.speculation else []
        if asked.stand_at_goal is not None:
            command += ["--stay" if asked.stand_at_goal else "--no-stay"]
        self.runner = self._children.start(name, command)
        return self.runner

    def armed(self) -> bool:
        """Return whether the newest runner drives or has driven."""
        return self.runner is not None and ARMED_LINE in _text(self.runner.log)

    def check(self) -> None:
        """Check that robot and bridge still run. Raises StepError."""
        self._children.check_others(self.runner)

    def end(self, name: ProcessName) -> int | None:
        """End a process and return its exit code, negative for a signal; None if it was not started.

        Ending the robot completes its trace.
        """
        child: Child | None = getattr(self, name)
        if child is None:
            return None
        setattr(self, name, None)
        self._children.end(child)
        with suppress(ValueError):
            self._children.forget(child)
        return child.process.returncode

    def _link(self) -> list[str]:
        return ["--robot", str(self.robot_file)]


def _text(log: Path) -> str:
    return log.read_text(encoding="utf-8", errors="replace")


@contextmanager
def socket_dir() -> Iterator[Path]:
    """Yield a temporary folder with a short path, because a Unix socket's path is limited to 107 bytes."""
    folder = Path(tempfile.mkdtemp(prefix="tic-"))
    try:
        yield folder
    finally:
        with uninterrupted():
            shutil.rmtree(folder, ignore_errors=True)
