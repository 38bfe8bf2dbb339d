"""An exported model in virtual time: the runner's own control loop, limits and supervisor, on the episode's clock.

The policy receives the world's drifting odometry, so the drift affects every anchor and motion offset.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from edge.artifacts.files import ArtifactError
from edge.artifacts.manifest import Artifacts, load_artifacts
from edge.core.geometry import SE2
from edge.flightlog.recorder import RecordSink
from edge.inference.generation_task import GenerationModels
from edge.inference.language import LanguageModel
from edge.inference.policy import Policy as Model
from edge.inference.start_guard import WARM_UP_S
from edge.inference.warm_up import open_proven
from edge.motion.controller import Controller, ControllerConfig, VelocityCommand
from edge.reasoning.generation_cycle import Mode, ReasoningConfig
from edge.run.assembly import FRAME_MAX_AGE_MS, semantic_config
from edge.run.control_loop import CommandChain, ControlConfig, ControlLoop, ControlOutputs, ControlSources
from edge.safety.monitors.watch import Sources, Watch, WatchConfig
from edge.safety.supervisor import Supervisor
from edge.state.frame import Frame, fit_frame
from edge.state.pose_history import PoseHistory, StampedPose
from edge.state.ring import TokenRing
from edge.state.semantic import SemanticSlot, SemanticState, SharedState
from edge.state.switches import Speculation, Switches, SwitchOptions
from firmware_bridge.client import BridgeStatus
from firmware_bridge.core.config import RobotConfig
from sim_hil.benchmark.conditions.conditions import ConditionsError
from sim_hil.benchmark.conditions.latency import LatencyProfile, LatencySampler
from sim_hil.benchmark.env.observation import CAMERA_ASPECT, Observation
from sim_hil.benchmark.policies.virtual_time_reasoner import VirtualTimeReasoner
from sim_hil.benchmark.suite.episode import Episode
from sim_hil.benchmark.suite.robots import camera_mount

CONTROL_PERIOD_NS = 100_000_000
RING_S = 16.0
"""Length of the frame history, s: the 9 s that a generation looks back, plus the wait for a late anchor."""
_LOG_QUALITY = 75
"""JPEG quality of the pictures in a log."""
START_NS = 1_000_000_000
"""The loop's clock at an episode's start, ns; not zero, because a stamp of zero means "no stamp"."""


class ArtifactsPolicy:
    """Policy that drives episodes with an artifact directory; one thread per graph, so results are reproducible."""

    privileged = False
    needs_image = True

    def __init__(
        self, directory: Path, *, mode: str, latency: LatencyProfile, robot: RobotConfig,
        switches: SwitchOptions | None = None, turns_as_told: bool = True,
    ) -> None:  # fmt: skip
        """Verify, open and prove the graphs within limits of time and memory.

        Raises ArtifactError, or ConditionsError for a mode that they do not support. A graph that hangs ends the
        process with EXIT_REFUSED. `switches`: decoding rules and recoveries; None: the manifest's, without halting at
        the goal. `turns_as_told`: whether control makes the turn that an instruction begins with, unless the recoveries
        are off; otherwise the model reads it.
        """
        self._artifacts = load_artifacts(directory)
        check_suits(self._artifacts, mode)
        self._mode, self._latency, self._robot = Mode(mode), latency, robot
        runtime, asked = self._artifacts.runtime, switches or SwitchOptions()
        self._switches = asked.over(runtime.switches, stand_at_goal=False)
        self._turns_as_told = turns_as_told and self._switches.turns_as_told
        opened = open_proven(self._artifacts, threads=1)
        self._model, self.language = opened.policy, opened.language
        with opened.guard.stage("warming up", WARM_UP_S):
            note = self.language.speculate() if self._switches.speculation is Speculation.ON else None
        rows = max((rows for rows, _ in latency.call_s), default=0)
        most = 1 if self.language.speculator is None else self.language.rows[-1]
        if self._switches.speculation is Speculation.ON and rows > most:
            raise ArtifactError(
                f"{directory}: latency profile {latency.name} has calls of up to {rows} rows, this machine computes at "
                f"most {most} with equal bits ({note}); choose --speculation off"
            )
        self._drive: _Drive | None = None
        self.recorder: RecordSink | None = None
        """Takes the records of the next episode and its pictures."""
        self.name = f"artifacts:{self._artifacts.model_name}"

    @property
    def manifest_sha256(self) -> str:
        """SHA-256 of the manifest, which identifies the artifacts."""
        return self._artifacts.manifest_sha256

    @property
    def camera(self) -> tuple[int, int]:
        """Input image size (width, height), px: the whole field of view, scaled."""
        return (self._artifacts.runtime.image_px,) * 2

    def reset(self, episode: Episode, instruction: str, world: object | None, seed: int) -> None:
        """Begin an episode without frames and semantic state. Raises InstructionError if the prompt is too long."""
        self.language.check_instruction(instruction)
        draw = LatencySampler(self._latency, seed, episode.id, by_calls=True).draw
        if self._latency.call_s and self._switches.speculation is Speculation.ON:
            self._guess_for_the_device()
        self._drive = _Drive(
            self._artifacts, self._model, self.language, self._robot, self._mode, instruction, draw, self._switches,
            self._turns_as_told, self.recorder,
        )  # fmt: skip
        if self.recorder is not None:
            self.recorder.put("/run", START_NS, self._run_record(instruction, episode.robot))

    def _guess_for_the_device(self) -> None:
        """Choose the numbers of guesses by the durations of the profile's device, and begin without earlier texts."""
        call_ns = {rows: time_s * 1e9 for rows, time_s in self._latency.call_s}
        if max(call_ns) > 1:
            self.language.guess_for(call_ns)
        else:
            self.language.speculator = None

    def _run_record(self, instruction: str, robot: str) -> dict[str, Any]:
        own = None if self._robot.mount is None else asdict(self._robot.mount)
        mount = camera_mount(robot) or own
        return {
            "instruction": instruction,
            "mode": self._mode.value,
            **self._switches.as_json(),
            "artifacts": str(self._artifacts.directory),
            "manifest_sha256": self._artifacts.manifest_sha256,
            "robot": robot,
            "release": self._artifacts.release,
            "limits": asdict(self._robot.limits),
            "mount": None if mount is None else {**mount, "aspect": CAMERA_ASPECT},
            "release_delay": {},
            "started_ns": START_NS,
            "tick_period_ms": CONTROL_PERIOD_NS // 1_000_000,
        }

    def act(self, observation: Observation) -> tuple[float, float, float]:
        """Return the command of one control period. Raises ValueError without an image or before `reset`."""
        if self._drive is None or observation.image is None:
            raise ValueError("artifacts: expected reset() first and an image in every observation")
        return self._drive.tick(observation, observation.image)

    def notes(self) -> dict[str, Any]:
        """Return the inputs of the last `act`: delay, text, waypoints, reason for standing still."""
        return {} if self._drive is None else self._drive.notes

    def generations(self) -> list[Mapping[str, Any]]:
        """Return the generations released so far in this episode; times in s from its start."""
        return [] if self._drive is None else self._drive.generations()

    def close(self) -> None:
        """Release the graphs."""
        self._drive = None


class _Drive:
    """One episode."""

    def __init__(
        self, artifacts: Artifacts, model: Model, language: LanguageModel, robot: RobotConfig, mode: Mode,
        instruction: str, draw: Any, switches: Switches, turns_as_told: bool, recorder: RecordSink | None,
    ) -> None:  # fmt: skip
        runtime = artifacts.runtime
        if runtime.tick_period_ms * 1_000_000 != CONTROL_PERIOD_NS:
            raise ArtifactError(
                f"{artifacts.directory}: made for a tick of {runtime.tick_period_ms} ms, the benchmark's is "
                f"{CONTROL_PERIOD_NS // 1_000_000} ms; export with runtime.tick_period_ms = 100"
            )
        self._image_px = runtime.image_px
        self._now_ns = 0
        self._frame: Frame | None = None
        self._history = PoseHistory(512)
        self._slot = SemanticSlot()
        shared = SharedState(TokenRing(round(RING_S * 1e9) // CONTROL_PERIOD_NS, model.tokens_shape), self._slot)
        self._recording = _RecordingPolicy(model, blocking=mode is Mode.SYNC)
        self._reasoner = VirtualTimeReasoner(
            GenerationModels(language, model),
            shared,
            ReasoningConfig(runtime.frame_offsets_s, runtime.max_new_tokens, mode, switches.decoding, turns_as_told),
            instruction,
            draw,
            recorder,
        )
        config = ControllerConfig(
            robot.limits, runtime.step_s, FRAME_MAX_AGE_MS, odometry_max_age_ms=float(robot.odometry.max_age_ms)
        )
        semantic = semantic_config(artifacts, mode)
        watch = WatchConfig.standard(config, CONTROL_PERIOD_NS, image_px=runtime.image_px, semantic=semantic)
        sources = Sources(
            failed_generations=lambda: self._reasoner.cycle.failed,
            invalid_texts=lambda: self._reasoner.cycle.invalid_in_a_row,
            asleep_ns=lambda: 0,
        )
        self._loop = ControlLoop(
            self._recording,  # type: ignore[arg-type]  # the two calls of a tick
            ControlConfig(CONTROL_PERIOD_NS, runtime.step_s, semantic.trained_delay_s, switches),
            ControlSources(lambda: self._frame, self._history),
            shared,
            CommandChain(Controller(config), Watch(watch, sources), Supervisor()),
            ControlOutputs(_NoBridge(), recorder),
            stop=threading.Event(),
            clock=lambda: self._now_ns,
        )
        self._records = recorder is not None
        self.notes: dict[str, Any] = {}

    def tick(self, observation: Observation, image: npt.NDArray[np.uint8]) -> tuple[float, float, float]:
        now_ns = self._now_ns = START_NS + round(observation.time_s * 1e9)
        jpeg = _jpeg(image) if self._records else b""
        self._frame = Frame(now_ns, fit_frame(image, self._image_px), jpeg)
        self._history.put(StampedPose(now_ns, observation.T_odom_base, *observation.state))
        self._reasoner.release(now_ns)
        self._recording.last = None
        command = VelocityCommand(0.0, 0.0, 0.0, None, "stopped")
        if not self._loop.supervision.stop:
            command = self._loop.tick(now_ns)
            self._reasoner.start(now_ns)
        self.notes = self._note(command, now_ns)
        return command.vx_mps, command.vy_mps, command.wz_radps

    def _note(self, command: VelocityCommand, now_ns: int) -> dict[str, Any]:
        latency, semantic, supervision = self._recording.last, self._slot.state, self._loop.supervision
        since_ns = self._reasoner.started_ns
        return {
            "delay_s": None if latency is None else latency[0],
            "offset": None if latency is None else list(latency[1].as_tuple()),
            "generation": None if semantic is None else semantic.generation,
            "text": "" if semantic is None else semantic.text,
            "waypoints": None if semantic is None else semantic.waypoints,
            "thinking_s": None if since_ns is None else (now_ns - since_ns) / 1e9,
            "reason": command.reason,
            "target": None if command.target is None else list(command.target.as_tuple()),
            "speed_scale": supervision.speed_scale,
            "says": supervision.message or self._reasoner.cycle.failure or "",
            "stopped_by": supervision.active[0] if supervision.stop and supervision.active else "",
        }

    def generations(self) -> list[Mapping[str, Any]]:
        keys = ("started_s", "anchor_s", "released_s")
        return [
            {**record, **{key: round(record[key] - START_NS / 1e9, 3) for key in keys}}
            for record in self._reasoner.released
        ]


class _RecordingPolicy:
    """The model as a tick calls it; remembers its last latency input.

    Blocking: the world waits during a generation, so delay and motion offset are zero.
    """

    def __init__(self, model: Model, *, blocking: bool) -> None:
        self._model = model
        self._blocking = blocking
        self.last: tuple[float, SE2] | None = None
        """Delay (s) and motion offset that the action expert received last."""

    def encode(self, frame: npt.NDArray[np.uint8], out: npt.NDArray[np.float32] | None) -> npt.NDArray[np.float32]:
        """Return the visual tokens of a frame."""
        return self._model.encode(frame, out)

    def act(
        self, visual_tokens: npt.NDArray[np.float32], state: tuple[float, float, float], delay_s: float, offset: SE2,
        semantic: SemanticState,
    ) -> npt.NDArray[np.float32]:  # fmt: skip
        """Return the planned trajectory."""
        if self._blocking:
            delay_s, offset = 0.0, SE2(0.0, 0.0, 0.0)
        self.last = delay_s, offset
        return self._model.act(visual_tokens, state, delay_s, offset, semantic)


class _NoBridge:
    """Replacement of the bridge client: commands reach the episode through `act` instead."""

    def send_velocity(self, seq: int, stamp_ns: int, vx_mps: float, vy_mps: float, wz_radps: float) -> bool:
        """Accept the command."""
        return True

    def poll(self) -> BridgeStatus | None:
        """Return None: there is no bridge status."""
        return None


def _jpeg(image: npt.NDArray[np.uint8]) -> bytes:
    """Return a picture, uint8 RGB [height, width, 3], as JPEG for a log; the policy sees the uncompressed one."""
    picture = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    return bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _LOG_QUALITY])[1].tobytes())


def check_suits(artifacts: Artifacts, mode: str) -> None:
    """Raise ConditionsError for a mode that the artifacts do not support."""
    if artifacts.guided_by_waypoints and mode == Mode.NO_REASONING.value:
        raise ConditionsError(
            f"--mode {mode}: {artifacts.directory} is guided by the waypoints that reasoning writes; expected async "
            "or sync"
        )
