"""A robot before a wall: odometry's checks, supervisor and back-off together, on a fake clock."""

from __future__ import annotations

import pytest

from edge.core.geometry import SE2
from edge.motion.controller import VelocityCommand
from edge.motion.recovery import BackOff, BackOffConfig
from edge.odometry.gate import OdometryGate, OdometryInputs
from edge.safety.faults.findings import Finding
from edge.safety.supervisor import Supervisor, SupervisorInputs

TICK_NS, REPORT_NS = 100_000_000, 20_000_000
WALL_M = 2.0


class Robot:
    """It walks as commanded up to the wall; `frozen`: by its odometry it stands for ever."""

    def __init__(self, plan_mps: float, others: tuple[Finding, ...] = ()) -> None:
        self.plan_mps, self.others = plan_mps, others
        self.gate, self.supervisor = OdometryGate(), Supervisor()
        self.back_off = BackOff(BackOffConfig(vx_min_mps=-0.4, wz_max_radps=1.0))
        self.x_m, self.vx_mps, self.now_ns = 0.0, 0.0, 0
        self.frozen = False
        self.seen: tuple[float, float] = (0.0, 0.0)
        self.found: list[str] = []
        self.stopped = False

    def drive(self, seconds: float) -> None:
        """Ticks until the time is over or the run has ended."""
        for _ in range(round(seconds * 1e9 / TICK_NS)):
            if self.stopped:
                return
            self._tick([finding for _ in range(TICK_NS // REPORT_NS) for finding in self._report()])

    def _report(self) -> tuple[Finding, ...]:
        self.now_ns += REPORT_NS
        vx_mps = 0.0 if self.vx_mps > 0 and self.x_m >= WALL_M else self.vx_mps
        self.x_m += vx_mps * REPORT_NS / 1e9
        self.seen = (self.seen[0], 0.0) if self.frozen else (self.x_m, vx_mps)
        commanded = (self.vx_mps, 0.0, 0.0)
        report = OdometryInputs(self.now_ns, (self.seen[0], 0.0, 0.0), self.seen[1], 0.0, 0.0, commanded=commanded)
        return self.gate.step(report).findings

    def _tick(self, findings: list[Finding]) -> None:
        self.found += [finding.name for finding in findings]
        out = self.supervisor.step(SupervisorInputs((*findings, *self.others), armed=True), self.now_ns)
        self.stopped = out.stop
        speed_mps = self.plan_mps * out.speed_scale
        reason = "ok" if out.speed_scale > 0 else out.active[0]
        wanted = VelocityCommand(speed_mps, 0.0, 0.0, SE2(max(self.plan_mps, 0.1), 0.0, 0.0), reason)
        pose = SE2(self.seen[0], 0.0, 0.0)
        self.vx_mps = self.back_off.step(wanted, pose, self.now_ns, out.speed_scale).vx_mps


@pytest.mark.parametrize("plan_mps", [0.25, 0.5, 0.8])
@pytest.mark.parametrize("others", [(), (Finding("camera-slow"),)], ids=["", "at half speed"])
def test_a_wall_that_stays_ends_the_run_within_two_minutes(plan_mps: float, others: tuple[Finding, ...]) -> None:
    robot = Robot(plan_mps * 2 if others else plan_mps, others)
    robot.drive(130)
    assert robot.stopped and robot.found[-1] == "robot-blocked"
    assert robot.found.count("odometry-frozen") == 1 and robot.found.count("robot-blocked") == 5


@pytest.mark.parametrize("after_s", [0.0, 1.5, 6.0, 9.0])
def test_odometry_that_freezes_ends_the_run_at_the_second_push(after_s: float) -> None:
    """Before a wall, and after any part of its tries."""
    robot = Robot(0.5)
    robot.drive(WALL_M / 0.5 + after_s)
    robot.frozen, pushes = True, len(robot.found)
    robot.drive(30)
    assert robot.stopped and robot.found[-1] == "odometry-stays-frozen"
    assert len(robot.found) - pushes <= 2
