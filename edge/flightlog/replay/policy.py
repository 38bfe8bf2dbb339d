"""Runs the policy again on the recorded inputs of a flight log, and measures the deviation of its outputs."""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from edge.artifacts.manifest import Artifacts
from edge.core.geometry import SE2
from edge.flightlog.replay.records import Event, RecordedFrame, RecordedGeneration, RecordedRun, RecordedTick, Rows
from edge.inference.graph import GraphError
from edge.inference.language import ContextOverflowError, LanguageModel
from edge.inference.policy import Policy
from edge.motion.controller import TARGET_TIME_S, Controller, ControllerConfig, ControllerInputs
from edge.motion.recovery import MOVING
from edge.reasoning.path_memory import PastPath, past_path_of
from edge.robot.camera import decode_frame
from edge.state.pose_history import PoseHistory, StampedPose
from edge.state.reasoning_text import parse_waypoints
from edge.state.ring import EncodedFrame
from edge.state.semantic import SemanticState
from firmware_bridge.core.robot_state import CameraError

FRAMES_KEPT_NS = 120_000_000_000
"""Time for which a picture is kept for its generation: 9 s of past, the generation's time, a release delay."""
_ANY_AGE_MS = 1.0
"""Limit that disables the check of ages: the log records the ticks that stood."""

Floats = npt.NDArray[np.float32]
_Result = TypeVar("_Result")


_GENERATIONS_KEPT = 3
"""Number of earlier semantic states kept: a tick that read the old state can follow the new one in the log."""


class _SkippedError(Exception):
    """The log lacks an input of a record; the message is the reason."""


@dataclass
class _ReplayedGeneration:
    """A logged generation and its pictures; its state is computed when a tick first needs it."""

    record: RecordedGeneration
    pictures: dict[int, bytes]
    state: SemanticState | None = None


@dataclass
class Comparison:
    """Counts of replayed outputs, and their deviation from the log."""

    driven: int = 0
    """Number of ticks with a plan, each of which a complete log can replay."""
    ticks: int = 0
    ticks_equal: int = 0
    """Number of plans that are equal bit for bit."""
    generations: int = 0
    texts_equal: int = 0
    different_texts: list[int] = field(default_factory=list)
    """Numbers of the generations whose text differs."""
    poses_interpolated: int = 0
    """Number of generations whose frame poses were interpolated from ticks."""
    ways_from_frames: int = 0
    """Number of generations without a recorded path, which is computed from their frames alone."""
    skipped: Counter[str] = field(default_factory=Counter)
    trajectory_cm: list[float] = field(default_factory=list)
    heading_deg: list[float] = field(default_factory=list)
    command: list[float] = field(default_factory=list)
    """Largest difference of a command's components, in m/s and rad/s."""
    worst_tick: int | None = None
    """The tick with the largest deviation of its plan; None while all are equal."""


class Replayer:
    """Replays a log's events in order; `comparison` covers those within [from_ns, to_ns]."""

    def __init__(
        self,
        artifacts: Artifacts,
        policy: Policy,
        language: LanguageModel,
        run: RecordedRun,
        *,
        from_ns: int,
        to_ns: int,
    ) -> None:
        self._image_px = artifacts.runtime.image_px
        self._step_s = artifacts.runtime.step_s
        self._policy = policy
        self._language = language
        self._run = run
        self._from_ns, self._to_ns = from_ns, to_ns
        self._frames: OrderedDict[int, bytes] = OrderedDict()
        self._encoded: tuple[int, Floats] | None = None
        self._poses = PoseHistory()
        self._generations: OrderedDict[int, _ReplayedGeneration] = OrderedDict()
        self._controller: Controller | None = None
        if run.limits is not None:
            config = ControllerConfig(run.limits, self._step_s, _ANY_AGE_MS, _ANY_AGE_MS)
            self._controller = Controller(config)
        self._command_known = False
        self._worst_cm = 0.0
        self.comparison = Comparison()

    def step(self, event: Event) -> None:
        """Replay one event; count it as skipped when the log lacks an input."""
        if isinstance(event, RecordedFrame):
            self._frames[event.stamp_ns] = event.jpeg
            while next(iter(self._frames)) < event.stamp_ns - FRAMES_KEPT_NS:
                self._frames.popitem(last=False)
        elif isinstance(event, RecordedGeneration):
            pictures = {stamp_ns: self._frames[stamp_ns] for stamp_ns in event.frames_ns if stamp_ns in self._frames}
            replayed = self._generations[event.number] = _ReplayedGeneration(event, pictures)
            while len(self._generations) > _GENERATIONS_KEPT:
                self._generations.popitem(last=False)
            if self._from_ns <= event.ready_ns <= self._to_ns:
                self._counting_skips(lambda: self._generate(replayed))
        else:
            if event.pose is not None:
                self._poses.put(StampedPose(event.now_ns, event.pose, *event.state))
            if self._from_ns <= event.now_ns <= self._to_ns:
                self.comparison.driven += event.rows is not None
                self._compare_command(event, self._counting_skips(lambda: self._act(event)))

    def _counting_skips(self, work: Callable[[], _Result]) -> _Result | None:
        try:
            return work()
        except _SkippedError as reason:
            self.comparison.skipped[str(reason)] += 1
        except (GraphError, ContextOverflowError) as error:
            self.comparison.skipped[f"these artifacts fail on it ({error})"] += 1
        except CameraError:
            self.comparison.skipped["its picture cannot be decoded"] += 1
        return None

    def _generate(self, replayed: _ReplayedGeneration) -> SemanticState:
        """Return the semantic state of a generation; run it and compare its text the first time."""
        if replayed.state is not None:
            return replayed.state
        record, found = replayed.record, self.comparison
        missing = [stamp_ns for stamp_ns in record.frames_ns if stamp_ns not in replayed.pictures]
        if missing:
            raise _SkippedError("a picture of its generation is not in the log")
        frames = [
            EncodedFrame(stamp_ns, pose, self._policy.encode(decode_frame(replayed.pictures[stamp_ns], self._image_px)))
            for stamp_ns, pose in zip(record.frames_ns, self._frame_poses(record), strict=True)
        ]
        generation = self._language.generate(
            self._language.prompt.build(
                frames,
                record.instruction or self._run.instruction,
                self._past_path(record, frames),
                record.context.before,
            ),
            max_new_tokens=record.max_new_tokens,
            cancelled=lambda: False,
            constraint=self._language.constraint(record.context),
        )
        found.generations += 1
        found.poses_interpolated += record.poses is None
        found.ways_from_frames += record.way is None
        if generation.text == record.text:
            found.texts_equal += 1
        else:
            found.different_texts.append(record.number)
        replayed.state = SemanticState(
            generation=record.number,
            anchor_ns=frames[-1].stamp_ns,
            T_odom_anchor=record.anchor_pose,
            ready_ns=record.ready_ns,
            last_layer_kv=generation.last_layer_kv,
            context=self._policy.semantic_context(generation.last_layer_kv),
            text=generation.text,
            waypoints=parse_waypoints(generation.text),
        )
        return replayed.state

    def _past_path(self, record: RecordedGeneration, frames: Sequence[EncodedFrame]) -> PastPath:
        """Return the recorded path; without one, the path through the frames alone."""
        if record.way is not None:
            return record.way
        return past_path_of((frame.stamp_ns, frame.T_odom_base) for frame in frames)

    def _frame_poses(self, record: RecordedGeneration) -> Sequence[SE2]:
        if record.poses is not None:
            return record.poses
        poses = [self._poses.at(stamp_ns) for stamp_ns in record.frames_ns[:-1]]
        return [*(pose or record.anchor_pose for pose in poses), record.anchor_pose]

    def _act(self, tick: RecordedTick) -> Floats | None:
        """Return the whole plan of a tick; None when it had none."""
        if tick.rows is None or tick.generation is None or tick.frame_ns is None:
            return None
        if tick.frame_ns not in self._frames:
            raise _SkippedError("its picture is not in the log")
        if tick.generation not in self._generations:
            raise _SkippedError("its generation is not in the log")
        semantic = self._generate(self._generations[tick.generation])
        if self._encoded is None or self._encoded[0] != tick.frame_ns:
            picture = decode_frame(self._frames[tick.frame_ns], self._image_px)
            self._encoded = tick.frame_ns, self._policy.encode(picture)
        trajectory = self._policy.act(self._encoded[1], tick.state, tick.delay_given_s, tick.offset, semantic)
        every = max(1, round(TARGET_TIME_S / self._step_s))
        rows = trajectory[every - 1 :: every].astype(np.float64)
        if rows.shape != tick.rows.shape:
            raise _SkippedError("its plan has another length")
        self._compare_rows(tick, rows)
        return trajectory

    def _compare_rows(self, tick: RecordedTick, rows: Rows) -> None:
        assert tick.rows is not None
        found = self.comparison
        found.ticks += 1
        # A null in the log means a non-finite number; against a finite one, the deviation is infinite.
        here, there = (np.where(np.isfinite(plan), plan, np.nan) for plan in (rows, tick.rows))
        found.ticks_equal += np.array_equal(here, there, equal_nan=True)
        apart = np.where(np.isnan(here) & np.isnan(there), 0.0, np.nan_to_num(here - there, nan=np.inf))
        distance_cm = float(np.hypot(apart[:, 0], apart[:, 1]).max()) * 100
        turn = np.abs(apart[:, 2])
        finite = np.isfinite(turn)
        turn[finite] = np.abs((turn[finite] + np.pi) % (2 * np.pi) - np.pi)
        if distance_cm > self._worst_cm:
            self._worst_cm, found.worst_tick = distance_cm, tick.number
        found.trajectory_cm.append(distance_cm)
        found.heading_deg.append(float(np.degrees(turn.max())))

    def _compare_command(self, tick: RecordedTick, trajectory: Floats | None) -> None:
        """Replay the controller; its last command is determined from the first tick with forced standstill on."""
        if self._controller is None:
            return
        hold = None if tick.reason == "ok" else tick.reason
        if hold is None and trajectory is None:
            self._command_known = False
            return
        inputs = ControllerInputs(trajectory, 0.0, 0.0, speed_scale=tick.speed_scale, hold=hold)
        command = self._controller.step(inputs, tick.acted_ns)
        self._command_known = self._command_known or hold is not None
        # Backing off and turning follow odometry, not the plan.
        if self._command_known and tick.reason not in MOVING:
            apart = np.subtract((command.vx_mps, command.vy_mps, command.wz_radps), tick.command)
            self.comparison.command.append(float(np.abs(apart).max()))
