"""Runs all monitors in the order of a tick, with sources for the inputs that a tick lacks."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from edge.core.geometry import SE2
from edge.motion.controller import ControllerConfig
from edge.safety.faults.findings import Finding, FindingQueue
from edge.safety.monitors.frame import FrameConfig, FrameMonitor, FrameOutputs
from edge.safety.monitors.machine import MachineMonitor
from edge.safety.monitors.output import OutputConfig, OutputMonitor
from edge.safety.monitors.robot import Attitude, RobotMonitor, RobotWatchConfig
from edge.safety.monitors.scene import SceneConfig
from edge.safety.monitors.semantic import SemanticConfig, SemanticMonitor
from edge.state.frame import Frame
from edge.state.pose_history import StampedPose
from edge.state.semantic import SemanticState


def asleep_ns() -> int:
    """Return the time that this machine has slept since boot, ns: boot time less monotonic time.

    Boot time is read first: a delay between the two readings gives less, never more.
    """
    boot_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
    return boot_ns - time.monotonic_ns()


@dataclass(frozen=True)
class Sources:
    """Sources that monitors read in every tick; none may wait or raise. The defaults report nothing."""

    findings: FindingQueue = field(default_factory=FindingQueue)
    """Findings of other threads: odometry, battery, heat."""
    attitude: Callable[[], Attitude | None] = lambda: None
    states: Callable[[], int | None] = lambda: None
    """Number of state messages of the robot so far."""
    malformed: Callable[[], int] = lambda: 0
    """Number of them that were dropped for an impossible value."""
    failed_generations: Callable[[], int] = lambda: 0
    invalid_texts: Callable[[], int] = lambda: 0
    """Number of complete texts in a row, up to the newest, that do not follow the grammar, published or not."""
    asleep_ns: Callable[[], int] = asleep_ns


@dataclass(frozen=True)
class WatchConfig:
    """Limits of all monitors."""

    frame: FrameConfig
    output: OutputConfig
    semantic: SemanticConfig
    robot: RobotWatchConfig
    period_ns: int

    @staticmethod
    def standard(
        controller: ControllerConfig,
        period_ns: int,
        *,
        image_px: int | None = None,
        camera_hz: float | None = None,
        hfov_deg: float | None = None,
        semantic: SemanticConfig | None = None,
    ) -> WatchConfig:
        """Return the fault matrix's values for a robot and a tick.

        `image_px` None: any picture size; `hfov_deg` None: the usual camera.
        """
        tick_hz = 1e9 / period_ns
        scene = SceneConfig() if hfov_deg is None else SceneConfig.for_hfov(hfov_deg)
        stale_ms = min(controller.odometry_max_age_ms, RobotWatchConfig.stale_ms)
        return WatchConfig(
            frame=FrameConfig(image_px, tick_hz if camera_hz is None else min(camera_hz, tick_hz), scene=scene),
            output=OutputConfig(controller.limits, controller.step_s, period_ns / 1e9),
            semantic=semantic or SemanticConfig(),
            robot=RobotWatchConfig(late_ms=min(RobotWatchConfig.late_ms, stale_ms), stale_ms=stale_ms),
            period_ns=period_ns,
        )


class Watch:
    """One of each monitor."""

    def __init__(self, config: WatchConfig, sources: Sources | None = None) -> None:
        self._sources = sources or Sources()
        self._frame = FrameMonitor(config.frame)
        self._output = OutputMonitor(config.output)
        self._semantic = SemanticMonitor(config.semantic)
        self._robot = RobotMonitor(config.robot)
        self._machine = MachineMonitor(config.period_ns)
        self._pictures = FrameOutputs(False, 0, ())

    def begin(self) -> None:
        """Begin driving: discard other threads' findings from the time of arming."""
        self._sources.findings.take()
        self._robot.begin(self._sources.malformed())

    def picture(self, picture: Frame | None, T_odom_base: SE2 | None, now_ns: int) -> bool:
        """Return, before the encoder, whether the newest picture may be used; `tick` returns the findings."""
        self._pictures = self._frame.step(picture, T_odom_base, now_ns)
        return self._pictures.usable

    def urgent(self) -> tuple[Finding, ...]:
        """Return the urgent findings: other threads', a tipped robot, an impossible report."""
        sources = self._sources
        return (*sources.findings.take(), *self._robot.urgent(sources.attitude(), sources.malformed()))

    def standing(self, picture: Frame | None, pose: StampedPose | None, now_ns: int) -> tuple[Finding, ...]:
        """Return the findings before arming: the newest picture, the robot, other threads."""
        self.picture(picture, None if pose is None else pose.T_odom_base, now_ns)
        return (
            *self.urgent(),
            *self._pictures.findings,
            *self._frame.age(None if picture is None else picture.stamp_ns, now_ns),
            *self._robot.step(pose, self._sources.states(), now_ns),
        )

    def tick(
        self,
        trajectory: npt.NDArray[np.float32] | None,
        semantic: SemanticState | None,
        pose: StampedPose | None,
        driven_ns: int | None,
        last_tick_ns: int | None,
        now_ns: int,
    ) -> tuple[Finding, ...]:
        """Return all findings of a tick, after the action expert, the urgent ones included.

        `driven_ns`: capture stamp of the picture in use; `last_tick_ns`: duration of the last tick.
        """
        sources = self._sources
        return (
            *self.urgent(),
            *self._pictures.findings,
            *self._frame.age(driven_ns, now_ns),
            *self._output.step(trajectory, self._pictures.content, now_ns),
            *self._semantic.step(semantic, sources.failed_generations(), now_ns, sources.invalid_texts()),
            *self._robot.step(pose, sources.states(), now_ns),
            *self._machine.step(last_tick_ns, sources.asleep_ns(), now_ns),
        )
