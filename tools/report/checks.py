"""The demo's acceptance checks, recomputed from the flight log and the robot's own trace, not copied from results.

Each function checks one property; `acceptance` lists them all. Limits that depend on time are scaled from the
60 s demo to the run's duration; the path's only downwards, since a longer run may well have reached its goal.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

import numpy as np

from reporting.plot_style import percentile
from tools.report.run_data import FlightLog, Record, RunData, Trace

DELTA_T_TOLERANCE_MS = 1.0
TICKS_PER_60_S = 590
GENERATIONS_PER_60_S = 10
TICK_P99_LIMIT_MS = 100.0
MOVED_PER_60_S_M = 1.0
REACHED_M = 1.5
"""Of the goal, as in the benchmark's episodes indoors."""
REACHABLE_S = 60.0
"""In a shorter run the goal cannot be reached."""

# A tick reads the generation, then the clock: one that was published in between may have come too late for it.
SWAP_RACE_NS = 10_000_000


@dataclass(frozen=True)
class Check:
    """One acceptance check: `value` against `limit` (text such as "≥ 590" is in `rule`)."""

    name: str
    title: str
    value: float | int | bool | None
    limit: float | int | bool
    rule: str
    unit: str
    passed: bool
    note: str = ""

    def as_json(self) -> Record:
        """Return the check's entry of demo.json."""
        return {"value": self.value, "limit": self.limit, "pass": self.passed, "note": self.note}


def _at_least(name: str, title: str, value: float | int, limit: float | int, unit: str = "", note: str = "") -> Check:
    return Check(name, title, value, limit, "≥", unit, value >= limit, note)


def _at_most(
    name: str, title: str, value: float | int | None, limit: float | int, unit: str = "", note: str = ""
) -> Check:
    return Check(name, title, value, limit, "≤", unit, value is not None and value <= limit, note)


def delay_errors_ms(log: FlightLog) -> tuple[list[float], list[str]]:
    """Compute |recorded Δt − (now − stamp of the anchor frame)| per tick with a semantic state, ms, and problems.

    The capture stamp is the log time of the camera frame the generation names as its newest, not the anchor the
    runner subtracted; a frame or generation that is not in the log is a problem, since nothing can be shown then, and
    so is a `now` outside the tick it belongs to.
    """
    newest_frame_ns = {s["generation"]: s["frames_ns"][-1] for s in log.semantics if s["frames_ns"]}
    errors_ms: list[float] = []
    problems: list[str] = []
    for tick in log.ticks:
        if tick["generation"] is None:
            continue
        anchor_ns = newest_frame_ns.get(tick["generation"])
        if anchor_ns is None:
            problems.append(f"tick {tick['tick']}: generation {tick['generation']} is not in the log")
        elif anchor_ns not in log.frame_stamps_ns:
            problems.append(f"tick {tick['tick']}: anchor frame {anchor_ns} is not in the log")
        elif tick["delay_s"] is None:
            problems.append(f"tick {tick['tick']}: uses a generation but records no Δt")
        elif not 0 <= tick["now_ns"] - tick["start_ns"] <= tick["duration_ms"] * 1e6:
            problems.append(f"tick {tick['tick']}: its now lies outside the tick")
        else:
            errors_ms.append(abs(tick["delay_s"] * 1e3 - (tick["now_ns"] - anchor_ns) / 1e6))
    return errors_ms, problems


def stale_generation_ticks(log: FlightLog) -> int:
    """Count ticks that used a generation before its release, or an older one or none after a newer was released."""
    ready_ns = [s["ready_ns"] for s in log.semantics]
    published_ns = [s.get("published_ns", s["ready_ns"]) for s in log.semantics]  # older logs have no such stamp
    index_of = {s["generation"]: index for index, s in enumerate(log.semantics)}
    wrong = 0
    for tick in log.ticks:
        used = -1 if tick["generation"] is None else index_of.get(tick["generation"], -2)
        newest = bisect_right(ready_ns, tick["now_ns"]) - 1
        surely_published = bisect_right(published_ns, tick["now_ns"] - SWAP_RACE_NS) - 1
        if not surely_published <= used <= newest:
            wrong += 1
    return wrong


def motion_without_semantic_state(log: FlightLog) -> int:
    """Count ticks that commanded motion before the first generation was released."""
    return sum(1 for tick in log.ticks if tick["generation"] is None and any(tick["command"]))


def moved_under_command_m(trace: Trace) -> float:
    """Return the ground-truth path length, in 1 s steps, over the seconds with a non-zero velocity on the wire, m.

    Steps of 1 s keep the body's sway while trotting in place out of the sum.
    """
    moving_ns = np.array([w["t_ns"] for w in trace.wire if w["velocity"] is not None and any(w["velocity"])], np.int64)
    total_m = 0.0
    edges_ns = np.arange(trace.pose_ns[0], trace.pose_ns[-1] + 1, 1_000_000_000)
    index = np.searchsorted(trace.pose_ns, edges_ns)
    for step in range(len(edges_ns) - 1):
        if np.any((moving_ns >= edges_ns[step]) & (moving_ns < edges_ns[step + 1])):
            total_m += float(np.linalg.norm(trace.pose[index[step + 1], :2] - trace.pose[index[step], :2]))
    return total_m


def last_motion_command(trace: Trace) -> tuple[str, bool]:
    """Return the name of the last motion request on the wire and whether it requests zero velocity."""
    for request in reversed(trace.wire):
        if request["velocity"] is not None:
            return request["name"], not any(request["velocity"])
    return "none", False


def acceptance(data: RunData) -> list[Check]:
    """Run all acceptance checks of the demo, in the order of the report."""
    log, scale = data.log, data.duration_s / 60.0
    moved_m, moved_limit_m = moved_under_command_m(data.trace), MOVED_PER_60_S_M * min(1.0, scale)
    control, reasoning = data.results["edge-run"]["control"], data.results["edge-run"]["reasoning"]
    errors_ms, problems = delay_errors_ms(log)
    command, is_zero = last_motion_command(data.trace)
    says_zero = bool(data.trace.end.get("wire", {}).get("last_command_zero", False))
    faults = data.results["edge-run"]["faults"]
    return [
        _at_most("faults", "Faults that ended the run", len(faults), 0, note="; ".join(map(str, faults))),
        _at_least("control_ticks", "Control ticks", control["ticks"], max(1, int(TICKS_PER_60_S * scale))),
        _at_most(
            "ticks_missing_in_log",
            "Control ticks that the flight log lacks",
            abs(control["ticks"] - len(log.ticks)),
            0,
        ),
        _at_most(
            "tick_p99_ms",
            "Control tick, deadline to command sent, 99th percentile",
            round(percentile(log.tick_ms, 99), 3),
            TICK_P99_LIMIT_MS,
            "ms",
        ),
        _at_least(
            "generations",
            "VLM generations",
            reasoning["generations"],
            max(1, int(GENERATIONS_PER_60_S * scale)),
        ),
        Check(
            "delay_error_ms",
            "Δt against the capture stamp of the camera frame, worst tick",
            round(max(errors_ms), 6) if errors_ms else None,
            DELTA_T_TOLERANCE_MS,
            "≤",
            "ms",
            bool(errors_ms) and not problems and max(errors_ms) <= DELTA_T_TOLERANCE_MS,
            f"{len(problems)} ticks cannot be checked; first: {problems[0]}" if problems else f"{len(errors_ms)} ticks",
        ),
        _at_most(
            "stale_generation_ticks",
            "Ticks that did not use the newest released generation",
            stale_generation_ticks(log),
            0,
        ),
        _at_most(
            "motion_before_first_generation",
            "Ticks that commanded motion before the first generation",
            motion_without_semantic_state(log),
            0,
        ),
        Check(
            "moved_under_command_m",
            "Ground-truth path while commanded",
            round(moved_m, 3),
            moved_limit_m,
            ">",
            "m",
            moved_m > moved_limit_m,
        ),
        Check(
            "last_command_zero",
            "Last motion command on the wire is zero velocity",
            is_zero and says_zero,
            True,
            "=",
            "",
            is_zero and says_zero,
            f"last: {command}",
        ),
        *_reached(data),
    ]


def goal_distance_m(data: RunData) -> float:
    """Return the distance to the goal at the last ground-truth pose, m."""
    return float(np.linalg.norm(data.trace.pose[-1, :2] - np.asarray(data.trace.scene["goal"], float)))


def nearest_to_goal_m(data: RunData) -> float:
    """Return the smallest distance to the goal over all ground-truth poses, m (the paper's criterion)."""
    gaps = np.linalg.norm(data.trace.pose[:, :2] - np.asarray(data.trace.scene["goal"], float), axis=1)
    return float(gaps.min())


def _reached(data: RunData) -> list[Check]:
    """Check that the robot reached its goal, for trained weights and a long enough run."""
    model = data.manifest.get("model", {})
    if not isinstance(model, dict) or model.get("trained") is not True or data.duration_s < REACHABLE_S:
        return []
    nearest_m, note = round(nearest_to_goal_m(data), 3), f"{goal_distance_m(data):.2f} m from it at the end"
    return [_at_most("goal_nearest_m", "Nearest that it came to the goal", nearest_m, REACHED_M, "m", note)]
