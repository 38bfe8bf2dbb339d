"""The fast thread: 10 Hz on absolute deadlines, from the newest frame to a velocity command; it waits for nobody."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

from edge.camera import Frame
from edge.controller import TARGET_TIME_S, Controller, ControllerInputs, VelocityCommand
from edge.geometry import SE2
from edge.graph import GraphError
from edge.policy import Policy
from edge.pose_history import PoseHistory, StampedPose
from edge.reasoning_loop import SemanticSlot
from edge.recorder import Recorder
from edge.ring import EncodedFrame, TokenRing
from edge.semantic import SemanticState
from firmware_bridge.client import BridgeStatus

BRIDGE_SILENCE_NS = 500_000_000
"""The bridge reports at 10 Hz; when it has hung there is no point in commanding on."""


class CommandSink(Protocol):
    """Where commands go; `BridgeClient` in production."""

    def send_velocity(self, seq: int, stamp_ns: int, vx_mps: float, vy_mps: float, wz_radps: float) -> bool:
        """Send one command without waiting."""

    def poll(self) -> BridgeStatus | None:
        """Newest status of the bridge."""


@dataclass
class ControlStatistics:
    """Samples of every tick."""

    ticks: int = 0
    missed: int = 0
    tick_ms: list[float] = field(default_factory=list)
    """From the tick's deadline to its command sent: lateness of the wake-up included."""
    delay_s: list[float] = field(default_factory=list)
    delay_error_ms: list[float] = field(default_factory=list)
    """|Δt given to the action expert − (instant of its call − anchor)|."""
    unsent: int = 0
    reasons: dict[str, int] = field(default_factory=dict)


class ControlLoop:
    """Frame → shared encoder → ring buffer → semantic state → action expert → controller → bridge."""

    def __init__(
        self,
        *,
        policy: Policy,
        controller: Controller,
        newest_frame: Callable[[], Frame | None],
        history: PoseHistory,
        ring: TokenRing,
        slot: SemanticSlot,
        sink: CommandSink,
        recorder: Recorder | None,
        period_ns: int,
        step_s: float,
        stop: threading.Event,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._policy = policy
        self._controller = controller
        self._newest_frame = newest_frame
        self._history = history
        self._ring = ring
        self._slot = slot
        self._sink = sink
        self._recorder = recorder
        self._period_ns = period_ns
        self._step_s = step_s
        self.last_seq = 0
        """Sequence number of the last command; arming has used some before the first tick."""
        self._stop = stop
        self._clock = clock
        self._tokens: EncodedFrame | None = None
        self.statistics = ControlStatistics()

    def run(self, epoch_ns: int, end_ns: int | None) -> str | None:
        """Tick at `epoch_ns` plus whole periods until `stop` or `end_ns`; deadlines that were slept over are skipped.

        Returns why the bridge stopped the robot by itself, else None; raises BridgeUnavailable when it has gone.
        """
        deadline_ns = epoch_ns
        while end_ns is None or deadline_ns < end_ns:
            if self._stop.wait(max(0, deadline_ns - self._clock()) / 1e9):
                return None
            self.tick(deadline_ns)
            status = self._sink.poll()
            now_ns = self._clock()
            if status is not None and status.state == "stopped":
                return status.reason
            if status is not None and now_ns - status.stamp_ns > BRIDGE_SILENCE_NS:
                return f"no word from it for {(now_ns - status.stamp_ns) / 1e9:.1f} s"
            behind = (now_ns - deadline_ns) // self._period_ns
            # Deadlines that a late tick has slept over are skipped, not made up for: each counts as a missed tick.
            self.statistics.missed += max(0, behind)
            deadline_ns += self._period_ns * max(1, behind + 1)
        return None

    def tick(self, deadline_ns: int) -> VelocityCommand:
        """One pass; returns the command it sent."""
        start_ns = self._clock()
        encoded = self._encode(self._newest_frame())
        encoded_ns = self._clock()
        semantic = self._slot.state
        pose = self._history.newest()
        trajectory: npt.NDArray[np.float32] | None = None
        delay_s: float | None = None
        offset = None
        now_ns = self._clock()
        if semantic is not None and pose is not None and encoded is not None:
            delay_s = semantic.delay_s(now_ns)
            offset = semantic.motion_offset(pose.T_odom_base)
            called_ns = self._clock()
            trajectory = self._act(encoded, pose, delay_s, offset, semantic)
            error_ms = abs(float(np.float32(delay_s)) * 1e3 - (called_ns - semantic.anchor_ns) / 1e6)
            self.statistics.delay_error_ms.append(error_ms)
            self.statistics.delay_s.append(delay_s)
        acted_ns = self._clock()
        inputs = ControllerInputs(
            trajectory=trajectory,
            # Of the frame that was encoded and driven by, which is not the camera's newest when the encoder fails.
            frame_age_ms=None if encoded is None else (acted_ns - encoded.stamp_ns) / 1e6,
            odometry_age_ms=None if pose is None else (acted_ns - pose.stamp_ns) / 1e6,
        )
        command = self._controller.step(inputs, acted_ns)
        self.last_seq += 1
        stamp_ns = self._clock()
        if not self._sink.send_velocity(self.last_seq, stamp_ns, command.vx_mps, command.vy_mps, command.wz_radps):
            self.statistics.unsent += 1
        end_ns = self._clock()
        self.statistics.ticks += 1
        self.statistics.tick_ms.append((end_ns - deadline_ns) / 1e6)
        self.statistics.reasons[command.reason] = self.statistics.reasons.get(command.reason, 0) + 1
        if self._recorder is not None:
            used = None if delay_s is None else semantic
            self._recorder.put(
                "/tick",
                start_ns,
                {
                    "tick": self.statistics.ticks - 1,
                    "now_ns": now_ns,
                    "start_ns": start_ns,
                    "duration_ms": (end_ns - start_ns) / 1e6,
                    "late_ms": (start_ns - deadline_ns) / 1e6,
                    "encode_ms": (encoded_ns - start_ns) / 1e6,
                    "act_ms": (acted_ns - now_ns) / 1e6,
                    "frame_ns": None if encoded is None else encoded.stamp_ns,
                    "frame_age_ms": inputs.frame_age_ms,
                    "generation": None if used is None else used.generation,
                    "anchor_ns": None if used is None else used.anchor_ns,
                    "delay_s": delay_s,
                    "offset": None if offset is None else offset.as_tuple(),
                    "pose": None if pose is None else pose.T_odom_base.as_tuple(),
                    "state": None if pose is None else (pose.vx_mps, pose.vy_mps, pose.wz_radps),
                    "trajectory": self._seconds(trajectory),
                    "target": None if command.target is None else command.target.as_tuple(),
                    "command": (command.vx_mps, command.vy_mps, command.wz_radps),
                    "reason": command.reason,
                },
            )
        return command

    def _encode(self, frame: Frame | None) -> EncodedFrame | None:
        """Encode a frame once: a frame seen before gives the tokens it gave then."""
        if frame is None or (self._tokens is not None and frame.stamp_ns == self._tokens.stamp_ns):
            return self._tokens
        T_odom_base = self._history.at(frame.stamp_ns)
        if T_odom_base is None:
            return self._tokens
        try:
            tokens = self._policy.encode(frame.pixels)
        except GraphError:
            return self._tokens
        self._tokens = EncodedFrame(frame.stamp_ns, T_odom_base, tokens)
        self._ring.put(self._tokens)
        if self._recorder is not None:
            self._recorder.put("/camera", frame.stamp_ns, frame.jpeg)
        return self._tokens

    def _act(
        self, encoded: EncodedFrame, pose: StampedPose, delay_s: float, offset: SE2, semantic: SemanticState
    ) -> npt.NDArray[np.float32]:
        state = (pose.vx_mps, pose.vy_mps, pose.wz_radps)
        try:
            return self._policy.act(encoded.tokens, state, delay_s, offset, semantic)
        except GraphError:
            # No plan at all: the controller takes what is not finite as bad output and stops.
            return np.full((1, 3), np.nan, dtype=np.float32)

    def _seconds(self, trajectory: npt.NDArray[np.float32] | None) -> list[list[float]] | None:
        """The plan at whole seconds, which is what the flight log keeps of it."""
        if trajectory is None:
            return None
        every = max(1, round(TARGET_TIME_S / self._step_s))
        return [[float(v) for v in row] for row in trajectory[every - 1 :: every]]
