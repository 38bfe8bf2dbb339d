"""Checks odometry reports (fault matrix, rows 8 to 12): a wrong one becomes a finding, not motion."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from edge.core.geometry import wrap_angle
from edge.core.stamp_lag import StampLag
from edge.safety.faults.findings import Finding

MAX_AGE_LIMIT_NS = 150_000_000
MAX_AGE_ZERO_NS = 250_000_000
"""Row 11: older than 150 ms limits the speed, older than 250 ms stops."""

MAX_NUMBER = 1e7
"""Largest position, angle or speed of a measurement; larger ones would break arithmetic."""


# Bounds of the checks: the fault matrix's, and speeds above the fastest that any robot file permits (3.8 m/s, 4 rad/s).
MAX_SPEED_MPS = 4.0
MAX_TURN_RADPS = 6.0
JUMP_M = 0.25
"""Tolerance of a report beyond top speed, for the jitter of its arrival."""
JUMP_RAD = 0.35
FROZEN_COMMAND_MPS = 0.2
FROZEN_NS = 500_000_000
FROZEN_M = 0.01
FROZEN_RAD = 0.02
FREED_M = 0.05
AGAIN_NS = 10_000_000_000
BLOCKED_NS = 15_000_000_000
"""A pose that stays again: after less motion than the first, within the second, it stays frozen; after more motion,
within the third, the robot is blocked, and its odometry works. A slow robot takes 13 s to back off and return."""
MISMATCH_MPS = 0.5
MISMATCH_RADPS = 0.5
MISMATCH_WINDOW_NS = 200_000_000
# The robot stands when all reported signals stay below these for STILL_NS.
STILL_NS = 300_000_000
STILL_MPS = 0.05
STILL_RADPS = math.radians(4.0)
STILL_M = 0.01
STILL_HEADING_RAD = 0.005
STILL_HEADING_RADPS = math.radians(0.5)
"""How far the reported heading of a standing robot may be from one that follows it this slowly: its own drift. A robot
that is turned by hand changes it faster, and its turn must not be learned as a gyro bias."""
COMMAND_MPS = 0.02
FOOT_SHARE = 0.2
"""Share of the mean foot force from which a foot carries load."""


@dataclass(frozen=True)
class OdometryInputs:
    """One unchecked report of the robot. `commanded` is the current velocity command (body frame).

    `gyro_wz_radps`, `foot_forces`, `commanded` are None where the protocol does not carry them;
    `robot_stamp_ns` is the robot's clock, 0 without one.
    """

    received_ns: int
    T_odom_base: tuple[float, float, float]
    vx_mps: float
    vy_mps: float
    wz_radps: float
    gyro_wz_radps: float | None = None
    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    robot_stamp_ns: int = 0
    foot_forces: tuple[float, ...] | None = None
    commanded: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class Increment:
    """Reported motion between two accepted reports, in the body frame at its middle."""

    end_ns: int
    dt_s: float
    dx_m: float
    dy_m: float
    odometry_rad: float
    turn_rad: float
    """Turn by the gyro; without one the same as `odometry_rad`."""
    still: bool = False
    """Whether the robot stood, so that the report's last digits are noise."""


@dataclass(frozen=True)
class Verdict:
    """Result of one report: an increment unless it was the first or was rejected."""

    increment: Increment | None
    findings: tuple[Finding, ...]


def age_findings(age_ns: int) -> tuple[Finding, ...]:
    """Return row 11's finding for a pose of this age."""
    if age_ns > MAX_AGE_ZERO_NS:
        return (Finding("odometry-stale", f"{age_ns / 1e6:.0f} ms old, at most 250 ms"),)
    if age_ns > MAX_AGE_LIMIT_NS:
        return (Finding("odometry-late", f"{age_ns / 1e6:.0f} ms old, at most 150 ms"),)
    return ()


class OdometryGate:
    """Checks reports in their order of arrival and converts the accepted ones to increments."""

    def __init__(self) -> None:
        self._last: OdometryInputs | None = None
        self._suspect: OdometryInputs | None = None
        self._apart: deque[tuple[float, float, float, float]] = deque()
        self._apart_sums = [0.0, 0.0, 0.0, 0.0]
        self._pushed_since_ns: int | None = None
        self._pushed_from = (0.0, 0.0, 0.0)
        self._held_ns: int | None = None
        self._held_at = (0.0, 0.0, 0.0)
        self._freed = False
        self._lag = StampLag()
        self.rejected = 0

    def step(self, report: OdometryInputs) -> Verdict:
        """Judge one report."""
        if not _finite(report):
            self.rejected += 1
            return Verdict(None, (Finding("odometry-not-finite", f"pose {report.T_odom_base}"),))
        findings = age_findings(self._lag.of(report.received_ns, report.robot_stamp_ns))
        last = self._last
        if last is None:
            self._last = report
            return Verdict(None, findings)
        dt_s = elapsed_s(last, report)
        if dt_s <= 0 or report.received_ns <= last.received_ns:
            self.rejected += 1
            return Verdict(None, findings)
        jumped = self._jump(last, report, dt_s)
        if jumped and self._suspect is not None:
            suspect_dt_s = elapsed_s(self._suspect, report)
            if suspect_dt_s > 0 and not self._jump(self._suspect, report, suspect_dt_s):
                # The pose stays at its new place: continue from there. The jump is no motion; the reported velocity
                # gives the distance driven meanwhile.
                return self._accept(self._suspect, report, suspect_dt_s, findings, bridged=last)
        if jumped:
            again = self._suspect is not None
            self._suspect = report
            self.rejected += 1
            if again:
                return Verdict(None, (*findings, Finding("odometry-jump", "again, before it had settled")))
            x, y, turn = _moved(last, report)
            detail = f"{math.hypot(x, y):.2f} m and {math.degrees(turn):.0f}° in {dt_s * 1e3:.0f} ms"
            return Verdict(None, (*findings, Finding("odometry-jump", detail)))
        return self._accept(last, report, dt_s, findings)

    def _accept(
        self,
        before: OdometryInputs,
        report: OdometryInputs,
        dt_s: float,
        findings: tuple[Finding, ...],
        bridged: OdometryInputs | None = None,
    ) -> Verdict:
        dx_m, dy_m, turn = _moved(before, report)
        gap_s = 0.0 if bridged is None else max(0.0, elapsed_s(bridged, before))
        mean_rate = report.gyro_wz_radps
        if mean_rate is not None and before.gyro_wz_radps is not None:
            mean_rate = 0.5 * (mean_rate + before.gyro_wz_radps)
        mismatch, gyro_lies = self._mismatch((dx_m, dy_m, turn), dt_s, report, mean_rate)
        if gyro_lies:
            mean_rate = None
        increment = Increment(
            end_ns=report.received_ns,
            dt_s=dt_s + gap_s,
            dx_m=dx_m + gap_s * report.vx_mps,
            dy_m=dy_m + gap_s * report.vy_mps,
            odometry_rad=turn + gap_s * report.wz_radps,
            turn_rad=turn + gap_s * report.wz_radps if mean_rate is None else mean_rate * (dt_s + gap_s),
        )
        self._last, self._suspect = report, None
        if bridged is not None and not self._freed:
            self._held_at = report.T_odom_base  # a jump frees nothing
        frozen = self._frozen(report)
        return Verdict(increment, (*findings, *mismatch, *frozen))

    def _jump(self, before: OdometryInputs, report: OdometryInputs, dt_s: float) -> bool:
        x, y, turn = _moved(before, report)
        far = math.hypot(x, y) > JUMP_M + MAX_SPEED_MPS * dt_s
        return far or abs(turn) > JUMP_RAD + MAX_TURN_RADPS * dt_s

    def _mismatch(
        self, moved: tuple[float, float, float], dt_s: float, report: OdometryInputs, gyro_radps: float | None
    ) -> tuple[tuple[Finding, ...], bool]:
        """Compare pose changes with reported velocity and gyro over the same short time (row 12).

        Also return whether the gyro disagrees: a stuck one reports no turn while the robot turns.
        """
        dx_m, dy_m, turn_rad = moved
        window_s = MISMATCH_WINDOW_NS / 1e9
        if dt_s > 0.5 * window_s:
            # Two readings do not determine the motion over a long gap: the robot may have been stopped in it.
            self._apart.clear()
            self._apart_sums = [0.0] * len(self._apart_sums)
            return (), False
        # Row 9 covers a pose that does not change at all.
        has_turn_rates = gyro_radps is not None and any(moved)
        turned_apart = turn_rad - gyro_radps * dt_s if has_turn_rates and gyro_radps is not None else 0.0
        sums = self._apart_sums
        self._apart.append((dt_s, dx_m - report.vx_mps * dt_s, dy_m - report.vy_mps * dt_s, turned_apart))
        for index, value in enumerate(self._apart[-1]):
            sums[index] += value
        while len(self._apart) > 1 and sums[0] - self._apart[0][0] >= window_s:
            for index, value in enumerate(self._apart.popleft()):
                sums[index] -= value
        # Two reports may differ by their arrival; a full window does not.
        if sums[0] < 0.7 * window_s or len(self._apart) < 4:
            return (), False
        apart_mps, apart_radps = math.hypot(sums[1], sums[2]) / sums[0], abs(sums[3]) / sums[0]
        findings: tuple[Finding, ...] = ()
        if apart_mps > MISMATCH_MPS:
            detail = f"{apart_mps:.2f} m/s apart, at most {MISMATCH_MPS} m/s"
            findings = (Finding("odometry-speed-mismatch", detail),)
        if apart_radps > MISMATCH_RADPS:
            detail = f"gyro and reported yaw {apart_radps:.2f} rad/s apart, at most {MISMATCH_RADPS} rad/s"
            findings = (*findings, Finding("odometry-speed-mismatch", detail))
        return findings, apart_radps > MISMATCH_RADPS

    def _frozen(self, report: OdometryInputs) -> tuple[Finding, ...]:
        """Return row 9's finding once per attempt to move; the zero that follows ends the attempt.

        A robot at zero shows no fault: the next command is the next attempt, and the table counts them.
        """
        x, y, theta = report.T_odom_base
        self._freed = self._freed or math.hypot(x - self._held_at[0], y - self._held_at[1]) > FREED_M
        command = report.commanded
        if command is None or math.hypot(command[0], command[1]) <= FROZEN_COMMAND_MPS:
            self._pushed_since_ns = None
            return ()
        px, py, ptheta = self._pushed_from
        moved = math.hypot(x - px, y - py) > FROZEN_M or abs(wrap_angle(theta - ptheta)) > FROZEN_RAD
        if self._pushed_since_ns is None or moved:
            self._pushed_since_ns, self._pushed_from = report.received_ns, report.T_odom_base
            return ()
        held_ns = report.received_ns - self._pushed_since_ns
        if held_ns < FROZEN_NS:
            return ()
        self._pushed_since_ns = report.received_ns
        name = "odometry-frozen"
        if self._held_ns is not None:
            since_ns = report.received_ns - self._held_ns
            if since_ns <= (BLOCKED_NS if self._freed else AGAIN_NS):
                name = "robot-blocked" if self._freed else "odometry-stays-frozen"
        self._held_ns, self._held_at, self._freed = report.received_ns, report.T_odom_base, False
        return (Finding(name, f"no motion for {held_ns / 1e9:.1f} s at {math.hypot(*command[:2]):.2f} m/s"),)


def elapsed_s(before: OdometryInputs, after: OdometryInputs) -> float:
    """Return the time between two reports by the robot's clock, which the network does not delay, else by arrival."""
    received_s = (after.received_ns - before.received_ns) / 1e9
    if before.robot_stamp_ns > 0 and after.robot_stamp_ns > 0:
        robot_s = (after.robot_stamp_ns - before.robot_stamp_ns) / 1e9
        # A clock that was set does not measure durations.
        return robot_s if 0 < robot_s < received_s + 1.0 else received_s
    return received_s


def _finite(report: OdometryInputs) -> bool:
    gyro = report.gyro_wz_radps
    values = (*report.T_odom_base, report.vx_mps, report.vy_mps, report.wz_radps, 0.0 if gyro is None else gyro,
              report.roll_rad, report.pitch_rad)  # fmt: skip
    return all(abs(value) <= MAX_NUMBER for value in values)  # False for NaN


def _moved(before: OdometryInputs, after: OdometryInputs) -> tuple[float, float, float]:
    """Return forward, left and turn between two reports, in the body frame at the middle of the turn."""
    x0, y0, t0 = before.T_odom_base
    x1, y1, t1 = after.T_odom_base
    turn = wrap_angle(t1 - t0)
    c, s = math.cos(t0 + turn / 2), math.sin(t0 + turn / 2)
    return c * (x1 - x0) + s * (y1 - y0), c * (y1 - y0) - s * (x1 - x0), turn


class StillCheck:
    """Detects standstill: speed, turn, pose, command and feet must agree for a while."""

    def __init__(self) -> None:
        self._since_ns: int | None = None
        self._at = (0.0, 0.0)
        self._heading_rad = 0.0  # follows the reported one
        self._turned_rad = 0.0
        self._seconds = 0.0

    def step(self, report: OdometryInputs, increment: Increment, gyro_bias_radps: float) -> bool:
        """Return whether the robot stands, by this report and the earlier ones."""
        quiet = self._quiet(report, gyro_bias_radps)
        if quiet and self._since_ns is not None and self._stays(report, increment.dt_s):
            self._turned_rad += increment.turn_rad
            self._seconds += increment.dt_s
            return report.received_ns - self._since_ns >= STILL_NS
        self._since_ns = report.received_ns if quiet else None
        *place, self._heading_rad = report.T_odom_base
        self._at, self._turned_rad, self._seconds = (place[0], place[1]), 0.0, 0.0
        return False

    def _stays(self, report: OdometryInputs, dt_s: float) -> bool:
        x, y, theta = report.T_odom_base
        turned, most = wrap_angle(theta - self._heading_rad), STILL_HEADING_RADPS * dt_s
        self._heading_rad += min(max(turned, -most), most)
        return math.dist(self._at, (x, y)) <= STILL_M and abs(turned) <= STILL_HEADING_RAD

    def take_rate(self) -> tuple[float, float] | None:
        """Return mean yaw rate at rest (rad/s) and duration (s) once it is long enough. Each mean is returned once."""
        if self._seconds * 1e9 < STILL_NS:
            return None
        taken = (self._turned_rad / self._seconds, self._seconds)
        self._turned_rad = self._seconds = 0.0
        return taken

    def _quiet(self, report: OdometryInputs, gyro_bias_radps: float) -> bool:
        rate = report.wz_radps if report.gyro_wz_radps is None else report.gyro_wz_radps - gyro_bias_radps
        if math.hypot(report.vx_mps, report.vy_mps) > STILL_MPS or abs(rate) > STILL_RADPS:
            return False
        if report.commanded is not None and max(map(abs, report.commanded)) > COMMAND_MPS:
            return False
        feet = report.foot_forces
        # A robot without foot sensors reports zeros.
        return feet is None or not any(feet) or min(feet) * len(feet) >= FOOT_SHARE * sum(feet)
