"""Table of numbers of the report: quantity, value, source file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from reporting.plot_style import percentile
from tools.report.checks import goal_distance_m, moved_under_command_m
from tools.report.command_latency import command_latencies_ms
from tools.report.run_data import Record, RunData, odometry_in_world, truth_at

RUNNER = "edge-run, its own clock"
LOG = "flight log"
TRUTH = "edge-hil, ground truth"
WIRE = "edge-hil, requests received"


@dataclass(frozen=True)
class Number:
    """Row of the table; `kind` is `measured` for a result of this run, `setting` for an option."""

    title: str
    value: str
    source: str
    kind: Literal["measured", "setting"] = "measured"


def headline(data: RunData) -> list[tuple[str, str]]:
    """Return the numbers at the top as (value, name)."""
    run = data.results["edge-run"]
    control, reasoning, delay_s = run["control"], run["reasoning"], run["delay_s"]
    return [
        (f"{control['ticks']}", f"control ticks in {data.duration_s:.0f} s"),
        (f"{control['tick_ms']['p99']:.1f} ms", "control tick, p99 (deadline 100 ms)"),
        (f"{reasoning['generations']}", "VLM generations"),
        (f"{_value(delay_s['p50'])} s", "Δt of the action expert, p50"),
        (f"{moved_under_command_m(data.trace):.2f} m", "driven under command (ground truth)"),
        (f"{goal_distance_m(data):.2f} m", "from the goal at the end"),
    ]


def odometry_error_m(data: RunData) -> float | None:
    """Return the distance between odometry (aligned at the first tick) and ground truth at the last tick, m."""
    stamps_ns, odometry = odometry_in_world(data)
    if not len(stamps_ns):
        return None
    return float(np.linalg.norm(odometry[-1, :2] - truth_at(data.trace, stamps_ns[-1:])[0, :2]))


def command_latency_ms(data: RunData) -> Record:
    """Return n, p50, p99 and max of the time from a sent command to its arrival at the robot, ms."""
    growth = data.settings.get("bridge_growth", (0.0, 0.0, 0.0))
    found = np.array(command_latencies_ms(data.log.ticks, data.trace.wire, growth))
    if not len(found):
        return {"n": 0, "p50": None, "p99": None, "max": None}
    figures = {"p50": percentile(found, 50), "p99": percentile(found, 99), "max": float(found.max())}
    return {"n": len(found), **{name: round(value, 3) for name, value in figures.items()}}


def numbers(data: RunData, wall_s: float) -> list[Number]:
    """Return all rows in reading order."""
    return [*_control(data), *_reasoning(data), *_robot(data), *_machine(data, wall_s)]


def _control(data: RunData) -> list[Number]:
    control, ticks = data.results["edge-run"]["control"], data.log.ticks
    tick_ms = control["tick_ms"]
    return [
        Number("control ticks", f"{control['ticks']}", RUNNER),
        Number("control ticks missed", f"{control['missed']}", RUNNER),
        Number(
            "control tick p50 / p99 / p99.9 / max",
            f"{tick_ms['p50']:.1f} / {tick_ms['p99']:.1f} / {tick_ms['p999']:.1f} / {tick_ms['max']:.1f} ms",
            RUNNER,
        ),
        Number("of which vision encoder, p50", _median(ticks, "encode_ms", "ms"), LOG),
        Number("of which action expert, p50", _median(ticks, "act_ms", "ms"), LOG),
        Number("tick started late, p99 / max", _p99_max(ticks, "late_ms", "ms"), LOG),
        Number("camera frame age when used, p50", _median(ticks, "frame_age_ms", "ms"), LOG),
        Number("ticks by reason", _reasons(ticks), LOG),
    ]


def _reasoning(data: RunData) -> list[Number]:
    run, semantics = data.results["edge-run"], data.log.semantics
    reasoning, delay_s = run["reasoning"], run["delay_s"]
    generation_ms = reasoning["generation_ms"]
    return [
        Number("VLM generations", f"{reasoning['generations']}", RUNNER),
        Number("VLM generations failed", f"{reasoning['failed']}", RUNNER),
        Number(
            "generation p50 / p99 / max (without the release delay)",
            " / ".join(_value(generation_ms[key], 0) for key in ("p50", "p99", "max")) + " ms",
            RUNNER,
        ),
        Number("of which prefill, p50", _median(semantics, "prefill_ms", "ms"), LOG),
        Number("of which decoding, p50", _median(semantics, "decode_ms", "ms"), LOG),
        Number("of which semantic context, p50", _median(semantics, "context_ms", "ms"), LOG),
        Number("prompt tokens / new tokens, p50", _token_counts(semantics), LOG),
        Number("requested release delay", _release_delay(data), LOG, "setting"),
        Number("applied release delay, p50", _median(semantics, "release_delay_s", "s", 2), LOG),
        Number("Δt p50 / p99 / max", " / ".join(_value(delay_s[key]) for key in ("p50", "p99", "max")) + " s", RUNNER),
        delay_at_call(data),
        Number("texts with readable waypoints", f"{sum(1 for s in semantics if s['waypoints'])}", LOG),
    ]


def delay_at_call(data: RunData) -> Number:
    """Return the error of Δt at the action expert's call, which is later than the clock reading.

    A busy machine may preempt the control thread in between. The acceptance check instead compares the recorded Δt with
    the recorded clock.
    """
    worst_ms = data.results["edge-run"]["delay_error_ms"]["max"]
    value = "none" if worst_ms is None else f"{worst_ms:.2f} ms"
    return Number("Δt given to the action expert against the instant of its call, worst tick", value, RUNNER)


def _robot(data: RunData) -> list[Number]:
    hil, bridge = data.results["edge-hil"], data.results["edge-bridge"]
    error_m = odometry_error_m(data)
    collisions = ", ".join(map(str, hil["collisions"])) or "none"
    return [
        Number("path driven while commanded", f"{moved_under_command_m(data.trace):.2f} m", TRUTH),
        Number("distance to the goal at the end", f"{goal_distance_m(data):.2f} m", TRUTH),
        Number("odometry error at the last tick", "no odometry" if error_m is None else f"{error_m:.2f} m", TRUTH),
        Number("touched", collisions, TRUTH),
        Number("fell", "yes" if hil["fell"] else "no", TRUTH),
        Number("velocity commands written by the bridge", f"{bridge['commands']}", "edge-bridge"),
        Number("motion requests received by the robot", f"{hil['wire']['commands']}", WIRE),
        Number("command sent until received by the robot, p50 / p99 / max", _latency(data), f"{LOG} and {WIRE}"),
        Number("camera pictures served", f"{hil['video_frames']}", WIRE),
        Number("simulated time per real time", f"{hil['real_time_factor']:.3f}", TRUTH),
    ]


def _machine(data: RunData, wall_s: float) -> list[Number]:
    run = data.results["edge-run"]
    rows = [Number("runner's peak memory", f"{run['peak_rss_bytes'] / 2**20:.0f} MiB", "edge-run, getrusage")]
    if wall_s > 0:
        rows.append(Number("whole demo, wall time", f"{wall_s:.0f} s", "demo"))
    return rows


def _latency(data: RunData) -> str:
    found = command_latency_ms(data)
    if not found["n"]:
        return "no command that can be matched"
    return f"{found['p50']:.1f} / {found['p99']:.1f} / {found['max']:.1f} ms ({found['n']} commands)"


def _value(value: float | None, digits: int = 2) -> str:
    return "none" if value is None else f"{value:.{digits}f}"


def _column(records: Sequence[Record], key: str) -> list[float]:
    return [record[key] for record in records if record.get(key) is not None]


def _median(records: Sequence[Record], key: str, unit: str, digits: int = 1) -> str:
    column = _column(records, key)
    return f"{np.median(column):.{digits}f} {unit}" if column else "none"


def _p99_max(records: Sequence[Record], key: str, unit: str) -> str:
    column = _column(records, key)
    return f"{percentile(np.array(column), 99):.1f} / {max(column):.1f} {unit}" if column else "none"


def _release_delay(data: RunData) -> str:
    asked = data.log.run.get("release_delay")
    if not isinstance(asked, dict):
        return "not recorded"
    return f"mean {asked['mean_s']:g} s, sd {asked['sd_s']:g} s"


def _reasons(ticks: Sequence[Record]) -> str:
    names, counts = np.unique([tick["reason"] for tick in ticks], return_counts=True)
    return ", ".join(f"{name} {count}" for name, count in zip(names, counts, strict=True))


def _token_counts(semantics: Sequence[Record]) -> str:
    prompt, new = _column(semantics, "prompt_tokens"), _column(semantics, "new_tokens")
    return f"{np.median(prompt):.0f} / {np.median(new):.0f}" if prompt and new else "none"
