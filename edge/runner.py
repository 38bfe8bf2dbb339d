"""`edge-run`: drives a robot with a control thread that never waits for the reasoning thread beside it."""

from __future__ import annotations

import argparse
import gc
import json
import math
import resource
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import cv2
import numpy as np
import psutil

from edge.camera import CameraPoller
from edge.cli import (
    EXIT_BAD_INPUT,
    EXIT_CHECK_FAILED,
    EXIT_DONE,
    EXIT_INTERRUPTED,
    EXIT_REFUSED,
    write_result,
)
from edge.control_loop import ControlLoop
from edge.controller import Controller, ControllerConfig
from edge.geometry import SE2
from edge.language import LanguageModel
from edge.manifest import ArtifactError, Artifacts, load_artifacts
from edge.odometry import PoseHistory, StampedPose
from edge.policy import Policy
from edge.prompt import InstructionError, check_instruction
from edge.reasoning_loop import ReasoningLoop, SemanticSlot
from edge.recorder import Recorder
from edge.release import ReleaseDelay, ReleaseDelayError, parse_release_delay
from edge.ring import EncodedFrame, TokenRing
from edge.semantic import SemanticState
from edge.stats import percentiles
from firmware_bridge.client import BridgeClient, BridgeStatus, BridgeUnavailable
from firmware_bridge.config import ConfigError, RobotConfig, load_robot_config
from firmware_bridge.unitree.client import Go2Reader, RobotState
from firmware_bridge.unitree.dds import DdsError

EXAMPLES = """examples:
  edge-run --artifacts out/nano --robot go2.toml --instruction "walk to the vending machine"
  edge-run --artifacts out/nano --robot firmware_bridge/robots/go2_sim.toml --duration 60 \\
           --release-delay 2 --record flight.mcap --json - --instruction "go down the corridor"

edge-bridge must be running. Without --duration it drives until SIGINT or SIGTERM; both stop the robot first.
exit codes: 0 done (also after SIGTERM), 1 a fault ended the run, 2 bad arguments or input, 3 refused to drive,
            130 interrupted (SIGINT)
"""

FRAME_MAX_AGE_MS = 500.0
"""Fault matrix row 1: zero velocity 500 ms after the camera's last good frame."""
HISTORY_MARGIN_S = 3.0
CAMERA_LEAD = 0.5
"""Share of a tick period by which a frame is asked for before the tick that uses it."""
READY_TIMEOUT_S = 10.0
STOP_CONFIRM_S = 1.0
ARM_POLL_S = 0.05
SWITCH_INTERVAL_S = 0.0005
"""How long a thread may hold the interpreter while the control thread wants it (CPython's default is 5 ms)."""


class RefusedError(RuntimeError):
    """The robot must not be driven now; one line for the operator."""


@dataclass(frozen=True)
class RunOptions:
    """What a run was asked for."""

    instruction: str
    reasoning: bool
    duration_s: float | None
    release_delay: ReleaseDelay
    record: Path | None


class Runner:
    """Wires the threads of one run together and takes them down again, the robot first."""

    def __init__(
        self, artifacts: Artifacts, robot: RobotConfig, options: RunOptions, say: Callable[[str], None]
    ) -> None:
        self._artifacts = artifacts
        self._say = say
        self._robot = robot
        self._options = options
        self._stop = threading.Event()
        self._faults: list[str] = []
        self._history = PoseHistory()

    def request_stop(self) -> None:
        """Ask for a clean end; safe in a signal handler."""
        self._stop.set()

    def run(self) -> dict[str, Any]:
        """Arm, drive, stop; returns the result. Raises RefusedError, BridgeUnavailable or DdsError before it moves."""
        runtime = self._artifacts.runtime
        period_ns = runtime.tick_period_ms * 1_000_000
        policy, language = Policy(self._artifacts), LanguageModel(self._artifacts)
        warm_up(policy, language, runtime.image_px)
        process = psutil.Process()
        process.cpu_percent()
        bridge = BridgeClient(self._robot.bridge.socket)
        recorder = None
        reader = None
        camera = None
        try:
            reader = Go2Reader(self._robot)
            reader.set_state_listener(self._on_state)
            camera = CameraPoller(
                reader.request_frame,
                image_px=runtime.image_px,
                period_ns=max(period_ns, round(1e9 / self._robot.camera.rate_hz)),
                timeout_s=self._robot.camera.timeout_ms / 1e3,
                latency_ns=round(self._robot.camera.latency_ms * 1e6),
            )
            camera.start()
            self._await_inputs(camera)
            if self._options.record is not None:
                recorder = Recorder(self._options.record)
                if recorder.error is not None:
                    raise RefusedError(f"{self._options.record}: cannot record ({recorder.error})")
            # Everything allocated so far lives as long as the process: the collector need not walk it again.
            gc.collect()
            gc.freeze()
            last_seq = self._arm(bridge)
            self._say(f"armed and driving {self._robot.name}: {self._options.instruction}")
            started_ns = time.monotonic_ns()
            if recorder is not None:
                recorder.put("/run", started_ns, self._run_record(started_ns))
            slot, ring = SemanticSlot(), TokenRing(self._ring_capacity())
            reasoning = ReasoningLoop(
                language=language,
                policy=policy,
                ring=ring,
                slot=slot,
                instruction=self._options.instruction,
                frame_offsets_s=runtime.frame_offsets_s,
                max_new_tokens=runtime.max_new_tokens if self._options.reasoning else 0,
                release_delay_s=self._options.release_delay.sampler(),
                recorder=recorder,
                stop=self._stop,
            )
            control = ControlLoop(
                policy=policy,
                controller=Controller(self._controller_config()),
                newest_frame=lambda: camera.newest,
                history=self._history,
                ring=ring,
                slot=slot,
                sink=bridge,
                recorder=recorder,
                period_ns=period_ns,
                step_s=runtime.step_s,
                first_seq=last_seq,
                stop=self._stop,
            )
            self._drive(control, reasoning, camera, bridge, period_ns)
            status = self._halt(bridge)
            result = self._result(control, reasoning, camera, recorder, status, started_ns)
            result["cpu_percent"] = process.cpu_percent()
            if recorder is not None:
                recorder.put("/result", time.monotonic_ns(), result)
            return result
        finally:
            # Whatever ended the run: closing the connection makes the bridge stop the robot.
            bridge.close()
            if camera is not None:
                camera.close()
            if reader is not None:
                reader.close()
            if recorder is not None:
                recorder.close(5.0)

    def _on_state(self, state: RobotState) -> None:
        x_m, y_m, theta_rad = state.T_odom_base
        pose = SE2(x_m, y_m, theta_rad)
        self._history.put(StampedPose(state.received_ns, pose, state.vx_mps, state.vy_mps, state.wz_radps))

    def _await_inputs(self, camera: CameraPoller) -> None:
        deadline_ns = time.monotonic_ns() + round(READY_TIMEOUT_S * 1e9)
        while camera.newest is None or self._history.newest() is None:
            if self._stop.is_set():
                raise RefusedError("interrupted before the robot was armed")
            if time.monotonic_ns() > deadline_ns:
                missing = "state" if self._history.newest() is None else "camera frame"
                why = f" ({camera.last_error})" if camera.last_error else ""
                where = f"DDS domain {self._robot.dds.domain} on {self._robot.dds.interface}"
                raise RefusedError(f"no {missing} from the robot in {READY_TIMEOUT_S:.0f} s on {where}{why}: is it on?")
            self._stop.wait(ARM_POLL_S)

    def _arm(self, bridge: BridgeClient) -> int:
        """Arm and keep the bridge fed with zeros until it has the robot on its feet; returns the last sequence used."""
        bridge.arm()
        deadline_ns = time.monotonic_ns() + round((self._robot.bridge.arm_timeout_s + 2.0) * 1e9)
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
                raise RefusedError(
                    f"the bridge did not arm in {self._robot.bridge.arm_timeout_s:.0f} s (state {state})"
                )
            if self._stop.wait(ARM_POLL_S):
                raise RefusedError("interrupted while arming")

    def _drive(
        self,
        control: ControlLoop,
        reasoning: ReasoningLoop,
        camera: CameraPoller,
        bridge: BridgeClient,
        period_ns: int,
    ) -> None:
        """Run both threads until the end; this thread only waits."""
        # The bridge's deadman is already running: the first command must not wait for a whole period.
        epoch_ns = time.monotonic_ns() + period_ns // 2
        camera.align(epoch_ns - round(CAMERA_LEAD * period_ns))
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
                stopped_by_bridge = control.run(epoch_ns, end_ns)
                if stopped_by_bridge is not None:
                    self._faults.append(f"the bridge stopped the robot: {stopped_by_bridge}")
            finally:
                # At once, not after the reasoning thread has been waited for.
                bridge.stop()

        threads = [
            threading.Thread(target=guard("control", drive), name="control"),
            threading.Thread(target=guard("reasoning", reasoning.run), name="reasoning"),
        ]
        for thread in threads:
            thread.start()
        while not finished.wait(0.5):
            pass
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
                    break
                time.sleep(0.01)
        except BridgeUnavailable as error:
            if not self._faults:
                self._faults.append(f"bridge lost: {error}")
        return status

    def _controller_config(self) -> ControllerConfig:
        return ControllerConfig(
            limits=self._robot.limits,
            step_s=self._artifacts.runtime.step_s,
            frame_max_age_ms=FRAME_MAX_AGE_MS,
            odometry_max_age_ms=float(self._robot.odometry.max_age_ms),
        )

    def _ring_capacity(self) -> int:
        runtime = self._artifacts.runtime
        return math.ceil((max(runtime.frame_offsets_s) + HISTORY_MARGIN_S) * 1e3 / runtime.tick_period_ms)

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
        recorder: Recorder | None,
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
            "recorder": None if recorder is None else {"dropped": recorder.dropped, "error": recorder.error},
            "faults": list(self._faults),
            "duration_s": (time.monotonic_ns() - started_ns) / 1e9,
            "peak_rss_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
            "tagged": "measured",
        }


def warm_up(policy: Policy, language: LanguageModel, image_px: int) -> None:
    """Run every graph once or more, so that no tick pays for first-time allocation."""
    here = SE2(0.0, 0.0, 0.0)
    frame = np.zeros((1, image_px, image_px, 3), dtype=np.uint8)
    frames = [EncodedFrame(i, here, policy.encode(frame)) for i in range(4)]
    generation = language.generate(language.prompt.build(frames, "stop"), max_new_tokens=4, cancelled=lambda: False)
    keys, values = policy.semantic_context(generation.last_layer_kv)
    semantic = SemanticState(0, 0, here, 0, generation.last_layer_kv, keys, values, "", None)
    for _ in range(5):
        policy.act(policy.encode(frame), (0.0, 0.0, 0.0), 0.0, here, semantic)


def parser() -> argparse.ArgumentParser:
    """Command line of `edge-run`."""
    p = argparse.ArgumentParser(
        "edge-run", description=__doc__, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    p.add_argument("--artifacts", type=Path, required=True, metavar="DIR", help="directory made by edge-export")
    p.add_argument("--robot", type=Path, required=True, metavar="FILE.toml", help="the robot and its limits")
    p.add_argument("--instruction", required=True, metavar="TEXT", help="what the robot is to do, in plain words")
    p.add_argument("--mode", choices=["async", "no-reasoning"], default="async", help="no-reasoning: prefill only")
    p.add_argument("--duration", type=float, metavar="S", help="drive for this long (default: until a signal)")
    p.add_argument(
        "--release-delay",
        default="0",
        metavar="S|PROFILE",
        help="hold each finished generation back, as slower hardware would: seconds, or a JSON profile (default: 0)",
    )
    p.add_argument("--record", type=Path, metavar="FILE.mcap", help="write a flight log")
    p.add_argument("--socket", type=Path, metavar="PATH", help="socket of edge-bridge (default: the robot file's)")
    p.add_argument("--domain", type=int, metavar="N", help="DDS domain (default: the robot file's)")
    p.add_argument("--json", metavar="FILE|-", help="write the result as JSON")
    return p


def _say(line: str) -> None:
    sys.stderr.write(f"edge-run: {line}\n")


def main(argv: list[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    try:
        if args.duration is not None and not (math.isfinite(args.duration) and args.duration > 0):
            raise ConfigError(f"--duration {args.duration}: expected a positive number of seconds")
        robot = load_robot_config(args.robot, socket=args.socket, domain=args.domain)
        options = RunOptions(
            instruction=check_instruction(args.instruction),
            reasoning=args.mode == "async",
            duration_s=args.duration,
            release_delay=parse_release_delay(args.release_delay),
            record=args.record,
        )
    except (ConfigError, InstructionError, ReleaseDelayError) as error:
        _say(str(error))
        return EXIT_BAD_INPUT
    try:
        artifacts = load_artifacts(args.artifacts)
    except ArtifactError as error:
        _say(str(error))
        return EXIT_REFUSED
    if not artifacts.trained:
        _say("the weights of these artifacts are untrained: the robot will move, it will not navigate")
    cv2.setNumThreads(1)
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    runner = Runner(artifacts, robot, options, _say)
    received: list[int] = []

    def on_signal(number: int, _frame: FrameType | None) -> None:
        received.append(number)
        runner.request_stop()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, on_signal)
    try:
        result = runner.run()
        write_result(args.json, result)
    except (RefusedError, BridgeUnavailable, DdsError, ArtifactError) as error:
        _say(str(error))
        return EXIT_INTERRUPTED if signal.SIGINT in received else EXIT_REFUSED
    except OSError as error:
        _say(f"the run ended, but its result could not be written: {error}")
        return EXIT_BAD_INPUT
    for fault in result["faults"]:
        _say(fault)
    if args.json != "-":
        summary = {key: result[key] for key in ("control", "reasoning", "delay_s", "bridge")}
        _say(json.dumps(summary))
    if result["faults"]:
        return EXIT_CHECK_FAILED
    return EXIT_INTERRUPTED if signal.SIGINT in received else EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
