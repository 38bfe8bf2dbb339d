"""The begin and the result of a run as JSON values; other tools rely on these keys."""

from __future__ import annotations

import math
import resource
from dataclasses import asdict
from typing import Any

from edge.artifacts.manifest import Artifacts
from edge.core.stats import percentiles
from edge.flightlog.recorder import Recorder
from edge.robot.inputs import RobotInputs
from edge.run.assembly import RunOptions
from edge.run.control_loop import ControlLoop, ControlStatistics
from edge.run.reasoning_loop import ReasoningLoop
from edge.state.switches import Switches
from firmware_bridge.client import BridgeStatus
from firmware_bridge.core.config import RobotConfig


def run_record(artifacts: Artifacts, robot: RobotConfig, options: RunOptions, started_ns: int) -> dict[str, Any]:
    """Record of a run's start in the flight log."""
    delay = options.release_delay
    return {
        "instruction": options.instruction,
        "mode": options.mode.value,
        **options.switches_for(artifacts).as_json(),
        "artifacts": str(artifacts.directory),
        "manifest_sha256": artifacts.manifest_sha256,
        "robot": robot.name,
        "release": artifacts.release,
        "limits": asdict(robot.limits),
        "mount": None if robot.mount is None else asdict(robot.mount),
        "release_delay": {"mean_s": delay.mean_s, "sd_s": delay.sd_s, "seed": delay.seed},
        "started_ns": started_ns,
        "tick_period_ms": artifacts.runtime.tick_period_ms,
    }


def close_log(recorder: Recorder, result: dict[str, Any] | None, *, began: bool, left_s: float) -> str | None:
    """Finish the flight log within `left_s`, add its statistics to the result, return a line on what it lacks."""
    recorder.close(left_s)
    if not began:
        recorder.discard()  # an empty log would mislead
        return None
    dropped = sum(recorder.dropped.values())
    if result is not None:
        result["recorder"] = recorder.statistics()
    if recorder.error is not None:
        return f"the flight log is incomplete: {recorder.error}"
    why = "its disk was nearly full; delete old logs" if recorder.was_paused else "writing was slower than the run"
    return f"the flight log lacks {dropped} records: {why}" if dropped else None


def run_result(
    control: ControlLoop,
    reasoning: ReasoningLoop,
    inputs: RobotInputs,
    status: BridgeStatus | None,
    switches: Switches,
    *,
    power_w: dict[str, Any],
    faults: list[str],
    duration_s: float,
) -> dict[str, Any]:
    """The outcome of a run; `faults` are lines for the operator, each of which ended or invalidated the run."""
    ticks, cycle, times = control.statistics, reasoning.cycle, reasoning.times
    if (fault := plan_fault(ticks)) is not None:
        faults = [*faults, fault]
    return {
        "switches": switches.as_json(),
        "control": {
            "ticks": ticks.ticks,
            "missed": ticks.missed,
            "tick_ms": percentiles(ticks.tick_ms, "p50", "p99", "p999", "max"),
            "unsent": ticks.unsent,
            "plans": ticks.plans,
            "plans_not_finite": ticks.plans_not_finite,
            "reasons": ticks.reasons,
            "faults": ticks.faults,
            "state": control.supervision.state.value,
        },
        "reasoning": {
            "generations": cycle.published,
            "failed": cycle.failed,
            "cancelled": cycle.cancelled,
            "missed_frames": cycle.missed_frames,
            "invalid_texts": cycle.invalid_texts,
            "generation_ms": percentiles(times.generation_ms, "p50", "p99", "max"),
            "anchor_to_ready_ms": percentiles(times.anchor_to_ready_ms, "p50", "p99", "max"),
            "late_anchor_ms": percentiles(times.late_anchor_ms, "p50", "p99", "max"),
            "gave_way_ms": reasoning.gave_way_ns / 1e6,
        },
        "delay_s": percentiles(ticks.delay_s, "p50", "p99", "max"),
        "delay_error_ms": percentiles(ticks.delay_error_ms, "max"),
        "camera": {"frames": inputs.camera.frames, "failures": inputs.camera.failures},
        "odometry": _odometry(inputs),
        "power_w": power_w,
        "bridge": {
            "commands": status.commands if status is not None else None,
            "last_command": list(status.last_command) if status is not None else None,
            "zero_after_stop": status.zero_after_stop if status is not None else False,
        },
        "faults": faults,
        "duration_s": duration_s,
        "peak_rss_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
        "tagged": "measured",
    }


def plan_fault(statistics: ControlStatistics) -> str | None:
    """Return the fault of a run in which no plan was finite, so the robot never moved; None for any other run."""
    if not statistics.plans or statistics.plans_not_finite < statistics.plans:
        return None
    return (
        f"output-not-finite: none of the {statistics.plans} plans was finite, the robot stood throughout; "
        "verify the artifacts: edge-export verify DIR"
    )


def _odometry(inputs: RobotInputs) -> dict[str, Any]:
    estimator, newest = inputs.estimator, inputs.odometry
    drift = None if newest is None else newest.drift
    rad_per_m = None if drift is None else drift.rad_per_m
    return {
        "reports": inputs.states,
        "rejected": estimator.rejected,
        "visual_used": estimator.visual_used,
        "visual_rejected": estimator.visual_rejected,
        "drift_m_per_m": None if drift is None else drift.m_per_m,
        "drift_deg_per_m": None if rad_per_m is None else math.degrees(rad_per_m),
        "driven_m": 0.0 if drift is None else drift.distance_m,
    }
