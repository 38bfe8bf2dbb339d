"""One run: wires the threads together, arms, drives, and takes everything down again, the robot first."""

from __future__ import annotations

import functools
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import psutil

from edge.artifacts.files import ArtifactError
from edge.artifacts.manifest import Artifacts
from edge.core.deadline import Deadline
from edge.flightlog.recorder import Recorder, space_refusal
from edge.flightlog.records import RecordSinks
from edge.inference.graph import GraphError
from edge.inference.language import ContextOverflowError
from edge.inference.scheduling import TickActivity, enter, prepare_process, run_as, schedule_for
from edge.inference.start_guard import WARM_UP_S
from edge.inference.warm_up import check_tick, open_proven, warm_up
from edge.reasoning.generation_cycle import Mode
from edge.reasoning.prompt import InstructionError
from edge.robot.arming import POLL_S, RefusedError, StoppedEarlyError, arm, check_bridge, disarm
from edge.robot.inputs import CommandTap, RobotInputs
from edge.run.assembly import Engines, Loops, RunOptions, StopEvents, assemble
from edge.run.instructions import STOP_PHRASE, InstructionChannels, open_channels
from edge.run.result import close_log, run_record, run_result
from edge.run.service import ServiceReporter
from edge.run.views import LIVE_STOP, Views
from edge.safety.faults.findings import Finding
from edge.safety.late_command import hold_while_late
from edge.safety.watchdog import Hang, ReasoningWatch
from firmware_bridge.client import BridgeClient, BridgeStatus, BridgeUnavailable
from firmware_bridge.core.config import RobotConfig
from firmware_bridge.dds.shared_bus import SharedBus
from firmware_bridge.system.notify import Notifier

CAMERA_LEAD = 0.5
"""Share of a tick period by which a frame is requested before the tick that uses it."""
READY_TIMEOUT_S = 10.0
OPEN_S = 60.0
"""Time limit of a service for hashing, opening and warming up a large model's graphs, s."""
END_S = 7.0
"""Time limit of the whole shutdown, s; systemd kills a service after 10 s (TimeoutStopSec)."""
JOIN_S = 3.0
"""Part of it for both loops' threads, s; a call of a graph is interrupted."""
STOP_CONFIRM_S = 1.0
"""Part of it for the bridge's confirmation that it has sent zero velocity, s."""
STANDSTILL_S = 2.0
"""Time for the robot to come to rest and report it, s."""
LINES = 200
"""Lines for the operator that wait to be printed; more are dropped, oldest first."""


class RunSession:
    """One run of `edge-run` against one robot."""

    def __init__(
        self, artifacts: Artifacts, robot: RobotConfig, options: RunOptions, say: Callable[[str], None]
    ) -> None:
        """Open the graphs and warm them up.

        Raises ArtifactError, InstructionError for a prompt that is too long, ConfigError for switches that contradict.
        """
        runtime = artifacts.runtime
        self._artifacts = artifacts
        self._robot = robot
        self._options = options
        self._print = say
        # Threads append lines, and the main thread prints them.
        self._lines: deque[str] = deque(maxlen=LINES)
        self._period_ns = runtime.tick_period_ms * 1_000_000
        self._schedule = schedule_for(artifacts)
        self._lines.extend(self._schedule.notes)
        self._loops: Loops | None = None
        self._bus = SharedBus(robot.network) if robot.protocol == "ros2" else None  # of the camera and instructions
        self._reporter = ServiceReporter(Notifier(os.environ), tick_period_ns=self._period_ns, describe=self._describe)
        self._reporter.starting("opening the graphs", OPEN_S)
        if artifacts.guided_by_waypoints and options.mode is Mode.NO_REASONING:
            raise InstructionError(
                f"--mode {Mode.NO_REASONING.value}: {artifacts.directory} is guided by the waypoints that reasoning "
                f"writes; run it with {Mode.ASYNC.value} or {Mode.SYNC.value}"
            )
        switches = options.switches_for(artifacts)
        activity = TickActivity(self._period_ns)
        opened = open_proven(artifacts, schedule=self._schedule, activity=activity)
        policy, language = opened.policy, opened.language
        self._lines.append(f"self-test: {opened.tested}")
        language.check_instruction(options.instruction)
        try:
            with opened.guard.stage("warming up", WARM_UP_S):
                warm = warm_up(policy, language, switches.speculation)
        except (GraphError, ContextOverflowError) as error:
            raise ArtifactError(f"{artifacts.directory}: the graphs do not run ({error})") from error
        self._lines.extend(warm.notes)
        check_tick(artifacts, warm.tick_ms)
        self._engines = Engines(artifacts, policy, language, self._schedule, activity)
        self._stop, self._finished = StopEvents(), threading.Event()
        self._stop_requested = False
        self._faults: list[str] = []
        self._began = False
        self.hung = False
        """Whether a loop hangs in a call that only the end of the process ends."""

    def _stop_by(self, bridge: BridgeClient, why: str) -> bool:
        """Stop the robot and end the run; return whether the bridge reports standstill within STANDSTILL_S."""
        bridge.stop()
        if why not in self._faults:
            self._faults.append(why)
        self._stop_requested = True
        self._stop.set()
        return disarm(bridge, limit_s=STANDSTILL_S)

    def _take_instructions(self, channel: InstructionChannels | None, loops: Loops) -> None:
        """Forward a new instruction to reasoning; after a stop phrase the robot has been stopped on return."""
        if channel is not None and (instruction := channel.poll()) is not None:
            loops.reasoning.submit(instruction)
            self._options = replace(self._options, instruction=instruction)
            self._print(f"new instruction: {instruction}")

    def request_stop(self) -> None:
        """Request a clean end. Safe in a signal handler: it takes no lock, and the main thread polls the flag."""
        self._stop_requested = True

    def run(self) -> dict[str, Any]:
        """Arm, drive, stop; returns the result.

        Raises RefusedError, ArtifactError, BridgeUnavailable, LinkOpenError, CalibrationError or StoppedEarlyError
        before the robot has moved.
        """
        refusal = None if self._options.record is None else space_refusal(self._options.record)
        if refusal is not None:
            raise RefusedError(f"--record {self._options.record}: {refusal}")
        self._reporter.starting("waiting for the robot", READY_TIMEOUT_S + self._robot.bridge.arm_timeout_s + OPEN_S)
        bridge = BridgeClient(self._robot.bridge.socket)
        inputs: RobotInputs | None = None
        recorder: Recorder | None = None
        views = Views()
        channel: InstructionChannels | None = None
        result: dict[str, Any] | None = None
        end: Deadline | None = None
        try:
            check_bridge(bridge.poll(), self._robot)
            sink = CommandTap(bridge)
            # The threads of a protocol's library inherit the priority, so that poses and pictures do not wait either.
            inputs = run_as(
                self._schedule.inputs,
                lambda: RobotInputs(
                    self._robot,
                    image_px=self._artifacts.runtime.image_px,
                    period_ns=self._period_ns,
                    commanded=lambda: sink.commanded,
                    say=self._lines.append,
                    on_death=self._end_by,
                    bus=self._bus,
                ),
            )
            inputs.camera.start()
            stop = functools.partial(self._stop_by, bridge)
            # Each may take 10 s: before the wait, from which on systemd's watchdog may count.
            views.open(self._options.live, self._robot, functools.partial(stop, LIVE_STOP), self._print)
            self._await_inputs(inputs, bridge, views)
            if self._options.record is not None:
                recorder = Recorder(self._options.record, from_run=True, say=self._lines.append)
                if recorder.error is not None:
                    raise RefusedError(recorder.error)
            views.watch(recorder)
            records = RecordSinks.of(recorder, views.live, views.ros2)
            loops = self._loops = assemble(
                self._engines, self._robot, self._options, inputs, sink, records, stop=self._stop,
                say=self._lines.append, on_tick=self._reporter.on_tick,
            )  # fmt: skip
            by_phrase, check = functools.partial(stop, STOP_PHRASE), self._engines.language.check_instruction
            say, live = self._lines.append, views.live
            channel = open_channels(self._options, self._robot, self._bus, check, by_phrase, say, live)
            loops.power.start()
            self._lines.extend(prepare_process(self._schedule.inputs))
            loops.control.last_seq = self._arm(bridge, loops, channel)
            self._print(f"armed and driving {self._robot.name}: {self._options.instruction}")
            started_ns = time.monotonic_ns()
            process = psutil.Process()
            process.cpu_percent()
            self._began = True
            if records is not None:
                records.put("/run", started_ns, run_record(self._artifacts, self._robot, self._options, started_ns))
                inputs.recorder = records
            threading.Thread(target=self._hold, args=(sink,), name="late-command", daemon=True).start()
            end = self._drive(loops, inputs, bridge, channel)
            status = self._halt(bridge, end)
            result = run_result(
                loops.control,
                loops.reasoning,
                inputs,
                status,
                self._options.switches_for(self._artifacts),
                power_w=loops.power.statistics(),
                faults=list(self._faults),
                duration_s=(time.monotonic_ns() - started_ns) / 1e9,
            )
            result["cpu_percent"] = process.cpu_percent()
            if records is not None:
                records.put("/result", time.monotonic_ns(), result)
        finally:
            # Whatever ended the run: closing the connection makes the bridge stop the robot.
            bridge.close()
            if channel is not None:
                channel.close()
            views.close()
            end = end or Deadline(END_S)
            if recorder is not None and (line := close_log(recorder, result, began=self._began, left_s=end.left_s())):
                self._print(line)
            if self._loops is not None:
                end.run("close-power", self._loops.power.close)
            if inputs is not None:
                end.run("close-inputs", inputs.close)
            if self._bus is not None:
                end.run("close-bus", self._bus.close)
            self._print_lines()
        return result

    def _end_by(self, why: str) -> None:
        """End the run because a necessary thread has died; any thread may call it."""
        self._faults.append(why)
        self._finished.set()

    def _describe(self) -> str:
        if self._loops is None:
            return "starting"
        supervision = self._loops.control.supervision
        faults = f" ({', '.join(supervision.active)})" if supervision.active else ""
        return f"{supervision.state.value}{faults}, {self._loops.reasoning.cycle.published} generations"

    def _await_inputs(self, inputs: RobotInputs, bridge: BridgeClient, views: Views) -> None:
        """Wait for a frame and a pose; without a time limit where an operator arms the robot."""
        waits = self._robot.safety.operator_arm
        deadline, reported = Deadline(READY_TIMEOUT_S), False
        while not inputs.ready:
            if views.live is not None:
                views.live.poll()
            if self._stop_requested:
                raise StoppedEarlyError("stopped before the robot was armed")
            if self._finished.is_set():
                raise RefusedError(self._faults[0])
            status = bridge.poll()  # raises when the connection has ended
            missing = "state" if inputs.history.newest() is None else "camera frame"
            if deadline.left_s() <= 0 and not waits:
                where, why = self._robot.address, inputs.why_missing(status)
                raise RefusedError(f"no {missing} from the robot in {READY_TIMEOUT_S:.0f} s on {where}{why}: is it on?")
            if waits:
                self._reporter.on_wait(f"waiting for the robot: no {missing} yet")
                self._print_lines()
                if deadline.left_s() <= 0 and not reported:
                    reported = True
                    self._print(f"waiting for the robot: no {missing} yet, is it on?")
            time.sleep(POLL_S)

    def _arm(self, bridge: BridgeClient, loops: Loops, channel: InstructionChannels | None) -> int:
        """Arm, after an operator where the robot file requires one; return the last sequence number used.

        Raises RefusedError after a stop phrase, StoppedEarlyError after another request to stop.
        """

        def stop_requested() -> bool:
            self._take_instructions(channel, loops)
            if channel is not None and channel.stopped:
                raise RefusedError(f"not armed: {self._faults[-1] if self._faults else STOP_PHRASE}")
            return self._stop_requested

        def on_wait(text: str) -> None:
            self._reporter.on_wait(text)
            self._print_lines()

        def obstacle() -> str:
            if self._finished.is_set():
                raise RefusedError(self._faults[0])
            return loops.pre_arm.blocking_fault()

        return arm(
            bridge,
            limit_s=self._robot.bridge.arm_timeout_s + 2.0,
            stop_requested=stop_requested,
            say=self._print,
            on_wait=on_wait,
            obstacle=obstacle,
            operator=self._robot.safety.operator_arm,
        )

    def _drive(
        self, loops: Loops, inputs: RobotInputs, bridge: BridgeClient, channel: InstructionChannels | None
    ) -> Deadline:
        """Run both threads to their end while this thread watches them; return the deadline of the shutdown."""
        # The bridge's deadman is already running: the first command must not wait for a whole period.
        epoch_ns = time.monotonic_ns() + self._period_ns // 2
        inputs.camera.align(epoch_ns - round(CAMERA_LEAD * self._period_ns))
        duration_s = self._options.duration_s
        end_ns = None if duration_s is None else epoch_ns + round(duration_s * 1e9)
        control, reasoning = loops.control, loops.reasoning

        def drive() -> None:
            self._lines.extend(enter(self._schedule.control))
            ended = control.run(epoch_ns, end_ns)
            if ended is not None:
                self._faults.append(f"the {control.ended_by} ended the run: {ended}")

        def stop_robot() -> None:
            # Before the wait for the reasoning thread.
            bridge.stop()
            self._reporter.stopping(self._faults[0] if self._faults else "the run has ended")

        # Daemon threads: one that hangs in a driver must not keep the process alive.
        threads = [
            threading.Thread(target=self._guard("control", drive, stop_robot), name="control", daemon=True),
            threading.Thread(target=self._guard("reasoning", reasoning.run), name="reasoning", daemon=True),
        ]
        for thread in threads:
            thread.start()
        self._watch_run(loops, inputs, channel)
        self._stop.set()
        end = Deadline(END_S)
        reasoning.cancel()
        join = Deadline(JOIN_S)
        for thread in threads:
            thread.join(join.left_s())
            if thread.is_alive():
                self._faults.append(f"the {thread.name} thread did not end within {JOIN_S:g} s")
                self.hung = self.hung or thread.name == "control"
        return end

    def _guard(
        self, name: str, body: Callable[[], None], after: Callable[[], None] | None = None
    ) -> Callable[[], None]:
        """Run a thread's body; its end ends the run. `after` is called once its faults are recorded."""

        def target() -> None:
            try:
                body()
            except BridgeUnavailable as error:
                self._faults.append(f"bridge lost: {error}")
            except Exception as error:  # noqa: BLE001 - a dead thread must end the run, whatever the error
                self._faults.append(f"{name} thread died: {type(error).__name__}: {error}")
            finally:
                if after is not None:
                    after()
                self._finished.set()

        return target

    def _hold(self, commands: CommandTap) -> None:
        """Keep the robot at rest while a command of the control thread is late."""
        enter(self._schedule.late_command)
        hold_while_late(commands, self._finished)

    def _watch_run(self, loops: Loops, inputs: RobotInputs, channel: InstructionChannels | None) -> None:
        """Forward lines and instructions and watch reasoning until a thread has ended or a stop is requested.

        Once reasoning was given up, it waits JOIN_S for the control thread, which may hang as well.
        """
        reasoning, message, watch = loops.reasoning, "", ReasoningWatch()
        end: Deadline | None = None
        while not (self._finished.wait(POLL_S) or self._stop_requested or (end is not None and end.left_s() <= 0)):
            if loops.control.supervision.message != message:
                message = loops.control.supervision.message
                self._print(message or "all faults have cleared")
            self._print_lines()
            self._take_instructions(channel, loops)
            longest_ms = reasoning.times.generation_ms.quantile(1.0)
            hang = watch.step(reasoning.last_progress_ns, longest_ms, time.monotonic_ns())
            if hang is Hang.INTERRUPT:
                self._print(f"reasoning has been in one call for {watch.hung_s:.0f} s; it is interrupted")
                reasoning.cancel()
            elif hang is Hang.GIVE_UP and not self.hung:
                self.hung, end = True, Deadline(JOIN_S)
                inputs.findings.put((Finding("reasoning-hung", f"for {watch.hung_s:.0f} s"),))

    def _halt(self, bridge: BridgeClient, end: Deadline) -> BridgeStatus | None:
        """Wait until the bridge confirms zero velocity; it sends zero in any case within its deadman time."""
        status: BridgeStatus | None = None
        try:
            confirm = Deadline(end.left_s(STOP_CONFIRM_S))
            while confirm.left_s() > 0:
                status = bridge.poll()
                if status is not None and status.state == "stopped" and status.zero_after_stop:
                    return status
                time.sleep(0.01)
            self._faults.append(f"the bridge did not confirm zero velocity within {STOP_CONFIRM_S:g} s")
        except BridgeUnavailable as error:
            if not self._faults:
                self._faults.append(f"bridge lost: {error}")
        return status

    def _print_lines(self) -> None:
        while self._lines:
            self._print(self._lines.popleft())
