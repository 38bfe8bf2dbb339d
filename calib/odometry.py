"""`edge-calib odometry`: fits a robot's odometry to what its gyro and camera, or a measured truth, show of a drive.

The drive is cut into intervals: between two answers of the camera, or by time where there is a truth. For each, the
robot's own motion is compared with the reference. Scales and bias come from least squares with the calibration of an
unknown robot as prior, so that what the drive does not show (sideways motion, say) stays where it was, as uncertain.
"""

from __future__ import annotations

import argparse
import math
import sys
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import tomli_w

from edge.core.cli import (
    EXIT_BAD_INPUT,
    EXIT_CHECK_FAILED,
    EXIT_DONE,
    check_result_target,
    command_line,
    write_named,
    write_result,
)
from edge.core.geometry import SE2, interpolate, wrap_angle
from edge.flightlog.reader import RecordingError, jpeg_bytes, read_messages
from edge.odometry.calibration import CalibrationError, OdometryCalibration
from edge.odometry.camera_geometry import Attitude, CameraGeometry
from edge.odometry.drift_rate import Comparison, DriftMonitor
from edge.odometry.gate import Increment, OdometryGate, OdometryInputs
from edge.odometry.pose_chain import Interval, OdometryModel, integrate, split
from edge.odometry.visual_odometry import VisualOdometry, grey_frame
from firmware_bridge.core.config import ConfigError, load_robot_config
from firmware_bridge.system.input_file import parse_json, read_bytes

Array = npt.NDArray[np.float64]
EPILOG = """examples:
  edge-calib odometry flight.mcap --robot go2.toml --out go2.odometry.toml
  edge-calib odometry flight.mcap --truth trace.jsonl --json -
Drive at least 10 m for this, with curves to both sides, and stand for 3 s before.
"""
TRUTH_INTERVAL_NS = 500_000_000
MAX_TRUTH_BYTES = 1 << 30
"""Largest trace of a truth, bytes: some seven hours of edge-hil."""
MIN_DISTANCE_M = 5.0
MIN_INTERVALS = 15
MAX_UNEXPLAINED = 0.15
"""Largest unexplained share of the motion (RMS over the intervals) of a usable fit."""
GYRO_NOISE_RADPS_RTHZ = math.radians(0.08)
STILL_MPS = 0.03
STILL_RADPS = math.radians(2.0)


class LogError(ValueError):
    """The log does not allow a calibration; one line: what is missing, what to do."""


class NoFitError(ValueError):
    """The fit is not good enough, or its calibration is implausible for any robot; one line."""


@dataclass(frozen=True)
class Drive:
    """A log's content: reports in the order of their stamps, and pictures (stamp, JPEG)."""

    reports: tuple[OdometryInputs, ...]
    pictures: tuple[tuple[int, bytes], ...]


@dataclass(frozen=True)
class Reference:
    """Motion over an interval by a source better than the odometry; `variance`: m² per axis and rad²."""

    start_ns: int
    end_ns: int
    motion: SE2
    variance_m2: float
    variance_rad2: float


@dataclass(frozen=True)
class Fit:
    """A calibration and its quality: unexplained share of the motion, before and after."""

    calibration: OdometryCalibration
    intervals: int
    distance_m: float
    unexplained_before: float
    unexplained: float
    drift_m_per_m_sigma: float
    drift_rad_per_m_sigma: float

    @property
    def good(self) -> bool:
        """Whether the calibration should be used."""
        enough = self.distance_m >= MIN_DISTANCE_M and self.intervals >= MIN_INTERVALS
        return enough and self.unexplained <= MAX_UNEXPLAINED


def read_drive(path: Path) -> Drive:
    """Read odometry and pictures of a flight log. Raises LogError, RecordingError or OSError."""
    reports: list[OdometryInputs] = []
    pictures: list[tuple[int, bytes]] = []
    for topic, stamp_ns, payload in read_messages(path):
        try:
            if topic == "/odometry":
                reports.append(_report(stamp_ns, payload))
            elif topic == "/camera":
                pictures.append((stamp_ns, jpeg_bytes(payload)))
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise LogError(
                f"{path}: {topic} at {stamp_ns} ns cannot be read ({error}): is the log of an older release?"
            ) from error
    if len(reports) < 100:
        raise LogError(f"{path}: {len(reports)} odometry reports, expected at least 100: record a drive with --record")
    reports.sort(key=lambda report: report.received_ns)
    pictures.sort(key=lambda picture: picture[0])
    return Drive(tuple(reports), tuple(pictures))


def _report(stamp_ns: int, payload: dict[str, Any]) -> OdometryInputs:
    # The recorder writes a number that was not finite as null.
    x, y, theta = (math.nan if v is None else float(v) for v in payload["raw_pose"])
    vx, vy, wz = (math.nan if v is None else float(v) for v in payload["velocity"])
    gyro, command = payload["gyro_wz_radps"], payload["command"]
    return OdometryInputs(
        received_ns=stamp_ns,
        T_odom_base=(x, y, theta),
        vx_mps=vx,
        vy_mps=vy,
        wz_radps=wz,
        gyro_wz_radps=None if gyro is None else float(gyro),
        roll_rad=float(payload.get("roll_rad") or 0.0),
        pitch_rad=float(payload.get("pitch_rad") or 0.0),
        commanded=None if command is None else (float(command[0]), float(command[1]), float(command[2])),
    )


def increments(drive: Drive) -> tuple[int, list[Increment]]:
    """Return the accepted motion between reports, and its start; reject what the runner rejects."""
    gate = OdometryGate()
    begin_ns: int | None = None
    accepted: list[Increment] = []
    for report in drive.reports:
        verdict = gate.step(report)
        if verdict.increment is not None:
            accepted.append(verdict.increment)
        elif begin_ns is None and not verdict.findings:
            begin_ns = report.received_ns
    if begin_ns is None or not accepted:
        raise LogError("the log holds no usable odometry: expected finite poses that advance")
    return begin_ns, accepted


def gyro_bias(drive: Drive, prior: OdometryCalibration) -> tuple[float, float]:
    """Return mean and standard error of the gyro at standstill, rad/s; the prior's without any standstill."""
    rates = [
        report.gyro_wz_radps
        for report in drive.reports
        if report.gyro_wz_radps is not None
        and math.hypot(report.vx_mps, report.vy_mps) < STILL_MPS
        and abs(report.gyro_wz_radps) < STILL_RADPS
        and (report.commanded is None or not any(report.commanded))
    ]
    span_ns = drive.reports[-1].received_ns - drive.reports[0].received_ns
    seconds = len(rates) * span_ns / 1e9 / max(1, len(drive.reports) - 1)
    if seconds < 0.5:
        return prior.gyro_bias_radps, prior.gyro_bias_sigma_radps
    return float(np.mean(rates)), GYRO_NOISE_RADPS_RTHZ / math.sqrt(seconds)


def visual_references(drive: Drive, geometry: CameraGeometry) -> list[Reference]:
    """Estimate the camera's motion, over the intervals of visual odometry."""
    eye = VisualOdometry(geometry)
    stamps = [report.received_ns for report in drive.reports]
    found: list[Reference] = []
    for stamp_ns, jpeg in drive.pictures:
        grey = grey_frame(jpeg)
        if grey is None:
            continue
        report = drive.reports[min(bisect_right(stamps, stamp_ns), len(stamps) - 1)]
        motion = eye.step(grey, stamp_ns, Attitude(report.roll_rad, report.pitch_rad))
        if motion is not None:
            c = motion.covariance
            variance_m2 = 0.5 * (c[0] + c[4])
            found.append(Reference(motion.start_ns, motion.end_ns, motion.T_start_end, variance_m2, c[8]))
    return found


def truth_references(path: Path, begin_ns: int, end_ns: int) -> list[Reference]:
    """Read the motion of a ground-truth trace (`edge-hil --trace`), every 0.5 s. Raises LogError or OSError."""
    stamps: list[int] = []
    poses: list[SE2] = []
    *whole, _ = read_bytes(path, MAX_TRUTH_BYTES).split(b"\n")  # the last line of a killed edge-hil may be cut
    for number, line in enumerate(whole, 1):
        try:
            entry = parse_json(line)
            if entry["kind"] == "pose":
                stamps.append(int(entry["t_ns"]))
                poses.append(SE2(float(entry["x"]), float(entry["y"]), float(entry["theta"])))
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise LogError(f"{path}:{number}: expected a line of edge-hil's trace ({error})") from error
    references: list[Reference] = []
    start_ns = max(begin_ns, stamps[0]) if stamps else end_ns
    while stamps and start_ns + TRUTH_INTERVAL_NS <= min(end_ns, stamps[-1]):
        ends = [_pose_at(stamps, poses, ns) for ns in (start_ns, start_ns + TRUTH_INTERVAL_NS)]
        references.append(Reference(start_ns, start_ns + TRUTH_INTERVAL_NS, ends[0].inverse() @ ends[1], 1e-6, 1e-6))
        start_ns += TRUTH_INTERVAL_NS
    if not references:
        raise LogError(f"{path}: no poses of the time of the log: expected a trace on the same monotonic clock")
    return references


def _pose_at(stamps: Sequence[int], poses: Sequence[SE2], stamp_ns: int) -> SE2:
    index = min(max(bisect_right(stamps, stamp_ns), 1), len(stamps) - 1)
    before_ns, after_ns = stamps[index - 1], stamps[index]
    return interpolate(poses[index - 1], poses[index], (stamp_ns - before_ns) / max(1, after_ns - before_ns))


def fit(drive: Drive, references: Sequence[Reference], prior: OdometryCalibration) -> Fit:
    """Fit scales and drift to the references. Raises LogError when none can be compared, or NoFitError."""
    bias, bias_sigma = gyro_bias(drive, prior)
    has_gyro = drive.reports[0].gyro_wz_radps is not None
    model = OdometryModel(
        has_gyro, bias if has_gyro else 0.0, 0.0, 0.0, 1.0, 1.0, GYRO_NOISE_RADPS_RTHZ, 0.05, 0.05, 0.05
    )
    begin_ns, accepted = increments(drive)
    pairs = [(interval, reference) for reference, interval in _intervals(begin_ns, accepted, references, model)]
    if not pairs:
        raise LogError("no interval of the drive could be compared: expected pictures of the floor, or --truth")
    raw = np.array([interval.motion[:2] for interval, _ in pairs])
    true = np.array([(r.motion.x_m, r.motion.y_m) for _, r in pairs])
    weight = np.array([1 / (r.variance_m2 + (0.02 * math.hypot(r.motion.x_m, r.motion.y_m)) ** 2) for _, r in pairs])
    turned = np.array([interval.odometry_rad for interval, _ in pairs])
    # The gyro turns more truly than a picture does; without one, or with a truth, the reference's own yaw is taken.
    gyro_wins = has_gyro and all(r.variance_rad2 > GYRO_NOISE_RADPS_RTHZ**2 for _, r in pairs)
    yaw = np.array([float(i.motion[2]) if gyro_wins else r.motion.theta_rad for i, r in pairs])
    (scale_x,), sigma_x = _least_squares(true[:, :1], raw[:, 0], weight, [prior.scale_x], [prior.scale_x_sigma])
    (scale_y, sideways), sigma_y = _least_squares(
        np.stack((true[:, 1], true[:, 0]), axis=1), raw[:, 1], weight,
        [prior.scale_y, prior.sideways_m_per_m], [prior.scale_y_sigma, prior.sideways_sigma],
    )  # fmt: skip
    yaw_weight = np.full(len(pairs), 1 / math.radians(0.3) ** 2)
    (scale_yaw,), sigma_yaw = _least_squares(
        yaw[:, None], turned, yaw_weight, [prior.scale_yaw], [prior.scale_yaw_sigma]
    )
    corrected = np.stack((raw[:, 0] / scale_x, (raw[:, 1] - sideways * true[:, 0]) / scale_y), axis=1)
    monitor = DriftMonitor(math.inf)
    for (_, r), point, odometry, reference_yaw in zip(pairs, corrected, turned / scale_yaw, yaw, strict=True):
        error = (float(point[0]) - r.motion.x_m, float(point[1]) - r.motion.y_m)
        variance_rad2 = 0.0 if gyro_wins else r.variance_rad2
        turn = wrap_angle(float(odometry) - float(reference_yaw))
        length = math.hypot(r.motion.x_m, r.motion.y_m)
        monitor.add(Comparison(length, *error, yaw_rad=turn, variance_m2=r.variance_m2, variance_rad2=variance_rad2))
    rate = monitor.rate()
    if rate.m_per_m is None or rate.rad_per_m is None:
        raise LogError(f"the robot moved {rate.distance_m:.1f} m in all: expected at least {MIN_DISTANCE_M:g} m")
    assert rate.m_per_m_sigma is not None and rate.rad_per_m_sigma is not None
    motion = math.sqrt(float((true**2).sum()))
    try:
        calibration = replace(
            prior,
            scale_x=scale_x,
            scale_x_sigma=sigma_x[0],
            scale_y=scale_y,
            scale_y_sigma=sigma_y[0],
            scale_yaw=scale_yaw,
            scale_yaw_sigma=sigma_yaw[0],
            sideways_m_per_m=sideways,
            sideways_sigma=sigma_y[1],
            gyro_bias_radps=bias,
            gyro_bias_sigma_radps=bias_sigma,
            drift_m_per_m=max(rate.m_per_m, 1e-3),
            drift_rad_per_m=max(rate.rad_per_m, 1e-4),
        )
    except CalibrationError as error:
        raise NoFitError(f"odometry and reference do not describe the same drive ({error})") from error
    return Fit(
        calibration=calibration,
        intervals=len(pairs),
        distance_m=rate.distance_m,
        unexplained_before=math.sqrt(float(((raw - true) ** 2).sum())) / motion,
        unexplained=math.sqrt(float(((corrected - true) ** 2).sum())) / motion,
        drift_m_per_m_sigma=rate.m_per_m_sigma,
        drift_rad_per_m_sigma=rate.rad_per_m_sigma,
    )  # fmt: skip


def _intervals(
    begin_ns: int, accepted: Sequence[Increment], references: Sequence[Reference], model: OdometryModel
) -> Iterator[tuple[Reference, Interval]]:
    """Pair every reference with its interval's odometry; leave out intervals with a gap."""
    rest = list(accepted)
    for reference in references:
        if reference.start_ns < begin_ns or not rest or reference.end_ns > rest[-1].end_ns:
            continue
        _, inside, rest = split(rest, begin_ns, reference.start_ns, reference.end_ns)
        begin_ns = reference.end_ns
        span_s = (reference.end_ns - reference.start_ns) / 1e9
        if inside and abs(sum(increment.dt_s for increment in inside) - span_s) < 0.1:
            yield reference, integrate(inside, model)


def _least_squares(
    columns: Array, values: Array, weight: Array, prior: Sequence[float], prior_sigma: Sequence[float]
) -> tuple[list[float], list[float]]:
    """Solve weighted least squares with a prior on each unknown; return estimates and standard errors."""
    information = np.diag(1 / np.square(prior_sigma))
    normal = (columns * weight[:, None]).T @ columns + information
    solution = np.linalg.solve(normal, (columns * weight[:, None]).T @ values + information @ np.array(prior))
    sigma = np.sqrt(np.diag(np.linalg.inv(normal)))
    return [float(v) for v in solution], [float(v) for v in sigma]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this job."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = EPILOG
    parser.add_argument("log", type=Path, metavar="LOG", help="flight log (MCAP) of a drive")
    parser.add_argument("--robot", type=Path, metavar="FILE.toml", help="robot file, for its camera's [mount]")
    parser.add_argument("--truth", type=Path, metavar="FILE.jsonl", help="trace of edge-hil, instead of the camera")
    parser.add_argument("--out", type=Path, metavar="FILE.toml", help="write the calibration here, if the fit is good")
    parser.add_argument("--json", metavar="FILE|-", help="write the result as JSON")


def calibration_text(calibration: OdometryCalibration, source: str) -> str:
    """Return a calibration file with six digits a value; `source` is one line of text for its first comment."""
    values = {name: float(f"{value:.6g}") for name, value in asdict(calibration).items()}
    return f"# Odometry of one robot, by {source}.\n{tomli_w.dumps(values)}"


@command_line(
    "edge-calib odometry",
    {
        NoFitError: EXIT_CHECK_FAILED,
        **dict.fromkeys((LogError, RecordingError, ConfigError, OSError), EXIT_BAD_INPUT),
    },
)
def run(args: argparse.Namespace) -> int:
    """Fit and write; returns the exit code."""
    check_result_target(args.json)
    if args.out is not None:
        check_result_target(str(args.out), "--out")
    geometry = _geometry(args.robot) if args.truth is None else None
    drive = read_drive(args.log)
    fitted = fit(drive, _references(args.truth, geometry, drive), OdometryCalibration())
    if fitted.good and args.out is not None:
        source = f"edge-calib odometry from {args.log.name}: {fitted.distance_m:.1f} m driven"
        write_named(args.out, calibration_text(fitted.calibration, source))
    write_result(args.json, {"good": fitted.good, **asdict(fitted)})
    sys.stderr.write(_table(fitted))
    if not fitted.good:
        raise NoFitError(
            f"the fit is not good enough to be used: {fitted.intervals} intervals over {fitted.distance_m:.1f} m, "
            f"{100 * fitted.unexplained:.0f} % of the motion unexplained; expected at least {MIN_INTERVALS} over "
            f"{MIN_DISTANCE_M:g} m and at most {100 * MAX_UNEXPLAINED:.0f} %: drive on, in light"
        )
    return EXIT_DONE


def _references(truth: Path | None, geometry: CameraGeometry | None, drive: Drive) -> list[Reference]:
    if truth is not None:
        return truth_references(truth, drive.reports[0].received_ns, drive.reports[-1].received_ns)
    assert geometry is not None
    return visual_references(drive, geometry)


def _geometry(robot: Path | None) -> CameraGeometry:
    """Read how a robot's camera is mounted. Raises LogError or ConfigError."""
    if robot is None:
        raise LogError("expected --robot FILE.toml, whose [mount] describes how the camera sees the floor, or --truth")
    mount = load_robot_config(robot).mount
    if mount is None:
        raise LogError(f"{robot}: has no [mount]: add how the camera is mounted, or give --truth")
    return CameraGeometry(math.radians(mount.hfov_deg), mount.height_m, math.radians(mount.pitch_deg), mount.forward_m)


def _table(fitted: Fit) -> str:
    c = fitted.calibration
    rows = (
        ("scale forward", c.scale_x, c.scale_x_sigma, ""),
        ("scale left", c.scale_y, c.scale_y_sigma, ""),
        ("scale yaw", c.scale_yaw, c.scale_yaw_sigma, ""),
        ("sideways", c.sideways_m_per_m, c.sideways_sigma, "m/m"),
        ("gyro bias", math.degrees(c.gyro_bias_radps), math.degrees(c.gyro_bias_sigma_radps), "°/s"),
        ("drift", c.drift_m_per_m, fitted.drift_m_per_m_sigma, "m/m"),
        ("drift", math.degrees(c.drift_rad_per_m), math.degrees(fitted.drift_rad_per_m_sigma), "°/m"),
    )
    lines = [f"{name:14} {value:9.4f} ± {sigma:.4f} {unit}".rstrip() for name, value, sigma, unit in rows]
    lines.append(
        f"{fitted.intervals} intervals, {fitted.distance_m:.1f} m; unexplained "
        f"{100 * fitted.unexplained_before:.1f} % as reported, {100 * fitted.unexplained:.1f} % as calibrated"
    )
    return "\n".join(lines) + "\n"
