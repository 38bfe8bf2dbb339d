"""The control thread: from the newest frame to a velocity command on absolute deadlines; reasoning never delays it."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from edge.core.stats import Samples
from edge.flightlog.recorder import RecordSink
from edge.inference.graph import GraphError
from edge.inference.policy import Policy
from edge.motion.controller import TARGET_TIME_S, Controller, ControllerInputs, VelocityCommand, is_plan
from edge.motion.recovery import MOVING, Recovery
from edge.motion.turn_on_the_spot import TurnConfig, TurnOnTheSpot
from edge.safety.faults.findings import Finding
from edge.safety.faults.table import FAULT_OF_CAUSE
from edge.safety.late_command import LATE_NS
from edge.safety.monitors.semantic import SemanticConfig
from edge.safety.monitors.watch import Watch, WatchConfig
from edge.safety.supervisor import FaultEvent, State, Supervisor, SupervisorInputs, SupervisorOutputs
from edge.state.frame import Frame
from edge.state.pose_history import PoseHistory, StampedPose
from edge.state.ring import EncodedFrame
from edge.state.semantic import LatencyInput, SemanticState, SharedState, leading_waypoints
from edge.state.switches import Switches
from firmware_bridge.client import BridgeStatus

BRIDGE_SILENCE_NS = 500_000_000
"""Silence of the bridge after which it counts as hung and the run ends, ns; it reports at 10 Hz."""
URGENT_POLL_S = 0.01
"""Period at which the waiting control thread polls for urgent faults, s."""
REASONING = "reasoning"
"""Reason for standing in sync mode while a generation is under way."""

OffsetCovariance = Callable[[int], npt.NDArray[np.float64] | None]
"""3×3 covariance (m², rad²) of the motion since an anchor's stamp in ns; None while it is unavailable."""


class CommandSink(Protocol):
    """Where commands go; `BridgeClient` in production."""

    def send_velocity(self, seq: int, stamp_ns: int, vx_mps: float, vy_mps: float, wz_radps: float) -> bool:
        """Send one command without waiting."""

    def poll(self) -> BridgeStatus | None:
        """Newest status of the bridge."""


@dataclass
class ControlStatistics:
    """Statistics of all ticks; constant size."""

    ticks: int = 0
    missed: int = 0
    tick_ms: Samples = field(default_factory=Samples)
    """From the tick's deadline until its command was sent, lateness of the wake-up included, ms."""
    delay_s: Samples = field(default_factory=Samples)
    delay_error_ms: Samples = field(default_factory=Samples)
    """|Δt measured for the action expert − (instant of its call − anchor)|."""
    unsent: int = 0
    plans: int = 0
    plans_not_finite: int = 0
    """Number of `plans` that cannot drive a robot: see `edge.motion.controller.is_plan`."""
    reasons: dict[str, int] = field(default_factory=dict)
    """Ticks by what decided their velocity: "ok", the reason for zero, or a recovery's (`edge.motion.recovery`)."""
    faults: dict[str, int] = field(default_factory=dict)
    """How often each fault of the table was raised."""


@dataclass(frozen=True)
class ControlConfig:
    """Rates and limits of the control loop itself."""

    period_ns: int
    """Time between two ticks, ns."""
    step_s: float
    """Time between two points of the policy's trajectory, s."""
    trained_delay_s: float = SemanticConfig.trained_delay_s
    """Largest Δt that the policy was trained for, s; a larger one is clamped to it."""
    switches: Switches = field(default_factory=Switches)
    """Which recoveries are in force."""

    def __post_init__(self) -> None:
        if self.period_ns <= 0 or not (0 < self.step_s < math.inf and 0 < self.trained_delay_s < math.inf):
            raise ValueError(
                f"control loop: expected a period, step and trained delay above 0, found {self.period_ns} ns, "
                f"{self.step_s} s and {self.trained_delay_s} s"
            )


@dataclass(frozen=True)
class ControlSources:
    """The robot's inputs to the control loop; no call may wait."""

    newest_frame: Callable[[], Frame | None]
    history: PoseHistory
    offset_covariance: OffsetCovariance = lambda _anchor_ns: None


@dataclass(frozen=True)
class CommandChain:
    """The parts that turn a trajectory into a command or hold the robot."""

    controller: Controller
    watch: Watch
    supervisor: Supervisor

    @classmethod
    def standard(cls, controller: Controller, period_ns: int) -> CommandChain:
        """Return monitors that read nothing but the control loop's own inputs."""
        return cls(controller, Watch(WatchConfig.standard(controller.config, period_ns)), Supervisor())


@dataclass(frozen=True)
class ControlOutputs:
    """Sinks of the commands, log records and ticks."""

    sink: CommandSink
    recorder: RecordSink | None = None
    on_tick: Callable[[bool], None] = lambda _on_time: None
    """Called after every tick with whether it was on time; it must neither wait nor raise."""


class ControlLoop:
    """Frame → shared encoder → ring buffer → semantic state → action expert → supervisor → controller → bridge."""

    def __init__(
        self,
        policy: Policy,
        config: ControlConfig,
        sources: ControlSources,
        shared: SharedState,
        chain: CommandChain,
        outputs: ControlOutputs,
        *,
        stop: threading.Event,
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._policy = policy
        self._config = config
        self._sources = sources
        self._ring, self._slot = shared.ring, shared.slot
        self._controller, self._watch, self._supervisor = chain.controller, chain.watch, chain.supervisor
        self._recovery = Recovery(config.switches, chain.controller.config.limits)
        self._turning = TurnOnTheSpot(TurnConfig(chain.controller.config.limits.wz_max_radps))
        self._sink, self._recorder, self._on_tick = outputs.sink, outputs.recorder, outputs.on_tick
        self.last_seq = 0
        """Sequence number of the last command; arming uses some before the first tick."""
        self._stop = stop
        self._clock = clock
        self._tokens: EncodedFrame | None = None
        self._last_tick_ns: int | None = None
        self._sent_ns: int | None = None
        self._moving = False
        self.supervision = SupervisorOutputs(State.STARTING, 0.0, False, (), (), "")
        """The supervisor's last outputs; any thread may read them."""
        self.ended_by = ""
        """What ended `run` early: "bridge" or "supervisor"; empty otherwise."""
        self.statistics = ControlStatistics()

    def run(self, epoch_ns: int, end_ns: int | None) -> str | None:
        """Tick at `epoch_ns` plus whole periods until `stop` or `end_ns`; deadlines that have passed are skipped.

        Returns why the bridge or the supervisor stopped the robot (`ended_by` says which), else None; raises
        BridgeUnavailable when the connection to the bridge has ended.
        """
        self._watch.begin()
        deadline_ns, period_ns = epoch_ns, self._config.period_ns
        while end_ns is None or deadline_ns < end_ns:
            if self._wait_until(deadline_ns):
                return None
            if not self.supervision.stop:
                self.tick(deadline_ns)
            if self.supervision.stop:
                self.ended_by = "supervisor"
                return self.supervision.message
            status, now_ns = self._sink.poll(), self._clock()
            silent_ns = 0 if status is None else now_ns - status.stamp_ns
            if status is not None and (status.state == "stopped" or silent_ns > BRIDGE_SILENCE_NS):
                return self._ended_by_bridge(status, now_ns)
            behind = (now_ns - deadline_ns) // period_ns
            # Deadlines that passed during a late tick are skipped; each counts as a missed tick.
            self.statistics.missed += max(0, behind)
            self._on_tick(behind <= 0)
            deadline_ns += period_ns * max(1, behind + 1)
        return None

    def _ended_by_bridge(self, status: BridgeStatus, now_ns: int) -> str:
        """Report the fault to the supervisor; returns why the bridge ended the run, for the operator."""
        self.ended_by = "bridge"
        fault, why = "bridge-hung", f"no status from it for {(now_ns - status.stamp_ns) / 1e9:.1f} s"
        if status.state == "stopped":
            fault, why = FAULT_OF_CAUSE.get(status.cause, ""), status.reason
        if fault:
            self._supervise((Finding(fault, why),), now_ns)
        return why

    def tick(self, deadline_ns: int) -> VelocityCommand:
        """Run one tick; returns the command that it sent."""
        start_ns = self._clock()
        # Before each of the two graph calls: after both, the command would be later than the bound of a jump.
        self.poll_urgent_faults()
        encoded = self._encode(self._sources.newest_frame())
        encoded_ns = self._clock()
        self.poll_urgent_faults()
        turn = self._slot.turn  # before the state: during a turn and after it, none from before it counts
        semantic = self._slot.state if turn is None else None
        pose = self._sources.history.newest()
        trajectory: npt.NDArray[np.float32] | None = None
        delay_s: float | None = None
        latency: LatencyInput | None = None
        now_ns = self._clock()
        if semantic is not None and pose is not None and encoded is not None:
            trained_s = self._config.trained_delay_s
            latency, now_ns, called_ns = semantic.latency_input_at_call(self._clock, pose.T_odom_base, trained_s)
            delay_s = semantic.delay_s(now_ns)
            trajectory = self._act(encoded, pose, latency, semantic)
            self.statistics.plans += 1
            self.statistics.plans_not_finite += not is_plan(trajectory)
            error_ms = abs(float(np.float32(delay_s)) * 1e3 - (called_ns - semantic.anchor_ns) / 1e6)
            self.statistics.delay_error_ms.add(error_ms)
            self.statistics.delay_s.add(delay_s)
        acted_ns = self._clock()
        driven_ns = None if encoded is None else encoded.stamp_ns
        found = self._watch.tick(trajectory, semantic, pose, driven_ns, self._last_tick_ns, acted_ns)
        self._supervise(found, acted_ns)
        inputs = ControllerInputs(
            trajectory=trajectory,
            # Age of the encoded frame, which is not the camera's newest when the encoder fails.
            frame_age_ms=None if driven_ns is None else (acted_ns - driven_ns) / 1e6,
            odometry_age_ms=None if pose is None else (acted_ns - pose.stamp_ns) / 1e6,
            speed_scale=self.supervision.speed_scale,
            hold=self._hold(semantic, pose, acted_ns),
        )
        T_odom_base = None if pose is None else pose.T_odom_base
        waypoints = None if latency is None else leading_waypoints(semantic, latency.offset)
        command = self._controller.step(inputs, acted_ns)
        if turn is not None:
            told = self._turning.step(turn, command, T_odom_base, acted_ns, inputs.speed_scale)
            if told is None:
                self._slot.end(turn)
            command = told or command
        command = self._recovery.step(command, waypoints, T_odom_base, acted_ns, inputs.speed_scale)
        if command.reason in MOVING:
            self._controller.halt(command.reason)  # the next command accelerates from standstill
        if self._sent_ns is not None and self._clock() - self._sent_ns >= LATE_NS:
            command = self._controller.halt("tick-overrun")  # zeros have been sent in its place (late_command)
        self._send(command)
        end_ns = self._clock()
        self._last_tick_ns = end_ns - deadline_ns
        statistics = self.statistics
        statistics.ticks += 1
        statistics.tick_ms.add((end_ns - deadline_ns) / 1e6)
        statistics.reasons[command.reason] = statistics.reasons.get(command.reason, 0) + 1
        if self._recorder is not None:
            used = None if delay_s is None else semantic
            record: dict[str, Any] = {
                "tick": statistics.ticks - 1,
                "missed": statistics.missed,
                "now_ns": now_ns,
                "start_ns": start_ns,
                "duration_ms": (end_ns - start_ns) / 1e6,
                "late_ms": (start_ns - deadline_ns) / 1e6,
                "encode_ms": (encoded_ns - start_ns) / 1e6,
                "act_ms": (acted_ns - now_ns) / 1e6,
                "frame_ns": driven_ns,
                "frame_age_ms": inputs.frame_age_ms,
                "generation": None if used is None else used.generation,
                "anchor_ns": None if used is None else used.anchor_ns,
                "delay_s": delay_s,
                "delay_given_s": None if latency is None else latency.delay_s,
                "offset": None if latency is None else latency.offset.as_tuple(),
                "offset_sd": None if used is None else self._offset_sd(used.anchor_ns),
                "pose": None if pose is None else pose.T_odom_base.as_tuple(),
                "state": None if pose is None else pose.velocity,
                "trajectory": self._seconds(trajectory),
                "target": None if command.target is None else command.target.as_tuple(),
                "command": (command.vx_mps, command.vy_mps, command.wz_radps),
                "reason": command.reason,
                "supervisor": self.supervision.state.value,
                "speed_scale": self.supervision.speed_scale,
                "active": self.supervision.active,
            }
            self._recorder.put("/tick", start_ns, record)
        return command

    def poll_urgent_faults(self) -> bool:
        """Act on urgent faults, between and within ticks; returns whether they stopped the robot."""
        findings = self._watch.urgent()
        if not findings:
            return False
        now_ns = self._clock()
        self._supervise(findings, now_ns)
        if self.supervision.speed_scale > 0 or not self._moving:
            return self.supervision.stop
        self._send(self._controller.halt(self.supervision.active[0]))
        return True

    def _wait_until(self, deadline_ns: int) -> bool:
        """Wait; return True when `stop` was set meanwhile, and return early when the supervisor has stopped the run."""
        while True:
            left_s = max(0, deadline_ns - self._clock()) / 1e9
            if self._stop.wait(min(left_s, URGENT_POLL_S)):
                return True
            if left_s <= URGENT_POLL_S:
                return False
            self.poll_urgent_faults()
            if self.supervision.stop:
                return False

    def _supervise(self, findings: tuple[Finding, ...], now_ns: int) -> None:
        self.supervision = self._supervisor.step(SupervisorInputs(findings, armed=True), now_ns)
        for event in self.supervision.events:
            self._report(event)

    def _report(self, event: FaultEvent) -> None:
        fault = event.fault
        if event.raised:
            self.statistics.faults[fault.name] = self.statistics.faults.get(fault.name, 0) + 1
        if self._recorder is not None:
            record = {
                "name": fault.name,
                "row": fault.row,
                "action": fault.action.name,
                "change": "raised" if event.raised else "cleared",
                "detail": event.detail,
                "state": self.supervision.state.value,
                "speed_scale": self.supervision.speed_scale,
            }
            self._recorder.put("/fault", event.stamp_ns, record)

    def _hold(self, semantic: SemanticState | None, pose: StampedPose | None, now_ns: int) -> str | None:
        """Return why the robot must stand whatever the trajectory; None: it may drive."""
        if self.supervision.speed_scale <= 0:
            return self.supervision.active[0] if self.supervision.active else "not-supervised"
        until_ns = self._slot.drive_until_ns
        if until_ns is not None and now_ns >= until_ns:
            return REASONING
        if semantic is None or pose is None:
            return None
        return self._recovery.hold(semantic.T_odom_stop, pose.T_odom_base)

    def _send(self, command: VelocityCommand) -> None:
        self.last_seq += 1
        self._moving = (command.vx_mps, command.vy_mps, command.wz_radps) != (0.0, 0.0, 0.0)
        self._sent_ns = now_ns = self._clock()
        if not self._sink.send_velocity(self.last_seq, now_ns, command.vx_mps, command.vy_mps, command.wz_radps):
            self.statistics.unsent += 1

    def _encode(self, frame: Frame | None) -> EncodedFrame | None:
        """Encode a new, usable frame; for any other frame return the tokens of the last one."""
        # The pose at capture: a robot that starts to turn has moved before the picture shows it.
        T_odom_base = None if frame is None else self._sources.history.at(frame.stamp_ns)
        fit = self._watch.picture(frame, T_odom_base, self._clock())
        if frame is None or not fit or (self._tokens is not None and frame.stamp_ns == self._tokens.stamp_ns):
            return self._tokens
        if T_odom_base is None:
            return self._tokens
        try:
            tokens = self._policy.encode(frame.pixels, self._ring.next_buffer())
        except GraphError:
            return self._tokens
        self._tokens = EncodedFrame(frame.stamp_ns, T_odom_base, tokens)
        self._ring.put(self._tokens)
        if self._recorder is not None:
            self._recorder.put("/camera", frame.stamp_ns, frame.jpeg)
        return self._tokens

    def _act(
        self, encoded: EncodedFrame, pose: StampedPose, latency: LatencyInput, semantic: SemanticState
    ) -> npt.NDArray[np.float32]:
        try:
            return self._policy.act(encoded.tokens, pose.velocity, latency.delay_s, latency.offset, semantic)
        except GraphError:
            # The controller treats a trajectory that is not finite as bad output and stops.
            return np.full((1, 3), np.nan, dtype=np.float32)

    def _offset_sd(self, anchor_ns: int) -> list[float] | None:
        """Return the standard deviations (m, m, rad) of the motion since the anchor, for the log."""
        covariance = self._sources.offset_covariance(anchor_ns)
        return None if covariance is None else [float(v) for v in np.sqrt(np.maximum(np.diag(covariance), 0.0))]

    def _seconds(self, trajectory: npt.NDArray[np.float32] | None) -> list[list[float]] | None:
        """Return the trajectory at whole seconds, as the flight log keeps it."""
        if trajectory is None:
            return None
        every = max(1, round(TARGET_TIME_S / self._config.step_s))
        return [[float(v) for v in row] for row in trajectory[every - 1 :: every]]
