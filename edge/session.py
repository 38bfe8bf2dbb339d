"""One run: wires the threads together, arms, drives, and takes everything down again, the robot first."""

from __future__ import annotations

import math
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from edge.arming import POLL_S, RefusedError, StoppedEarlyError, arm
from edge.artifact_files import ArtifactError
from edge.command_tap import CommandTap
from edge.control_loop import ControlLoop
from edge.controller import Controller, ControllerConfig
from edge.geometry import SE2
from edge.graph import GraphError
from edge.guidance import STRAIGHT_AHEAD
from edge.language import ContextOverflowError, LanguageModel
from edge.manifest import Artifacts
from edge.monitors.semantic import SemanticConfig
from edge.monitors.watch import Sources, Watch, WatchConfig
from edge.policy import Policy
from edge.power.monitor import Activity, PowerMonitor
from edge.prompt import InstructionError
from edge.reasoning_loop import Mode, ReasoningLoop, SemanticSlot
from edge.recorder import Recorder, space_refusal
from edge.release import ReleaseDelay
from edge.ring import EncodedFrame, TokenRing
from edge.robot_inputs import RobotInputs
from edge.run_power import make_power_monitor
from edge.run_result import run_result
from edge.scheduling import GiveWay, TickActivity, enter, freeze_garbage, lock_memory, schedule_for
from edge.semantic import SemanticState
from edge.service import ServiceReporter
from edge.supervisor import Supervisor
from firmware_bridge.client import BridgeClient, BridgeStatus, BridgeUnavailable
from firmware_bridge.config import RobotConfig
from firmware_bridge.notify import Notifier

FRAME_MAX_AGE_MS = 500.0
"""Fault matrix row 1: zero velocity 500 ms after the camera's last good frame."""
HISTORY_MARGIN_S = 6.0
"""Older frames are prefilled before the newest is captured, with a slow model seconds before."""
CAMERA_LEAD = 0.5
"""Share of a tick period by which a frame is asked for before the tick that uses it."""
READY_TIMEOUT_S = 10.0
OPEN_S = 60.0
"""As a service: the most that hashing, opening and warming up a large model's graphs takes."""
STOP_CONFIRM_S = 1.0
JOIN_S = 5.0
"""How long a thread may take to end; a call of a graph is interrupted."""
LINES = 200
"""Lines for the operator that wait to be printed; more are dropped, oldest first."""


@dataclass(frozen=True)
class RunOptions:
    """What a run was asked for."""

    instruction: str
    mode: Mode
    duration_s: float | None
    release_delay: ReleaseDelay
    record: Path | None


class RunSession:
    """One run of `edge-run` against one robot."""

    def __init__(
        self, artifacts: Artifacts, robot: RobotConfig, options: RunOptions, say: Callable[[str], None]
    ) -> None:
        """Open the graphs and warm them up. Raises ArtifactError, or InstructionError when the prompt is too long."""
        runtime = artifacts.runtime
        self._artifacts = artifacts
        self._robot = robot
        self._options = options
        self._print = say
        # Threads leave their lines here, the main thread prints them: a terminal that blocks holds up nobody else.
        self._lines: deque[str] = deque(maxlen=LINES)
        self._period_ns = runtime.tick_period_ms * 1_000_000
        self._schedule = schedule_for(artifacts)
        self._lines.extend(self._schedule.notes)
        self._activity = TickActivity(self._period_ns)
        self._notifier = Notifier(os.environ)
        self._notifier.status("opening the graphs")
        self._notifier.extend(OPEN_S)
        if artifacts.guided_by_waypoints and options.mode is Mode.NO_REASONING:
            raise InstructionError(
                f"--mode {Mode.NO_REASONING.value}: {artifacts.directory} is guided by the waypoints that reasoning "
                f"writes; run it with {Mode.ASYNC.value} or {Mode.SYNC.value}"
            )
        self._policy = Policy(artifacts, schedule=self._schedule, activity=self._activity)
        self._language = LanguageModel(artifacts, schedule=self._schedule)
        self._language.check_instruction(options.instruction, len(runtime.frame_offsets_s))
        try:
            warm_up(self._policy, self._language, runtime.image_px, len(runtime.frame_offsets_s))
        except (GraphError, ContextOverflowError) as error:
            raise ArtifactError(f"{artifacts.directory}: the graphs do not run ({error})") from error
        self._stop = threading.Event()
        self._stop_requested = False
        self._faults: list[str] = []

    def request_stop(self) -> None:
        """Ask for a clean end. Safe in a signal handler: it takes no lock, the main thread looks at it regularly."""
        self._stop_requested = True

    def run(self) -> dict[str, Any]:
        """Arm, drive, stop; returns the result.

        Raises RefusedError, ArtifactError, BridgeUnavailable, DdsError, CalibrationError or StoppedEarlyError before
        the robot has moved.
        """
        refusal = None if self._options.record is None else space_refusal(self._options.record)
        if refusal is not None:
            raise RefusedError(refusal)
        self._notifier.status("waiting for the robot")
        self._notifier.extend(READY_TIMEOUT_S + self._robot.bridge.arm_timeout_s + OPEN_S)
        bridge = BridgeClient(self._robot.bridge.socket)
        inputs: RobotInputs | None = None
        recorder: Recorder | None = None
        power: PowerMonitor | None = None
        result: dict[str, Any] | None = None
        try:
            sink = CommandTap(bridge)
            inputs = RobotInputs(
                self._robot,
                image_px=self._artifacts.runtime.image_px,
                period_ns=self._period_ns,
                commanded=lambda: sink.commanded,
                say=self._lines.append,
            )
            inputs.camera.start()
            self._await_inputs(inputs)
            if self._options.record is not None:
                recorder = Recorder(self._options.record)
                if recorder.error is not None:
                    raise RefusedError(recorder.error)
            power, control, reasoning, reporter = self._loops(inputs, sink, recorder)
            power.start()
            # After everything that lives as long as the process has been made.
            refused = lock_memory()
            if refused is not None:
                self._lines.append(refused)
            freeze_garbage()
            control.last_seq = self._arm(bridge, reporter)
            self._print(f"armed and driving {self._robot.name}: {self._options.instruction}")
            started_ns = time.monotonic_ns()
            process = psutil.Process()
            process.cpu_percent()
            if recorder is not None:
                recorder.put("/run", started_ns, self._run_record(started_ns))
                inputs.recorder = recorder
            self._drive(control, reasoning, inputs, bridge)
            status = self._halt(bridge)
            result = run_result(
                control,
                reasoning,
                inputs,
                status,
                power_w=power.statistics(),
                faults=list(self._faults),
                duration_s=(time.monotonic_ns() - started_ns) / 1e9,
            )
            result["cpu_percent"] = process.cpu_percent()
            if recorder is not None:
                recorder.put("/result", time.monotonic_ns(), result)
        finally:
            # Whatever ended the run: closing the connection makes the bridge stop the robot.
            bridge.close()
            if power is not None:
                power.close()
            if inputs is not None:
                inputs.close()
            if recorder is not None:
                self._close_recorder(recorder, result)
            self._print_lines()
        return result

    def _loops(
        self, inputs: RobotInputs, sink: CommandTap, recorder: Recorder | None
    ) -> tuple[PowerMonitor, ControlLoop, ReasoningLoop, ServiceReporter]:
        runtime, options = self._artifacts.runtime, self._options
        seconds = max(runtime.frame_offsets_s) + HISTORY_MARGIN_S
        slot = SemanticSlot()
        ring = TokenRing(math.ceil(seconds * 1e9 / self._period_ns), self._policy.tokens_shape)
        # The monitor asks the loops what they do, the loops ask the monitor what they may: each by the time it runs.
        loops: list[tuple[ControlLoop, ReasoningLoop]] = []
        reporter = self._reporter(loops)

        def activity() -> Activity:
            control, reasoning = loops[0]
            return Activity(
                ticks=control.statistics.ticks,
                reasoning=reasoning.busy,
                generations=reasoning.generations,
                reasoning_s=reasoning.busy_ns / 1e9,
            )

        power = make_power_monitor(
            self._artifacts,
            activity=activity,
            battery=inputs.battery,
            on_sample=lambda stamp_ns, record: None if recorder is None else recorder.put("/power", stamp_ns, record),
            on_findings=inputs.findings.put,
            say=self._lines.append,
        )
        reasoning = ReasoningLoop(
            language=self._language,
            policy=self._policy,
            ring=ring,
            slot=slot,
            instruction=options.instruction,
            frame_offsets_s=runtime.frame_offsets_s,
            max_new_tokens=runtime.max_new_tokens,
            release_delay_s=options.release_delay.sampler(),
            recorder=recorder,
            stop=self._stop,
            mode=options.mode,
            budget=power.budget,
            give_way=GiveWay(self._activity) if self._schedule.shared else None,
            role=self._schedule.reasoning,
            say=self._lines.append,
        )
        config = ControllerConfig(
            limits=self._robot.limits,
            step_s=runtime.step_s,
            frame_max_age_ms=FRAME_MAX_AGE_MS,
            odometry_max_age_ms=float(self._robot.odometry.max_age_ms),
        )
        # What an untrained model writes is not in the agreed form, and is no fault of the robot's.
        semantic = SemanticConfig(judge_text=self._artifacts.trained and options.mode is not Mode.NO_REASONING)
        control = ControlLoop(
            policy=self._policy,
            controller=Controller(config),
            newest_frame=lambda: inputs.camera.newest,
            history=inputs.history,
            ring=ring,
            slot=slot,
            sink=sink,
            recorder=recorder,
            period_ns=self._period_ns,
            step_s=runtime.step_s,
            stop=self._stop,
            watch=Watch(
                WatchConfig.standard(
                    config,
                    self._period_ns,
                    image_px=runtime.image_px,
                    camera_hz=self._robot.camera.rate_hz,
                    semantic=semantic,
                ),
                Sources(
                    findings=inputs.findings,
                    attitude=inputs.reader.state,
                    states=lambda: inputs.states,
                    malformed=lambda: inputs.reader.malformed,
                    failed_generations=lambda: reasoning.failed,
                ),
            ),
            supervisor=Supervisor(),
            on_tick=reporter.on_tick,
            offset_covariance=inputs.offset_covariance,
        )
        loops.append((control, reasoning))
        return power, control, reasoning, reporter

    def _reporter(self, loops: list[tuple[ControlLoop, ReasoningLoop]]) -> ServiceReporter:
        def describe() -> str:
            control, reasoning = loops[0]
            supervision = control.supervision
            faults = f" ({', '.join(supervision.active)})" if supervision.active else ""
            return f"{supervision.state.value}{faults}, {reasoning.generations} generations"

        return ServiceReporter(self._notifier, tick_period_ns=self._period_ns, describe=describe)

    def _await_inputs(self, inputs: RobotInputs) -> None:
        deadline_ns = time.monotonic_ns() + round(READY_TIMEOUT_S * 1e9)
        while not inputs.ready:
            if self._stop_requested:
                raise StoppedEarlyError("stopped before the robot was armed")
            if time.monotonic_ns() > deadline_ns:
                missing = "state" if inputs.history.newest() is None else "camera frame"
                why = f" ({inputs.camera.last_error})" if inputs.camera.last_error else ""
                where = f"DDS domain {self._robot.dds.domain} on {self._robot.dds.interface}"
                raise RefusedError(f"no {missing} from the robot in {READY_TIMEOUT_S:.0f} s on {where}{why}: is it on?")
            time.sleep(POLL_S)

    def _arm(self, bridge: BridgeClient, reporter: ServiceReporter) -> int:
        """Arm, after an operator where the robot file wants one; returns the last sequence number used."""

        def on_wait(text: str) -> None:
            reporter.on_wait(text)
            self._print_lines()

        return arm(
            bridge,
            limit_s=self._robot.bridge.arm_timeout_s + 2.0,
            stop_requested=lambda: self._stop_requested,
            say=self._print,
            on_wait=on_wait,
        )

    def _drive(self, control: ControlLoop, reasoning: ReasoningLoop, inputs: RobotInputs, bridge: BridgeClient) -> None:
        """Run both threads until the end; this thread only waits, and prints what the others have to say."""
        # The bridge's deadman is already running: the first command must not wait for a whole period.
        epoch_ns = time.monotonic_ns() + self._period_ns // 2
        inputs.camera.align(epoch_ns - round(CAMERA_LEAD * self._period_ns))
        duration_s = self._options.duration_s
        end_ns = None if duration_s is None else epoch_ns + round(duration_s * 1e9)
        finished = threading.Event()

        def guard(name: str, body: Callable[[], None]) -> Callable[[], None]:
            def target() -> None:
                try:
                    body()
                except BridgeUnavailable as error:
                    self._faults.append(f"bridge lost: {error}")
                except Exception as error:  # noqa: BLE001 - a dead thread must end the run, whatever killed it
                    self._faults.append(f"{name} thread died: {type(error).__name__}: {error}")
                finally:
                    finished.set()

            return target

        def drive() -> None:
            try:
                self._lines.extend(enter(self._schedule.control))
                ended = control.run(epoch_ns, end_ns)
                if ended is not None:
                    self._faults.append(f"the {control.ended_by} ended the run: {ended}")
            finally:
                # At once, not after the reasoning thread has been waited for.
                bridge.stop()
                self._notifier.stopping(self._faults[0] if self._faults else "the run has ended")

        # Daemons: a thread that hangs in a driver must not keep the process from ending.
        threads = [
            threading.Thread(target=guard("control", drive), name="control", daemon=True),
            threading.Thread(target=guard("reasoning", reasoning.run), name="reasoning", daemon=True),
        ]
        for thread in threads:
            thread.start()
        says = ""
        while not finished.wait(POLL_S):
            if self._stop_requested:
                self._stop.set()
            if control.supervision.says != says:
                says = control.supervision.says
                self._print(says or "all faults have cleared")
            self._print_lines()
        self._stop.set()
        reasoning.cancel()
        for thread in threads:
            thread.join(JOIN_S)
            if thread.is_alive():
                self._faults.append(f"the {thread.name} thread did not end within {JOIN_S:g} s")

    def _halt(self, bridge: BridgeClient) -> BridgeStatus | None:
        """Wait until the bridge has put zero on the wire (it does so in any case, within its deadman)."""
        status: BridgeStatus | None = None
        try:
            deadline_ns = time.monotonic_ns() + round(STOP_CONFIRM_S * 1e9)
            while time.monotonic_ns() < deadline_ns:
                status = bridge.poll()
                if status is not None and status.state == "stopped" and status.zero_after_stop:
                    return status
                time.sleep(0.01)
            self._faults.append(f"the bridge did not confirm zero velocity within {STOP_CONFIRM_S:g} s")
        except BridgeUnavailable as error:
            if not self._faults:
                self._faults.append(f"bridge lost: {error}")
        return status

    def _close_recorder(self, recorder: Recorder, result: dict[str, Any] | None) -> None:
        recorder.close()
        if result is None:
            recorder.path.unlink(missing_ok=True)  # the run never began: an empty log would only mislead
            return
        dropped = sum(recorder.dropped.values())
        result["recorder"] = recorder.statistics()
        if recorder.error is not None:
            self._print(f"the flight log is incomplete: {recorder.error}")
        elif dropped:
            self._print(f"the flight log lacks {dropped} records: writing was slower than the run")

    def _run_record(self, started_ns: int) -> dict[str, Any]:
        delay = self._options.release_delay
        return {
            "instruction": self._options.instruction,
            "mode": self._options.mode.value,
            "artifacts": str(self._artifacts.directory),
            "manifest_sha256": self._artifacts.manifest_sha256,
            "robot": self._robot.name,
            "release": self._artifacts.release,
            "limits": asdict(self._robot.limits),
            "release_delay": {"mean_s": delay.mean_s, "sd_s": delay.sd_s, "seed": delay.seed},
            "started_ns": started_ns,
            "tick_period_ms": self._artifacts.runtime.tick_period_ms,
        }

    def _print_lines(self) -> None:
        while self._lines:
            self._print(self._lines.popleft())


def warm_up(policy: Policy, language: LanguageModel, image_px: int, frame_count: int) -> None:
    """Run every graph once or more, so that no tick pays for first-time allocation."""
    here = SE2(0.0, 0.0, 0.0)
    frame = np.zeros((1, image_px, image_px, 3), dtype=np.uint8)
    frames = [EncodedFrame(i, here, policy.encode(frame)) for i in range(frame_count)]
    generation = language.generate(language.prompt.build(frames, "stop"), max_new_tokens=4, cancelled=lambda: False)
    context = policy.semantic_context(generation.last_layer_kv)
    semantic = SemanticState(0, 0, here, 0, generation.last_layer_kv, context, "", STRAIGHT_AHEAD)
    for _ in range(5):
        policy.act(policy.encode(frame), (0.0, 0.0, 0.0), 0.0, here, semantic)
