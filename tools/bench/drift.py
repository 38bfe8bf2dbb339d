"""Odometry drift: error of the fused motion offset against the robot's own, and consistency of its covariance.

    python -m tools.bench.drift --walks 50 --jobs 2 --json out/bench/drift.json

Every walk is the simulated Go2 under physics in the corridor with its camera; `sim_hil.robots.odometry_noise` then adds
the paper's two levels of drift (table 14). Compared over windows of 5 s: the robot's own motion offset, the
estimator's, and the truth. Exit code 1 if a bound of `GATES` does not hold.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from multiprocessing import get_context
from typing import Any

import cv2
import numpy as np

from edge.core.cli import EXIT_CHECK_FAILED, EXIT_DONE, check_result_target, command_line, write_result
from edge.core.geometry import SE2, wrap_angle
from edge.odometry.drift_rate import Comparison, DriftMonitor
from edge.odometry.estimator import DriftEstimator
from edge.odometry.gate import OdometryInputs
from reporting.progress import Progress
from sim_hil.robots.odometry_noise import LEVELS, OdometryNoise
from sim_hil.scene.scene import load_scene
from tools.bench import bad_input, command_parser
from tools.bench.sim.drift_runs import CAMERA_DELAY_NS, STAND_S, STATE_NS, SensorNoise, Walk, record_walk

WINDOW_NS = 5_000_000_000
EVERY_NS = 1_000_000_000
RATE_AFTER_M = 20.0
SEGMENT_M = 0.25
MAX_RATIO = 0.5
MAX_RATE_ERROR = 0.25
CHI2_95_3 = 7.815
"""95 % quantile of chi-square with 3 degrees of freedom."""
TESTED = ("typical", "severe")


@dataclass(frozen=True)
class Window:
    """Errors of one 5 s motion offset: m and rad, of the robot's odometry and of the estimator; NEES of the latter."""

    end_s: float
    moved_m: float
    raw_m: float
    raw_rad: float
    fused_m: float
    fused_rad: float
    nees: float
    sigma_m: float
    sigma_rad: float


@dataclass(frozen=True)
class DriftRun:
    """Result of one walk at one level of drift."""

    seed: int
    level: str
    windows: tuple[Window, ...]
    true_m_per_m: float
    true_rad_per_m: float
    estimated_m_per_m: float
    estimated_rad_per_m: float
    sigma_m_per_m: float
    sigma_rad_per_m: float
    distance_m: float
    visual_used: int
    visual_rejected: int
    step_us: tuple[float, float, float]
    """Median, 99th percentile and maximum of a step without a visual motion; this thread's processor time."""
    findings: int


def replay(walk: Walk, level: str, seed: int) -> DriftRun:
    """Add drift to a walk's odometry and run the estimator."""
    noise = OdometryNoise(LEVELS[level], seed, walk.samples[0].T_world_base)
    estimator = DriftEstimator(stamp_sigma_s=SensorNoise().stamp_ns / 1e9)
    truth_monitor = _TrueDrift()
    raws: list[SE2] = []
    windows: list[Window] = []
    step_us: list[float] = []
    pending = list(walk.visual)
    findings = 0
    rate = true = None
    for index, sample in enumerate(walk.samples):
        last = walk.samples[max(index - 1, 0)]
        moved = last.T_world_base.inverse() @ sample.T_world_base
        before = noise.pose
        report = noise.step(moved, STATE_NS / 1e9)
        raws.append(report.T_odom_base)
        truth_monitor.add(moved, before.inverse() @ report.T_odom_base)
        arrived = False
        while pending and pending[0].end_ns + CAMERA_DELAY_NS <= sample.stamp_ns:
            estimator.add_visual(pending.pop(0))
            arrived = True
        inputs = OdometryInputs(
            received_ns=sample.stamp_ns,
            T_odom_base=report.T_odom_base.as_tuple(),
            vx_mps=report.vx_mps,
            vy_mps=report.vy_mps,
            wz_radps=report.wz_radps,
            gyro_wz_radps=sample.gyro_wz_radps,
            roll_rad=sample.roll_rad,
            pitch_rad=sample.pitch_rad,
            robot_stamp_ns=sample.stamp_ns + 1,
            foot_forces=sample.foot_forces,
            commanded=sample.commanded,
        )
        begin_ns = time.thread_time_ns()
        outputs = estimator.step(inputs, sample.stamp_ns)
        if not arrived:
            step_us.append((time.thread_time_ns() - begin_ns) / 1e3)
        findings += len(outputs.findings)
        if sample.stamp_ns % EVERY_NS < STATE_NS and sample.stamp_ns >= STAND_S * 1e9 + WINDOW_NS:
            windows.append(_window(walk, raws, estimator, index))
        if rate is None and truth_monitor.distance_m >= RATE_AFTER_M:
            rate, true = outputs.drift, truth_monitor.rate()
    if rate is None or true is None or rate.m_per_m is None or rate.rad_per_m is None:
        raise RuntimeError(f"walk {walk.seed}: no drift rate after {truth_monitor.distance_m:.1f} m")
    assert rate.m_per_m_sigma is not None and rate.rad_per_m_sigma is not None
    return DriftRun(
        seed=walk.seed,
        level=level,
        windows=tuple(windows),
        true_m_per_m=true[0],
        true_rad_per_m=true[1],
        estimated_m_per_m=rate.m_per_m,
        estimated_rad_per_m=rate.rad_per_m,
        sigma_m_per_m=rate.m_per_m_sigma,
        sigma_rad_per_m=rate.rad_per_m_sigma,
        distance_m=truth_monitor.distance_m,
        visual_used=estimator.visual_used,
        visual_rejected=estimator.visual_rejected,
        step_us=(float(np.median(step_us)), float(np.percentile(step_us, 99)), max(step_us)),
        findings=findings,
    )


class _TrueDrift:
    """Drift as injected, over the same metres as the estimator's: the net path in segments of a key frame's length."""

    def __init__(self) -> None:
        self._monitor = DriftMonitor()
        self._true = SE2(0.0, 0.0, 0.0)
        self._errors = [0.0, 0.0, 0.0]
        self.distance_m = 0.0

    def add(self, moved: SE2, reported: SE2) -> None:
        c, s = math.cos(self._true.theta_rad), math.sin(self._true.theta_rad)
        ex, ey = reported.x_m - moved.x_m, reported.y_m - moved.y_m
        self._errors[0] += c * ex - s * ey
        self._errors[1] += s * ex + c * ey
        self._errors[2] += wrap_angle(reported.theta_rad - moved.theta_rad)
        self._true = self._true @ moved
        length = math.hypot(self._true.x_m, self._true.y_m)
        if length >= SEGMENT_M:
            forward_m, left_m, yaw_rad = self._errors
            self._monitor.add(Comparison(length, forward_m, left_m, yaw_rad, variance_m2=0.0, variance_rad2=0.0))
            self.distance_m += length
            self._true, self._errors = SE2(0.0, 0.0, 0.0), [0.0, 0.0, 0.0]

    def rate(self) -> tuple[float, float]:
        rate = self._monitor.rate()
        assert rate.m_per_m is not None and rate.rad_per_m is not None
        return rate.m_per_m, rate.rad_per_m


def _window(walk: Walk, raws: Sequence[SE2], estimator: DriftEstimator, index: int) -> Window:
    now = walk.samples[index]
    first = index - WINDOW_NS // STATE_NS
    true = walk.samples[first].T_world_base.inverse() @ now.T_world_base
    raw = raws[first].inverse() @ raws[index]
    offset = estimator.motion_offset(walk.samples[first].stamp_ns)
    assert offset is not None
    fused, covariance = offset
    error = np.array((fused.x_m - true.x_m, fused.y_m - true.y_m, wrap_angle(fused.theta_rad - true.theta_rad)))
    return Window(
        end_s=now.stamp_ns / 1e9,
        moved_m=math.hypot(true.x_m, true.y_m),
        raw_m=math.hypot(raw.x_m - true.x_m, raw.y_m - true.y_m),
        raw_rad=abs(wrap_angle(raw.theta_rad - true.theta_rad)),
        fused_m=math.hypot(error[0], error[1]),
        fused_rad=abs(float(error[2])),
        nees=float(error @ np.linalg.solve(covariance, error)),
        sigma_m=math.sqrt(covariance[0, 0] + covariance[1, 1]),
        sigma_rad=math.sqrt(covariance[2, 2]),
    )


def chi_square_band(degrees: int) -> tuple[float, float]:
    """Return the two-sided 95 % band of chi-square with many degrees of freedom (Wilson-Hilferty approximation)."""
    spread = math.sqrt(2 / (9 * degrees))
    low, high = ((1 - 2 / (9 * degrees) + z * spread) ** 3 * degrees for z in (-1.959964, 1.959964))
    return low, high


def summarise(runs: Sequence[DriftRun]) -> dict[str, Any]:
    """Summarise the runs of one level and check each bound."""
    windows = [window for run in runs for window in run.windows]

    def rms(name: str) -> float:
        return math.sqrt(float(np.mean([getattr(window, name) ** 2 for window in windows])))

    ratio_m, ratio_rad = rms("fused_m") / rms("raw_m"), rms("fused_rad") / rms("raw_rad")
    # Windows of a walk share its biases: use only each walk's last window as an independent sample.
    nees = float(np.mean([run.windows[-1].nees for run in runs]))
    low, high = (bound / len(runs) for bound in chi_square_band(3 * len(runs)))
    translation = [abs(run.estimated_m_per_m / run.true_m_per_m - 1) for run in runs]
    rotation = [abs(run.estimated_rad_per_m / run.true_rad_per_m - 1) for run in runs]
    return {
        "runs": len(runs),
        "windows": len(windows),
        "raw_rms_m": rms("raw_m"),
        "fused_rms_m": rms("fused_m"),
        "ratio_m": ratio_m,
        "raw_rms_deg": math.degrees(rms("raw_rad")),
        "fused_rms_deg": math.degrees(rms("fused_rad")),
        "ratio_rad": ratio_rad,
        "nees_mean": nees,
        "nees_band": [low, high],
        "nees_all_windows": float(np.mean([window.nees for window in windows])),
        "nees_below_95": float(np.mean([window.nees <= CHI2_95_3 for window in windows])),
        "rate_error_m": _spread(translation),
        "rate_error_rad": _spread(rotation),
        "step_us_p50": float(np.median([run.step_us[0] for run in runs])),
        "step_us_p99": float(np.median([run.step_us[1] for run in runs])),
        "visual_used": sum(run.visual_used for run in runs),
        "visual_rejected": sum(run.visual_rejected for run in runs),
        "findings": sum(run.findings for run in runs),
        "kept": {
            "offset position at most half": ratio_m <= MAX_RATIO,
            "offset heading at most half": ratio_rad <= MAX_RATIO,
            "NEES inside its 95 % band": low <= nees <= high,
            "drift m/m within 25 % (9 of 10 walks)": _share_within(translation) >= 0.9,
            "drift °/m within 25 % (9 of 10 walks)": _share_within(rotation) >= 0.9,
        },
    }


def _share_within(errors: Sequence[float]) -> float:
    return float(np.mean([error <= MAX_RATE_ERROR for error in errors]))


def _spread(errors: Sequence[float]) -> dict[str, float]:
    return {
        "median": float(np.median(errors)),
        "p90": float(np.percentile(errors, 90)),
        "max": max(errors),
        "share_within_25_percent": _share_within(errors),
    }


def walk_and_replay(
    seed: int, *, scene: str, people: int, distance_m: float
) -> tuple[list[DriftRun], dict[str, float]]:
    """Record one walk and replay it at both levels; returns the runs and the camera's computing times."""
    cv2.setNumThreads(1)
    walk = record_walk(load_scene(scene), seed, distance_m=distance_m, people=people, noise=SensorNoise())
    runs = [replay(walk, level, 1000 * seed + index) for index, level in enumerate(TESTED)]
    p50, p99 = np.percentile(walk.visual_ms, (50, 99))
    camera = {"frames": walk.frames, "refused": walk.refused, "p50_ms": float(p50), "p99_ms": float(p99)}
    return runs, camera


def _table(summary: dict[str, Any]) -> str:
    lines = []
    for level in TESTED:
        s = summary[level]
        lines += [
            f"{level}: {s['runs']} walks, {s['windows']} windows of 5 s",
            f"  position  {1e3 * s['raw_rms_m']:6.1f} mm raw {1e3 * s['fused_rms_m']:6.1f} mm fused"
            f" ×{s['ratio_m']:.2f}",
            f"  heading   {s['raw_rms_deg']:6.2f} °  raw {s['fused_rms_deg']:6.2f} °  fused ×{s['ratio_rad']:.2f}",
            f"  NEES      {s['nees_mean']:.2f} (95 % band {s['nees_band'][0]:.2f}..{s['nees_band'][1]:.2f}); "
            f"all windows {s['nees_all_windows']:.2f}, {100 * s['nees_below_95']:.0f} % below {CHI2_95_3}",
        ]
        for name, unit in (("rate_error_m", "m/m"), ("rate_error_rad", "°/m")):
            e = s[name]
            lines.append(
                f"  drift {unit}  error median {100 * e['median']:.0f} %, p90 {100 * e['p90']:.0f} %, max "
                f"{100 * e['max']:.0f} %; within 25 %: {100 * e['share_within_25_percent']:.0f} %"
            )
        lines.append(f"  step      {s['step_us_p50']:.0f} µs p50, {s['step_us_p99']:.0f} µs p99 without vision")
        lines += [f"  {'ok  ' if kept else 'FAIL'} {name}" for name, kept in s["kept"].items()]
    camera = summary["camera"]
    lines.append(
        f"camera: {camera['frames']} frames, {camera['refused']} not followed, {camera['p50_ms']:.1f} ms p50, "
        f"{camera['p99_ms']:.1f} ms p99"
    )
    return "\n".join(lines)


@command_line("drift")
def main(argv: list[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    p = command_parser(__doc__)
    p.add_argument("--walks", type=int, default=50, metavar="N", help="walks, each at both levels (default 50)")
    p.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the first walk (default 0)")
    p.add_argument("--distance", type=float, default=23.0, metavar="M", help="length of a walk, m (default 23)")
    p.add_argument("--people", type=int, default=1, metavar="N", help="walking people (default 1)")
    p.add_argument("--scene", default="corridor", metavar="NAME")
    p.add_argument("--jobs", type=int, default=1, metavar="N", help="processes (default 1)")
    args = p.parse_args(argv)
    try:
        if args.walks < 1 or args.jobs < 1 or not RATE_AFTER_M < args.distance <= 500:
            raise ValueError(f"--walks and --jobs must be positive and --distance {RATE_AFTER_M:g}..500")
        check_result_target(args.json)
        load_scene(args.scene)
    except (ValueError, OSError) as error:
        return bad_input("drift", error)
    job = partial(walk_and_replay, scene=args.scene, people=args.people, distance_m=args.distance)
    seeds = range(args.seed, args.seed + args.walks)
    runs: list[DriftRun] = []
    cameras: list[dict[str, float]] = []
    # Spawned, not forked: a physics client does not survive a fork.
    with (
        ProcessPoolExecutor(args.jobs, mp_context=get_context("spawn")) as pool,
        Progress("drift: ", bar=True) as progress,
    ):
        for done, (walked, camera) in enumerate(pool.map(job, seeds), 1):
            runs += walked
            cameras.append(camera)
            progress.show("walks", done, args.walks)
    summary: dict[str, Any] = {level: summarise([run for run in runs if run.level == level]) for level in TESTED}
    summary["camera"] = {
        "frames": sum(camera["frames"] for camera in cameras),
        "refused": sum(camera["refused"] for camera in cameras),
        "p50_ms": float(np.median([camera["p50_ms"] for camera in cameras])),
        "p99_ms": float(np.median([camera["p99_ms"] for camera in cameras])),
    }
    kept = all(all(summary[level]["kept"].values()) for level in TESTED)
    table = _table(summary)
    (sys.stderr if args.json == "-" else sys.stdout).write(table + "\n")
    write_result(
        args.json,
        {"passed": kept, "summary": summary, "settings": vars(args), "sensors": asdict(SensorNoise()),
         "levels": {level: asdict(LEVELS[level]) for level in TESTED}, "runs": [asdict(run) for run in runs]},
    )  # fmt: skip
    return EXIT_DONE if kept else EXIT_CHECK_FAILED


if __name__ == "__main__":
    sys.exit(main())
