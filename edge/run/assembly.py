"""The parts of a run: both loops, power and the checks before arming, wired to one robot's inputs."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from edge.artifacts.manifest import Artifacts
from edge.flightlog.recorder import RecordSink
from edge.inference.generation_task import GenerationModels
from edge.inference.language import LanguageModel
from edge.inference.policy import Policy
from edge.inference.release import ReleaseDelay
from edge.inference.scheduling import GiveWay, Schedule, TickActivity
from edge.live.options import LiveOptions
from edge.motion.controller import Controller, ControllerConfig
from edge.power.governor.plan import read_power_plan
from edge.power.monitor import Activity, PowerMonitor
from edge.power.run_power import make_power_monitor
from edge.reasoning.generation_cycle import Mode, ReasoningConfig
from edge.robot.inputs import CommandTap, RobotInputs
from edge.run.control_loop import CommandChain, ControlConfig, ControlLoop, ControlOutputs, ControlSources
from edge.run.reasoning_loop import ReasoningLoop, ReasoningOutputs, ReasoningSchedule
from edge.safety.monitors.semantic import SemanticConfig
from edge.safety.monitors.watch import Sources, Watch, WatchConfig
from edge.safety.pre_arm import PreArm
from edge.safety.supervisor import Supervisor
from edge.state.ring import TokenRing
from edge.state.semantic import SemanticSlot, SharedState
from edge.state.switches import Switches, SwitchOptions
from firmware_bridge.core.config import ConfigError, RobotConfig

FRAME_MAX_AGE_MS = 500.0
"""Fault matrix row 1: zero velocity 500 ms after the camera's last good frame."""
HISTORY_MARGIN_S = 6.0
"""Older frames are prefilled before the newest is captured, with a slow model seconds before."""


@dataclass(frozen=True)
class RunOptions:
    """The options of a run."""

    instruction: str
    mode: Mode
    duration_s: float | None
    release_delay: ReleaseDelay
    record: Path | None
    instructions: Path | None = None
    """Socket that takes further instructions while the robot drives."""
    live: LiveOptions | None = None
    """Where the live view listens; None: there is none."""
    switches: SwitchOptions = field(default_factory=SwitchOptions)
    """Decoding rules and recoveries of the command line."""

    def switches_for(self, artifacts: Artifacts) -> Switches:
        """Return what is in force with these artifacts; the robot stands at the goal by default. Raises ConfigError."""
        try:
            return self.switches.over(artifacts.runtime.switches, stand_at_goal=True)
        except ValueError as error:
            raise ConfigError(f"{artifacts.directory}: {error}") from error


@dataclass(frozen=True)
class Engines:
    """The model's graphs, opened and warmed up."""

    artifacts: Artifacts
    policy: Policy
    language: LanguageModel
    schedule: Schedule
    activity: TickActivity


@dataclass(frozen=True)
class StopEvents:
    """Request to both loops to end; one event each, so that control never waits for a lock that reasoning has."""

    control: threading.Event = field(default_factory=threading.Event)
    reasoning: threading.Event = field(default_factory=threading.Event)

    def set(self) -> None:
        """Request the end of both loops; any thread may call it."""
        self.control.set()
        self.reasoning.set()


@dataclass(frozen=True)
class Loops:
    """The threads and monitors of a run, not started yet."""

    power: PowerMonitor
    control: ControlLoop
    reasoning: ReasoningLoop
    pre_arm: PreArm


def assemble(
    engines: Engines,
    robot: RobotConfig,
    options: RunOptions,
    inputs: RobotInputs,
    sink: CommandTap,
    recorder: RecordSink | None,
    *,
    stop: StopEvents,
    say: Callable[[str], None],
    on_tick: Callable[[bool], None],
) -> Loops:
    """Everything for one run; raises ArtifactError when the manifest's plan is not whole."""
    artifacts, runtime = engines.artifacts, engines.artifacts.runtime
    period_ns = runtime.tick_period_ms * 1_000_000
    seconds = max(runtime.frame_offsets_s) + HISTORY_MARGIN_S
    switches = options.switches_for(artifacts)
    shared = SharedState(TokenRing(math.ceil(seconds * 1e9 / period_ns), engines.policy.tokens_shape), SemanticSlot())
    # The monitor reads the loops' activity, and the loops read the monitor's budget: both exist before either runs.
    loops: list[tuple[ControlLoop, ReasoningLoop]] = []

    def activity() -> Activity:
        control, reasoning = loops[0]
        cycle = reasoning.cycle
        return Activity(
            ticks=control.statistics.ticks,
            reasoning=reasoning.busy,
            generations=cycle.published,
            reasoning_s=reasoning.busy_ns / 1e9,
            abandoned=cycle.cancelled + cycle.failed + cycle.missed_frames,
        )

    power = make_power_monitor(
        artifacts,
        activity=activity,
        battery=inputs.battery,
        on_sample=lambda stamp_ns, record: None if recorder is None else recorder.put("/power", stamp_ns, record),
        on_findings=inputs.findings.put,
        say=say,
    )
    reasoning = ReasoningLoop(
        GenerationModels(engines.language, engines.policy),
        shared,
        ReasoningConfig(
            runtime.frame_offsets_s, runtime.max_new_tokens, options.mode, switches.decoding, switches.turns_as_told
        ),
        options.instruction,
        stop=stop.reasoning,
        schedule=ReasoningSchedule(
            release_delay_s=options.release_delay.sampler(),
            budget=power.budget,
            give_way=GiveWay(engines.activity) if engines.schedule.shared else None,
            role=engines.schedule.reasoning,
        ),
        outputs=ReasoningOutputs(recorder, say),
    )
    config = ControllerConfig(
        limits=robot.limits,
        step_s=runtime.step_s,
        frame_max_age_ms=FRAME_MAX_AGE_MS,
        odometry_max_age_ms=float(robot.odometry.max_age_ms),
    )
    semantic = semantic_config(artifacts, options.mode)
    watch = WatchConfig.standard(
        config,
        period_ns,
        image_px=runtime.image_px,
        camera_hz=robot.camera.rate_hz,
        hfov_deg=None if robot.mount is None else robot.mount.hfov_deg,
        semantic=semantic,
    )
    sources = Sources(
        findings=inputs.findings,
        attitude=inputs.reader.state,
        states=lambda: inputs.states,
        malformed=lambda: inputs.reader.malformed,
        failed_generations=lambda: reasoning.cycle.failed,
        invalid_texts=lambda: reasoning.cycle.invalid_in_a_row,
    )
    control = ControlLoop(
        engines.policy,
        ControlConfig(period_ns, runtime.step_s, semantic.trained_delay_s, switches),
        ControlSources(lambda: inputs.camera.newest, inputs.history, inputs.offset_covariance),
        shared,
        CommandChain(Controller(config), Watch(watch, sources), Supervisor()),
        ControlOutputs(sink, recorder, on_tick),
        stop=stop.control,
    )
    loops.append((control, reasoning))
    pre_arm = PreArm(
        Watch(watch, sources),
        picture=lambda: inputs.camera.newest,
        pose=inputs.history.newest,
        clock=time.monotonic_ns,
    )
    return Loops(power, control, reasoning, pre_arm)


def semantic_config(artifacts: Artifacts, mode: Mode) -> SemanticConfig:
    """Return how old a semantic state may be, from the policy's training; raises ArtifactError."""
    # An untrained model writes text that does not follow the grammar; that is no fault of the robot.
    judge_text = artifacts.trained and mode is not Mode.NO_REASONING
    trained_s = read_power_plan(artifacts).max_delay_s
    if not math.isfinite(trained_s):
        return SemanticConfig(judge_text=judge_text)
    return SemanticConfig(trained_delay_s=trained_s, judge_text=judge_text)
