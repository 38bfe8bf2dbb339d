"""Rig of robot's side, bridge and runner as real processes on loopback, with the operations of the faults.

A sniffer stamps requests in a process of its own and distinguishes their writers. MAVLink's UDP link has one receiver
only: there the trace of edge-hil has the requests as its front end receives them.
"""

from __future__ import annotations

import secrets
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

import can

from firmware_bridge.can.frame import ERROR_BUS_OFF, ERROR_RESTARTED
from firmware_bridge.can.multicast import LoopbackMulticastBus
from firmware_bridge.core.config import BRIDGE_PRIORITY, RobotConfig, load_robot_config
from sim_hil.processes.child_process import last_lines
from sim_hil.protocols.fault_socket import FaultClient, FaultError
from sim_hil.realtime.children import Child, Children, StepError
from sim_hil.realtime.host_stall import STALL_PRIORITY
from sim_hil.realtime.robots import (
    BRIDGE_SOCKET,
    CAN_BETWEEN_PROCESSES,
    GO2,
    MAVLINK_KEY,
    MAVLINK_SIGNED,
    RunAddress,
    StackRobot,
)
from sim_hil.realtime.stack import COMMANDS, INSTRUCTION, READY_LINE, ROBOT_PRIORITY
from sim_hil.realtime.truth import LineTail
from tools.faults.rig.busy import paused
from tools.faults.rig.circle import SPEED_MPS
from tools.faults.rig.received import ReceivedCommands

READY_TIMEOUT_S = 90.0
MOVING_TIMEOUT_S = 60.0
_POLL_S = 0.01
_STEADY_MOVES = 10  # 0.2 s of the bridge's commands
_STEADY_SHARE = 0.9
_ATTEMPTS = 4
_LOADED_S = 1.0
"""Time beside the busy processes before an injection into a new run."""
_COMMANDER_S = 2.2
_PERMIT_TIMEOUT_S = 4.0


def _has_printed(child: Child, text: str) -> bool:
    return text in child.log.read_text()


class Rig:
    """Processes of one robot; the context manager ends only processes that it started."""

    def __init__(
        self,
        folder: Path,
        artifacts: Path,
        domain: int | None,
        log: Callable[[str], None],
        *,
        record: bool = True,
        stack_robot: StackRobot = GO2,
        runner_arguments: Sequence[str] = (),
        children: Children | None = None,
    ) -> None:
        """Create the rig with sockets and logs in `folder`; a socket's path has at most 107 bytes.

        `runner_arguments`: further arguments of edge-run. `children` starts and ends the processes. Raises
        StackRobotError for a robot that cannot be driven here.
        """
        self.folder = folder
        # A serial line has room for two processes, the bus between processes also for a sniffer and a second commander.
        harder = {"can": CAN_BETWEEN_PROCESSES, "mavlink": MAVLINK_SIGNED}
        self.stack_robot = harder.get(stack_robot.protocol, stack_robot)
        key = folder / MAVLINK_KEY
        key.touch(0o600)
        key.write_text(secrets.token_hex(32), encoding="ascii")
        self.address = RunAddress.free(folder, domain)
        self._robot_file = self.stack_robot.write_file(folder / "robot.toml", self.address)
        self.config: RobotConfig = load_robot_config(self._robot_file)
        places = {"can": "{can_group}", "mavlink": f"{{udp_port}},{{folder}}/{MAVLINK_KEY}"}
        self._bus = self.address.filled(places.get(stack_robot.protocol, "{domain}"))
        self._sniffs = stack_robot.protocol != "mavlink"
        self.received = ReceivedCommands(folder / ("received.jsonl" if self._sniffs else "trace.jsonl"))
        self.stand_in = self._is_stand_in = False
        """Whether the next injection may be made into a run of the runner's stand-in."""
        self.busy: Sequence[int] = ()
        """Ids of the busy processes beside the rig; they stand still while a bridge or a runner starts."""
        self.jump_m = 1.0
        self.needs_operator = False
        self._artifacts = artifacts
        self._record = record
        self._log = log
        self._runner_arguments = list(runner_arguments)
        self._children = children or Children(folder, grace_s=5.0)
        self._trace = LineTail(folder / "trace.jsonl")
        self._obeys: list[tuple[int, bool]] = []
        self._accepted_ns: list[int] = []
        self._runs = 0
        self._rogues: list[Child] = []
        self.hil: Child | None = None
        self.bridge: Child | None = None
        self.runner: Child | None = None
        self.robot = FaultClient(folder / "hil.faults", folder / "a")
        self._inside: FaultClient | None = None

    def __enter__(self) -> Rig:
        return self

    def __exit__(self, *error: object) -> None:
        for rogue in self._rogues:
            rogue.process.kill()
            rogue.process.wait()
        self._children.__exit__(None, None, None)
        self.robot.close()
        if self._inside is not None:
            self._inside.close()

    @property
    def inside(self) -> FaultClient:
        """Client that switches the runner's internal faults."""
        assert self._inside is not None
        return self._inside

    def start(self) -> None:
        """Start the robot's side and the sniffer, and wait for both. Raises StepError."""
        scene = [*self.stack_robot.hil_arguments(self.address), "--scene", "corridor", "--people", "0"]
        where = ["--trace", str(self.folder / "trace.jsonl"), "--faults", str(self.folder / "hil.faults")]
        command = [*COMMANDS["edge-hil"], *scene, *where]
        self.hil = self._children.start("edge-hil", command, fifo_priority=ROBOT_PRIORITY)
        waited = [(self.hil, READY_LINE)]
        if self._sniffs:
            sniffer = [sys.executable, "-m", "tools.faults.rig.sniffer", self.stack_robot.protocol, self._bus]
            sniffer += ["--out", str(self.folder / "received.jsonl")]
            # Of ordinary priority it would stamp late beside busy processes, and the reaction would seem late.
            child = self._children.start("sniffer", sniffer, fifo_priority=STALL_PRIORITY)
            waited.append((child, "sniffer: ready"))
        for child, line in waited:
            self._wait(partial(_has_printed, child, line), READY_TIMEOUT_S, child, line)

    def start_bridge(self) -> None:
        """Start edge-bridge with the real-time priority of its service, if permitted, and wait for its socket."""
        self.bridge = self._children.start(
            "edge-bridge", [*COMMANDS["edge-bridge"], *self._link()], fifo_priority=BRIDGE_PRIORITY
        )
        self._wait(partial(_has_printed, self.bridge, "ready"), 30.0, self.bridge, "ready line")

    def start_runner(self) -> None:
        """Start edge-run with switchable faults, or its stand-in; it arms and drives by itself."""
        if self._inside is not None:
            self._inside.close()
            self._inside = None
        self._runs += 1
        self._is_stand_in = self.stand_in
        if self.stand_in:
            command = [sys.executable, "-m", "tools.faults.rig.driver", *self._link()]
            self.runner = self._children.start(f"driver-{self._runs}", command)
            return
        socket = self.folder / f"r{self._runs}.faults"
        command = [sys.executable, "-m", "tools.faults.rig.faulty_runner", str(socket), *self._link()]
        command += ["--artifacts", str(self._artifacts), "--instruction", INSTRUCTION]
        if self._record:
            command += ["--record", str(self.folder / f"flight{self._runs}.mcap")]
        self.runner = self._children.start(f"edge-run-{self._runs}", [*command, *self._runner_arguments])
        self._inside = FaultClient(socket, self.folder / f"i{self._runs}")

    def ensure_moving(self) -> None:
        """Start what is not running and wait until the robot is driven at full speed. Raises StepError."""
        if self._is_stand_in != self.stand_in:
            self.kill_runner()
        runs = all(child is not None and child.running for child in (self.bridge, self.runner))
        with paused(() if runs else self.busy):
            self._ensure_moving()
        if not runs and self.busy:
            time.sleep(_LOADED_S)

    def _ensure_moving(self) -> None:
        for _ in range(_ATTEMPTS):
            if self.bridge is None or not self.bridge.running:
                self.kill_runner()
                self.kill_bridge()
                self.start_bridge()
            if self.runner is None or not self.runner.running:
                self.kill_runner()
                self.start_runner()
            assert self.runner is not None
            runner = self.runner
            if self.needs_operator:
                self._wait(partial(_asks_or_ended, runner), MOVING_TIMEOUT_S, runner, "request")
                if runner.running:
                    self._operator_arms()
                    self.needs_operator = False
            self._wait(partial(self._moving_or_ended, runner), MOVING_TIMEOUT_S, runner, "motion")
            if runner.running:
                return
            self._log(f"the runner ended too early: {last_line(runner)}")
        raise StepError(f"the runner ended {_ATTEMPTS} times too early: {last_line(runner)}")

    def _moving_or_ended(self, runner: Child) -> bool:
        return self.moving() or not runner.running

    def moving(self) -> bool:
        """Return whether the newest commands are recent and near full speed."""
        last = self.received.last_moves(_STEADY_MOVES)
        fresh = bool(last) and time.monotonic_ns() - last[-1].t_ns < 200_000_000
        fast = [one.velocity is not None and one.velocity[0] >= _STEADY_SHARE * SPEED_MPS for one in last]
        return fresh and len(last) == _STEADY_MOVES and all(fast)

    def drives_on(self, timeout_s: float) -> bool:
        """Wait for motion at any speed, without starting a process; returns False without motion."""
        deadline_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        while not all(one.moving for one in self.received.last_moves(_STEADY_MOVES)):
            gone = self.runner is None or not self.runner.running
            if gone or time.monotonic_ns() > deadline_ns:
                return False
            time.sleep(_POLL_S)
        return True

    def speed_mps(self) -> float:
        """Return the median forward speed of the newest commands, m/s."""
        return statistics.median(abs(one.velocity[0]) for one in self.received.last_moves(25) if one.velocity)

    def send(self, child: Child | None, number: signal.Signals) -> int:
        """Send a signal; returns its time, monotonic ns."""
        assert child is not None
        now_ns = time.monotonic_ns()
        child.process.send_signal(number)
        return now_ns

    def kill_runner(self) -> None:
        """End the runner at once."""
        if self.runner is not None:
            self.runner.process.kill()
            self.runner.process.wait()
        self.forget_runner()

    def kill_bridge(self) -> None:
        """End the bridge at once."""
        if self.bridge is not None:
            self.bridge.process.kill()
            self.bridge.process.wait()
        self._forget(self.bridge)
        self.bridge = None

    def _operator_arms(self) -> None:
        """Permit the waiting runner to arm, as an operator does, and again for a while. Raises StepError.

        The bridge refuses for two seconds after a stop and for one after a person's driving.
        """
        socket = str(self.folder / BRIDGE_SOCKET)
        command = [*COMMANDS["edge-bridge"], "arm", *self._link(), "--socket", socket]
        deadline_ns = time.monotonic_ns() + round(_PERMIT_TIMEOUT_S * 1e9)
        while True:
            done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
            if done.returncode == 0:
                return
            if time.monotonic_ns() > deadline_ns:
                raise StepError(f"edge-bridge arm: exit code {done.returncode}: {done.stderr.strip()}")

    def forget_runner(self) -> None:
        """Stop watching a runner that has ended."""
        self._forget(self.runner)
        self.runner = None
        for log in self.folder.glob("flight*.mcap"):
            log.unlink(missing_ok=True)

    def rogue(self, duration_s: float) -> int:
        """Let a second commander drive for `duration_s` or slightly longer; returns its start, ns."""
        command = [sys.executable, "-m", "tools.faults.rig.rogue", self.stack_robot.protocol, self._bus]
        rogue = self._children.start("rogue", [*command, "--duration", str(duration_s)])
        try:
            self._wait(lambda: "ready" in rogue.log.read_text(), 30.0, rogue, "robot to command")
            rogue.process.send_signal(signal.SIGUSR1)
            self._wait(lambda: "first" in rogue.log.read_text(), 5.0, rogue, "first command")
            return int(rogue.log.read_text().split("first ")[1].split()[0])
        finally:
            self._forget(rogue)  # it ends by itself
            self._rogues.append(rogue)

    def wait_alone(self) -> None:
        """Wait until the bridge has forgotten every second commander."""
        for rogue in self._rogues:
            rogue.process.wait(30.0)
        time.sleep(_COMMANDER_S)

    def bus_off(self) -> int:
        """Report on the CAN bus that the controllers are off; returns the time, ns."""
        return self._error_frame(ERROR_BUS_OFF)

    def bus_restarted(self) -> None:
        """Report on the CAN bus that the controllers are on again."""
        self._error_frame(ERROR_RESTARTED)

    def _error_frame(self, error_class: int) -> int:
        with LoopbackMulticastBus(self._bus) as bus:
            sent_ns = time.monotonic_ns()
            bus.send(can.Message(arbitration_id=error_class, data=bytes(8), is_error_frame=True))
        return sent_ns

    def robot_obeys_motion(self) -> list[tuple[int, bool]]:
        """Return (ns, moving) for each change of the robot's commanded velocity from or to zero, from its trace."""
        self._read_trace()
        return self._obeys

    def accepted_ns(self) -> list[int]:
        """Return the times at which the robot received a valid velocity, ns, from its trace."""
        self._read_trace()
        return self._accepted_ns

    def _read_trace(self) -> None:
        for line in self._trace.lines():
            velocity = line.get("velocity")
            if line["kind"] == "commanded" and isinstance(velocity, list):
                self._obeys.append((int(line["t_ns"]), any(velocity)))
            elif line["kind"] == "wire" and velocity is not None:
                self._accepted_ns.append(int(line["t_ns"]))

    def clear(self) -> None:
        """Switch every fault off, in edge-hil and in the runner if it still runs."""
        self.robot.inject("clear")
        if self._inside is not None and self.runner is not None and self.runner.running:
            with suppress(FaultError):
                self._inside.inject("clear", timeout_s=1.0)

    def _link(self) -> list[str]:
        return ["--robot", str(self._robot_file)]

    def _forget(self, child: Child | None) -> None:
        if child is not None:
            with suppress(ValueError):
                self._children.forget(child)

    def _wait(self, ready: Callable[[], bool], timeout_s: float, child: Child, what: str) -> None:
        deadline_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        while not ready():
            if self.hil is not None and not self.hil.running:
                raise self.hil.failure("the robot's side has ended")
            if not child.running and child is not self.runner:
                raise child.failure(f"ended with exit code {child.process.returncode}")
            if time.monotonic_ns() > deadline_ns:
                raise child.failure(f"no {what} within {timeout_s:g} s")
            time.sleep(_POLL_S)


def _asks_or_ended(runner: Child) -> bool:
    """Return whether a runner waits for an operator's arming or has ended."""
    return "waiting for `edge-bridge arm`" in runner.log.read_text() or not runner.running


def last_line(child: Child) -> str:
    """Return the last line of a process's log that is not JSON."""
    lines = [line for line in last_lines(child.log, 4) if "{" not in line]
    return lines[-1] if lines else f"nothing, exit code {child.process.returncode}"
