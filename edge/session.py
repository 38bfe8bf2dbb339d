"""One run: wires the threads together, arms, drives, and takes everything down again, the robot first."""

from __future__ import annotations

import gc
import math
import resource
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from edge.artifact_files import ArtifactError
from edge.camera import CameraPoller
from edge.control_loop import ControlLoop
from edge.controller import Controller, ControllerConfig
from edge.geometry import SE2
from edge.graph import GraphError
from edge.language import ContextOverflowError, LanguageModel
from edge.manifest import Artifacts
from edge.policy import Policy
from edge.pose_history import PoseHistory, StampedPose
from edge.reasoning_loop import ReasoningLoop, SemanticSlot
from edge.recorder import Recorder
from edge.release import ReleaseDelay
from edge.ring import EncodedFrame, TokenRing
from edge.semantic import SemanticState
from edge.stats import percentiles
from firmware_bridge.client import BridgeClient, BridgeStatus, BridgeUnavailable
from firmware_bridge.config import RobotConfig
from firmware_bridge.unitree.client import Go2Reader, RobotState

FRAME_MAX_AGE_MS = 500.0
"""Fault matrix row 1: zero velocity 500 ms after the camera's last good frame."""
HISTORY_MARGIN_S = 3.0
CAMERA_LEAD = 0.5
"""Share of a tick period by which a frame is asked for before the tick that uses it."""
READY_TIMEOUT_S = 10.0
STOP_CONFIRM_S = 1.0
POLL_S = 0.05


class RefusedError(RuntimeError):
    """The robot must not be driven now; one line for the operator."""


class StoppedEarlyError(RuntimeError):
    """A stop was asked for before the robot had been armed."""


@dataclass(frozen=True)
class RunOptions:
    """What a run was asked for."""

    instruction: str
    reasoning: bool
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
        self._say = say
        self._policy, self._language = Policy(artifacts), LanguageModel(artifacts)
        self._language.check_instruction(options.instruction, len(runtime.frame_offsets_s))
        try:
            warm_up(self._policy, self._language, runtime.image_px, len(runtime.frame_offsets_s))
        except (GraphError, ContextOverflowError) as error:
            raise ArtifactError(f"{artifacts.directory}: the graphs do not run ({error})") from error
        self._period_ns = runtime.tick_period_ms * 1_000_000
        self._history = PoseHistory()
        self._stop = threading.Event()
        self._stop_requested = False
        self._faults: list[str] = []

    def request_stop(self) -> None:
        """Ask for a clean end. Safe in a signal handler: it takes no lock, the main thread looks at it regularly."""
        self._stop_requested = True

    def run(self) -> dict[str, Any]:
        """Arm, drive, stop; returns the result.

        Raises RefusedError, BridgeUnavailable, DdsError or StoppedEarlyError before the robot has moved.
        """
        bridge = BridgeClient(self._robot.bridge.socket)
        reader: Go2Reader | None = None
        camera: CameraPoller | None = None
        recorder: Recorder | None = None
        result: dict[str, Any] | None = None
        try:
            reader = Go2Reader(self._robot)
            reader.set_state_listener(self._on_state)
            camera = self._camera(reader)
            camera.start()
            self._await_inputs(camera)
            if self._options.record is not None:
                recorder = Recorder(self._options.record)
            control, reasoning = self._loops(camera, bridge, recorder)
            # Everything allocated so far lives as long as the process: the collector need not walk it again.
            gc.collect()
            gc.freeze()
            control.last_seq = self._arm(bridge)
            self._say(f"armed and driving {self._robot.name}: {self._options.instruction}")
            started_ns = time.monotonic_ns()
            process = psutil.Process()
            process.cpu_percent()
            if recorder is not None:
                recorder.put("/run", started_ns, self._run_record(started_ns))
            self._drive(control, reasoning, camera, bridge)
            status = self._halt(bridge)
            result = self._result(control, reasoning, camera, status, started_ns)
            result["cpu_percent"] = process.cpu_percent()
            if recorder is not None:
                recorder.put("/result", time.monotonic_ns(), result)
        finally:
            # Whatever ended the run: closing the connection makes the bridge stop the robot.
            bridge.close()
            if camera is not None:
                camera.close()
            if reader is not None:
                reader.close()
            if recorder is not None:
                self._close_recorder(recorder, result)
        return result

    def _camera(self, reader: Go2Reader) -> CameraPoller:
        config = self._robot.camera
        return CameraPoller(
            reader.request_frame,
            image_px=self._artifacts.runtime.image_px,
            period_ns=max(self._period_ns, round(1e9 / config.rate_hz)),
            timeout_s=config.timeout_ms / 1e3,
            latency_ns=round(config.latency_ms * 1e6),
        )

    def _loops(
        self, camera: CameraPoller, bridge: BridgeClient, recorder: Recorder | None
    ) -> tuple[ControlLoop, ReasoningLoop]:
        runtime = self._artifacts.runtime
        seconds = max(runtime.frame_offsets_s) + HISTORY_MARGIN_S
        slot, ring = SemanticSlot(), TokenRing(math.ceil(seconds * 1e3 / runtime.tick_period_ms))
        reasoning = ReasoningLoop(
            language=self._language,
            policy=self._policy,
            ring=ring,
            slot=slot,
            instruction=self._options.instruction,
            frame_offsets_s=runtime.frame_offsets_s,
            max_new_tokens=runtime.max_new_tokens if self._options.reasoning else 0,
            release_delay_s=self._options.release_delay.sampler(),
            recorder=recorder,
            stop=self._stop,
        )
        controller = ControllerConfig(
            limits=self._robot.limits,
            step_s=runtime.step_s,
            frame_max_age_ms=FRAME_MAX_AGE_MS,
            odometry_max_age_ms=float(self._robot.odometry.max_age_ms),
        )
        control = ControlLoop(
            policy=self._policy,
            controller=Controller(controller),
            newest_frame=lambda: camera.newest,
            history=self._history,
            ring=ring,
            slot=slot,
            sink=bridge,
            recorder=recorder,
            period_ns=self._period_ns,
            step_s=runtime.step_s,
            stop=self._stop,
        )
        return control, reasoning

    def _on_state(self, state: RobotState) -> None:
        x_m, y_m, theta_rad = state.T_odom_base
        pose = SE2(x_m, y_m, theta_rad)
        self._history.put(StampedPose(state.received_ns, pose, state.vx_mps, state.vy_mps, state.wz_radps))

    def _await_inputs(self, camera: CameraPoller) -> None:
        deadline_ns = time.monotonic_ns() + round(READY_TIMEOUT_S * 1e9)
        while camera.newest is None or self._history.newest() is None:
            if self._stop_requested:
                raise StoppedEarlyError("stopped before the robot was armed")
            if time.monotonic_ns() > deadline_ns:
                missing = "state" if self._history.newest() is None else "camera frame"
                why = f" ({camera.last_error})" if camera.last_error else ""
                where = f"DDS domain {self._robot.dds.domain} on {self._robot.dds.interface}"
                raise RefusedError(f"no {missing} from the robot in {READY_TIMEOUT_S:.0f} s on {where}{why}: is it on?")
            time.sleep(POLL_S)

    def _arm(self, bridge: BridgeClient) -> int:
        """Arm and keep the bridge fed with zeros until it has the robot on its feet; returns the last sequence used."""
        bridge.arm()
        limit_s = self._robot.bridge.arm_timeout_s + 2.0
        deadline_ns = time.monotonic_ns() + round(limit_s * 1e9)
        seq = 0
        asked = False
        while True:
            seq += 1
            bridge.send_velocity(seq, time.monotonic_ns(), 0.0, 0.0, 0.0)
            status = bridge.poll()
            state = status.state if status is not None else "disarmed"
            asked = asked or state in ("arming", "armed")
            if state == "armed":
                return seq
            if asked and status is not None and state in ("stopped", "disarmed"):
                raise RefusedError(f"the bridge refused to arm: {status.reason}")
            if time.monotonic_ns() > deadline_ns:
                raise RefusedError(f"the bridge did not arm in {limit_s:.0f} s (its state is {state})")
            if self._stop_requested:
                raise StoppedEarlyError("stopped while arming")
            time.sleep(POLL_S)

    def _drive(
        self, control: ControlLoop, reasoning: ReasoningLoop, camera: CameraPoller, bridge: BridgeClient
    ) -> None:
        """Run both threads until the end; this thread only waits."""
        # The bridge's deadman is already running: the first command must not wait for a whole period.
        epoch_ns = time.monotonic_ns() + self._period_ns // 2
        camera.align(epoch_ns - round(CAMERA_LEAD * self._period_ns))
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
                ended_by_bridge = control.run(epoch_ns, end_ns)
                if ended_by_bridge is not None:
                    self._faults.append(f"the bridge ended the run: {ended_by_bridge}")
            finally:
                # At once, not after the reasoning thread has been waited for.
                bridge.stop()

        threads = [
            threading.Thread(target=guard("control", drive), name="control"),
            threading.Thread(target=guard("reasoning", reasoning.run), name="reasoning"),
        ]
        for thread in threads:
            thread.start()
        while not finished.wait(POLL_S):
            if self._stop_requested:
                self._stop.set()
        self._stop.set()
        for thread in threads:
            thread.join()

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
        result["recorder"] = {"dropped": recorder.dropped, "error": recorder.error}
        if recorder.error is not None:
            self._say(f"the flight log is incomplete: {recorder.error}")
        elif dropped:
            self._say(f"the flight log lacks {dropped} records: writing was slower than the run")

    def _run_record(self, started_ns: int) -> dict[str, Any]:
        delay = self._options.release_delay
        return {
            "instruction": self._options.instruction,
            "mode": "async" if self._options.reasoning else "no-reasoning",
            "artifacts": str(self._artifacts.directory),
            "manifest_sha256": self._artifacts.manifest_sha256,
            "robot": self._robot.name,
            "release_delay": {"mean_s": delay.mean_s, "sd_s": delay.sd_s, "seed": delay.seed},
            "started_ns": started_ns,
            "tick_period_ms": self._artifacts.runtime.tick_period_ms,
        }

    def _result(
        self,
        control: ControlLoop,
        reasoning: ReasoningLoop,
        camera: CameraPoller,
        status: BridgeStatus | None,
        started_ns: int,
    ) -> dict[str, Any]:
        ticks = control.statistics
        return {
            "control": {
                "ticks": ticks.ticks,
                "missed": ticks.missed,
                "tick_ms": percentiles(ticks.tick_ms, "p50", "p99", "p999", "max"),
                "unsent": ticks.unsent,
                "reasons": ticks.reasons,
            },
            "reasoning": {
                "generations": reasoning.generations,
                "failed": reasoning.failed,
                "invalid_texts": reasoning.invalid_texts,
                "generation_ms": percentiles(reasoning.generation_ms, "p50", "p99", "max"),
            },
            "delay_s": percentiles(ticks.delay_s, "p50", "p99", "max"),
            "delay_error_ms": percentiles(ticks.delay_error_ms, "max"),
            "camera": {"frames": camera.frames, "failures": camera.failures},
            "power_w": {"mean": None, "p99": None, "source": "none"},
            "bridge": {
                "commands": status.commands if status is not None else None,
                "last_command": list(status.last_command) if status is not None else None,
                "zero_after_stop": status.zero_after_stop if status is not None else False,
            },
            "faults": list(self._faults),
            "duration_s": (time.monotonic_ns() - started_ns) / 1e9,
            "peak_rss_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
            "tagged": "measured",
        }


def warm_up(policy: Policy, language: LanguageModel, image_px: int, frame_count: int) -> None:
    """Run every graph once or more, so that no tick pays for first-time allocation."""
    here = SE2(0.0, 0.0, 0.0)
    frame = np.zeros((1, image_px, image_px, 3), dtype=np.uint8)
    frames = [EncodedFrame(i, here, policy.encode(frame)) for i in range(frame_count)]
    generation = language.generate(language.prompt.build(frames, "stop"), max_new_tokens=4, cancelled=lambda: False)
    context = policy.semantic_context(generation.last_layer_kv)
    semantic = SemanticState(0, 0, here, 0, generation.last_layer_kv, context, "", None)
    for _ in range(5):
        policy.act(policy.encode(frame), (0.0, 0.0, 0.0), 0.0, here, semantic)
