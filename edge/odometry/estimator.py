"""Drift estimator: fuses body odometry, gyro, standstill and the camera's motion into one planar pose.

Between two visual motions it dead-reckons the pose from position increments and the gyro. A visual motion arrives about
0.1 s late: the estimator corrects the interval that it covers and replays the later increments. It rejects a visual
motion that contradicts gyro and odometry by more than their errors. It learns the gyro's bias whenever the robot
stands, and scales and bias also from the camera. Pure: no clock, thread or I/O.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from edge.core.geometry import SE2, wrap_angle
from edge.odometry import pose_chain
from edge.odometry.calibration import OdometryCalibration
from edge.odometry.drift_rate import Comparison, DriftMonitor, DriftRate
from edge.odometry.gate import Increment, OdometryGate, OdometryInputs, StillCheck, age_findings
from edge.odometry.pose_chain import (
    HEADING,
    VISUAL,
    Array,
    Cursor,
    Interval,
    Node,
    OdometryModel,
    advance,
    bent,
    integrate,
    split,
)
from edge.odometry.visual_odometry import VisualMotion
from edge.safety.faults.findings import Finding
from edge.state.pose_history import StampedPose

_SHORT = 1.3
"""Error rate over a few decimetres relative to that over a metre, which partly averages out."""


GYRO_NOISE_RADPS_RTHZ = math.radians(0.08)
"""White noise of the yaw rate. A bare BMI088 has 0.014 °/s/√Hz (its data sheet); a trot shakes and tilts it."""
GYRO_BIAS_WALK_RADPS_RTS = math.radians(0.008)
"""Apparent turn of a trotting body, which rolls and pitches: 0.02 to 0.07 °/s, simulated."""
SCALE_WALK_RTM = 0.005
"""Change of the odometry's scales per square root of a metre."""
VISUAL_SCALE_SIGMA = 0.007
"""Common error of all visual motions, from the camera's height and mounting angle."""
STAMP_SIGMA_S = 0.01
"""Error of a picture's stamp. A trot sways and yaws fast enough for 10 ms to matter more than the pixels."""
VISUAL_GATE = 25.0
"""Squared distance, 3 degrees of freedom, above which a visual motion is rejected."""
PRIOR_M = 5.0
"""Driven distance that weighs as much as the calibration's drift."""
HISTORY_NS = 30_000_000_000
NODE_NS = 15_000_000
PENDING_NS = 2_000_000_000
"""Longest wait for the camera's motion over an interval."""
FLOOR_M = 0.001
FLOOR_RAD = math.radians(0.05)
"""Lower bound of the uncertainty: stamps, interpolation, the sway of the body."""


@dataclass(frozen=True)
class OdometryOutputs:
    """Result of one report; `pose` is None when the report was rejected or brought nothing new."""

    pose: StampedPose | None
    findings: tuple[Finding, ...]
    drift: DriftRate
    standing: bool


class DriftEstimator:
    """Fuses one robot's reports. One thread calls `step`; any thread may call the other methods."""

    def __init__(self, calibration: OdometryCalibration | None = None, stamp_sigma_s: float = STAMP_SIGMA_S) -> None:
        self._stamp_sigma_s = stamp_sigma_s
        self._calibration = calibration or OdometryCalibration()
        self._gate = OdometryGate()
        self._visual: deque[VisualMotion] = deque(maxlen=16)
        self._pending: deque[Increment] = deque()
        self._commit: Cursor | None = None
        self._live: Cursor | None = None
        # Published as a whole: (nodes, newest); a published list never changes.
        self._published: tuple[list[Node], Node] | None = None
        known = self._calibration
        self._model = OdometryModel(
            has_gyro=True,
            heading=known.gyro_bias_radps,
            scale=known.scale_x - 1.0,
            sideways=known.sideways_m_per_m,
            scale_y=known.scale_y,
            scale_yaw=known.scale_yaw,
            gyro_noise_radps_rthz=GYRO_NOISE_RADPS_RTHZ,
            rate_m_per_m=known.drift_m_per_m,
            rate_rad_per_m=known.drift_rad_per_m,
            rate_rad_per_rtrad=known.scale_yaw_sigma,
        )
        self._visual_scale = 0.0
        self._covariance = np.zeros((4, 4))
        self._walked_ns = 0  # until when the covariance contains the gyro bias's walk
        self._drift, self._residual = DriftMonitor(), DriftMonitor()
        self._still = StillCheck()
        self.visual_used = 0
        self.visual_rejected = 0

    @property
    def rejected(self) -> int:
        """Number of rejected reports."""
        return self._gate.rejected

    @property
    def gyro_bias_radps(self) -> float:
        """Learned gyro bias, rad/s; 0 without a gyro."""
        return self._model.heading if self._model.has_gyro else 0.0

    def add_visual(self, motion: VisualMotion) -> None:
        """Queue the camera's motion for the next `step`. Any thread, never waits."""
        self._visual.append(motion)

    def motion_offset(self, anchor_ns: int) -> tuple[SE2, Array] | None:
        """Return motion since an instant of the last 30 s, (Δx m, Δy m, Δθ rad), and its error covariance [3, 3].

        None for an instant before the history begins. Any thread, never waits.
        """
        published = self._published
        if published is None:
            return None
        nodes, newest = published
        anchor = newest if anchor_ns >= newest.stamp_ns else pose_chain.at([*nodes, newest], anchor_ns)
        if anchor is None:
            return None
        offset, covariance = pose_chain.relative(anchor, newest)
        return offset, covariance + np.diag((FLOOR_M**2,) * 2 + (FLOOR_RAD**2,))

    def step(self, report: OdometryInputs, now_ns: int) -> OdometryOutputs:
        """Take one report as it arrives; return the pose, the findings and the odometry's drift."""
        verdict = self._gate.step(report)
        findings = verdict.findings
        if now_ns > report.received_ns:
            findings = (*findings, *age_findings(now_ns - report.received_ns))
        finite = not any(finding.name == "odometry-not-finite" for finding in findings)
        if self._live is None and finite:
            return OdometryOutputs(self._start(report), findings, self._drift.rate(), standing=False)
        increment = verdict.increment
        if increment is None or self._live is None:
            return OdometryOutputs(None, findings, self._drift.rate(), standing=False)
        standing = self._still.step(report, increment, self.gyro_bias_radps)
        if standing:
            increment = replace(increment, still=True)
            self._learn_bias()
        self._pending.append(increment)
        self._live = advance(self._live, increment, self._model)
        self._see()
        self._publish()
        self._settle(increment.end_ns - PENDING_NS)
        return OdometryOutputs(self._stamped(report, standing), findings, self._drift.rate(), standing)

    def _start(self, report: OdometryInputs) -> StampedPose:
        known, has_gyro = self._calibration, report.gyro_wz_radps is not None
        heading_sigma = known.gyro_bias_sigma_radps if has_gyro else known.drift_rad_per_m
        self._model = replace(self._model, has_gyro=has_gyro, heading=known.gyro_bias_radps if has_gyro else 0.0)
        sigmas = (heading_sigma, known.scale_x_sigma, known.sideways_sigma, VISUAL_SCALE_SIGMA)
        self._covariance = np.diag(np.square(sigmas))
        self._walked_ns = report.received_ns
        node = pose_chain.origin(report.received_ns, report.T_odom_base, self._covariance)
        self._commit = self._live = Cursor(node, 0.0)
        self._published = ([node], node)
        return self._stamped(report, standing=False)

    def _stamped(self, report: OdometryInputs, standing: bool) -> StampedPose:
        assert self._live is not None
        node, model = self._live.node, self._model
        if standing:
            velocity = (0.0, 0.0, 0.0)
        else:
            vx = report.vx_mps / (1.0 + model.scale)
            vy = (report.vy_mps - model.sideways * vx) / model.scale_y
            rate = report.gyro_wz_radps
            velocity = (vx, vy, report.wz_radps if rate is None else rate - self.gyro_bias_radps)
        return StampedPose(node.stamp_ns, node.pose, *velocity, report.roll_rad, report.pitch_rad)

    def _learn_bias(self) -> None:
        """Learn the gyro's bias at rest."""
        measured = self._still.take_rate()
        if measured is None or not self._model.has_gyro:
            return
        rate_radps, seconds = measured
        assert self._live is not None and self._commit is not None
        now_ns = self._live.node.stamp_ns
        # Without it the bias would become an average of all the time at rest: it changes as the sensor warms up.
        walked = self._covariance.copy()  # the nodes keep the old one
        walked[HEADING, HEADING] += GYRO_BIAS_WALK_RADPS_RTS**2 * max(now_ns - self._walked_ns, 0) / 1e9
        self._walked_ns = max(now_ns, self._walked_ns)
        row = walked[HEADING]
        gain = row / (row[HEADING] + GYRO_NOISE_RADPS_RTHZ**2 / seconds)
        self._learn(gain * (rate_radps - self._model.heading), walked - np.outer(gain, row))
        self._live, self._commit = (
            each._replace(node=each.node._replace(parameters=self._covariance)) for each in (self._live, self._commit)
        )

    def _learn(self, change: Array, covariance: Array) -> None:
        """Correct the parameters."""
        heading, scale, sideways, visual_scale = (float(v) for v in change)
        model = self._model
        self._model = replace(
            model, heading=model.heading + heading, scale=model.scale + scale, sideways=model.sideways + sideways
        )
        self._visual_scale += visual_scale
        self._covariance = 0.5 * (covariance + covariance.T)

    def _publish(self) -> None:
        assert self._published is not None and self._live is not None
        nodes, node = self._published[0], self._live.node
        if node.stamp_ns - nodes[-1].stamp_ns >= NODE_NS:
            oldest_ns = node.stamp_ns - HISTORY_NS
            # Drop up to two per new node, but keep one older than the requested time.
            first = 2 if len(nodes) > 2 and nodes[2].stamp_ns < oldest_ns else 0
            nodes = [*nodes[first:], node]
        self._published = (nodes, node)

    def _settle(self, before_ns: int) -> None:
        """Stop waiting for the camera on old intervals."""
        assert self._commit is not None
        while self._pending and self._pending[0].end_ns < before_ns:
            self._commit = advance(self._commit, self._pending.popleft(), self._model)

    def _see(self) -> None:
        """Use the visual motions that have arrived, if the odometry has reached their end."""
        assert self._live is not None
        while self._visual and self._visual[0].end_ns <= self._live.node.stamp_ns:
            try:
                used = self._fuse(self._visual.popleft())
            except np.linalg.LinAlgError:
                used = False
            if used:
                self.visual_used += 1
            else:
                self.visual_rejected += 1

    def _fuse(self, seen: VisualMotion) -> bool:
        """Correct the camera's interval and replay later increments; return False for a rejected visual motion."""
        assert self._commit is not None and self._published is not None
        if seen.start_ns < self._commit.node.stamp_ns:
            return False
        before, inside, after = split(self._pending, self._commit.node.stamp_ns, seen.start_ns, seen.end_ns)
        if not inside:
            return False
        interval = integrate(inside, self._model)
        if interval.still:
            return False
        pictures = np.reshape(seen.covariance, (3, 3))
        visual = pictures + self._mistimed(inside)
        by = np.zeros((3, pose_chain.PARAMETERS))
        # By the odometry's motion: the noise of the seen one, also in the innovation, would raise both scales for ever.
        by[:2, VISUAL] = interval.motion[:2]
        observed = np.array(seen.T_start_end.as_tuple())
        observed[:2] /= 1.0 + self._visual_scale
        innovation = observed - interval.motion
        innovation[2] = wrap_angle(float(innovation[2]))
        model = by - interval.gains
        total = model @ self._covariance @ model.T + visual + interval.white
        if not float(innovation @ np.linalg.solve(total, innovation)) <= VISUAL_GATE:  # also for NaN
            return False
        gain = self._covariance @ model.T @ np.linalg.inv(total)
        change = gain @ innovation
        # Given the parameters, odometry and camera are independent: weigh them by their white noise alone. The
        # parameters' remaining error then acts through the gains of both, in these shares.
        share = interval.white @ np.linalg.inv(interval.white + visual)
        motion = interval.motion - interval.gains @ change + share @ (innovation - model @ change)
        white = interval.white - share @ interval.white
        gains = -(interval.gains + share @ model)
        # Without the stamps' error: it cancels between consecutive intervals, which are added up here.
        self._compare(interval, observed, float(motion[2]), pictures, white)
        walked = self._covariance - gain @ model @ self._covariance
        self._learn(change, walked + self._walk(interval, seen))
        self._replay(before, inside, after, seen, motion, 0.5 * (white + white.T), gains)
        return True

    def _mistimed(self, inside: list[Increment]) -> Array:
        """Return the covariance from stamp errors of two pictures while the robot moves."""
        seconds = sum(increment.dt_s for increment in inside)
        if seconds <= 0:
            return np.zeros((3, 3))
        shares = [
            (part.dx_m**2 / part.dt_s, part.dy_m**2 / part.dt_s, part.turn_rad**2 / part.dt_s)
            for part in inside
            if part.dt_s > 0
        ]
        mean_squares = np.sum(shares, axis=0) / seconds
        return np.diag(2 * self._stamp_sigma_s**2 * mean_squares)

    def _walk(self, interval: Interval, seen: VisualMotion) -> Array:
        seconds = max(seen.end_ns - max(seen.start_ns, self._walked_ns), 0) / 1e9
        self._walked_ns = max(seen.end_ns, self._walked_ns)
        scale = SCALE_WALK_RTM**2 * interval.distance_m
        heading = GYRO_BIAS_WALK_RADPS_RTS**2 * seconds if self._model.has_gyro else scale
        return np.diag((heading, scale, scale, 0.0))

    def _compare(self, interval: Interval, observed: Array, turn_rad: float, visual: Array, white: Array) -> None:
        """Compare odometry, reported and corrected, with the camera's translation and the fused turn."""
        # Without a gyro the fused turn contains the odometry's.
        reference = turn_rad if self._model.has_gyro else float(observed[2])
        variance_rad2 = float(white[2, 2] if self._model.has_gyro else visual[2, 2])
        variance_m2 = 0.5 * float(visual[0, 0] + visual[1, 1])
        distance = float(math.hypot(observed[0], observed[1]))
        yaw = wrap_angle(interval.odometry_rad - reference)
        for monitor, motion in ((self._drift, interval.uncorrected), (self._residual, interval.motion)):
            forward, left = float(motion[0] - observed[0]), float(motion[1] - observed[1])
            monitor.add(Comparison(distance, forward, left, yaw, variance_m2, variance_rad2))
        rate, known = self._residual.rate(), self._calibration
        if rate.m_per_m is not None and rate.rad_per_m is not None:
            weight, prior = min(rate.distance_m, 20.0), PRIOR_M
            a, b = math.sqrt(prior / (prior + weight)), math.sqrt(weight / (prior + weight))
            self._model = replace(
                self._model,
                rate_m_per_m=_SHORT * math.hypot(known.drift_m_per_m * a, rate.m_per_m * b),
                rate_rad_per_m=_SHORT * math.hypot(known.drift_rad_per_m * a, rate.rad_per_m * b),
            )

    def _replay(
        self, before: list[Increment], inside: list[Increment], after: list[Increment], seen: VisualMotion,
        motion: Array, white: Array, gains: Array,
    ) -> None:  # fmt: skip
        """Rebuild the chain from the last settled pose on."""
        assert self._commit is not None and self._published is not None
        cursor = self._commit
        kept = [node for node in self._published[0] if node.stamp_ns <= cursor.node.stamp_ns]
        nodes: list[Node] = []
        for increment in before:
            cursor = advance(cursor, increment, self._model)
            nodes.append(cursor.node)
        start = cursor.node
        end = pose_chain.add_interval(start, seen.end_ns, motion, white, gains, self._covariance)
        for increment in inside:
            cursor = advance(cursor, increment, self._model)
            nodes.append(cursor.node)
        nodes[len(before) :] = bent([*nodes[len(before) :]], start, end)
        self._commit = cursor = Cursor(end, 0.0)
        for increment in after:
            cursor = advance(cursor, increment, self._model)
            nodes.append(cursor.node)
        self._live = cursor
        self._pending = deque(after)
        spaced = [*kept]
        for node in nodes:
            if not spaced or node.stamp_ns - spaced[-1].stamp_ns >= NODE_NS or node is end:
                spaced.append(node)
        self._published = (spaced, cursor.node)
