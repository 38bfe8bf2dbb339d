"""Analysis of a leg's files: timing, power and worst moments from the flight logs, ground truth from the trace.

All stamps are monotonic ns of one machine, so the runner's ticks and the ground truth share one time axis. The analysis
also works for a killed leg; incomplete lines are ignored.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import hypot
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, UnidentifiedImageError

from edge.core.cli import write_whole
from edge.core.geometry import SE2
from edge.flightlog.reader import RecordingError, jpeg_bytes, read_messages
from firmware_bridge.system.input_file import read_json
from sim_hil.realtime.host_stall import read_stalls
from sim_hil.realtime.stack import STALLS
from sim_hil.realtime.truth import read_lines
from sim_hil.soak.leg import EVENTS, LEG, SAMPLES

Array = NDArray[np.float64]

ANALYSIS: Final = "analysis.json"
TRACE: Final = "trace.jsonl"
SEGMENT_S: Final = 10.0
"""Duration of a drift segment, s; the robot must have moved by SEGMENT_M in it."""
SEGMENT_M: Final = 0.5
ODOMETRY_HZ: Final = 2.0
"""Rate at which the flight log's odometry is kept, Hz."""
_REPEAT_NS: Final = 20_000_000
_STOP_REQUEST: Final = "StopMove"
"""The request that stops a Unitree robot; the bridge then waits for the robot before it commands again."""


@dataclass
class LifeData:
    """Numbers from the flight log of one runner process."""

    run: int
    ticks: int = 0
    missed: int = 0
    tick_ns: list[int] = field(default_factory=list)
    tick_ms: list[float] = field(default_factory=list)
    delay_s: list[float | None] = field(default_factory=list)
    frame_age_ms: list[float | None] = field(default_factory=list)
    reasons: dict[str, int] = field(default_factory=dict)
    generation_ms: list[float] = field(default_factory=list)
    ready_ns: list[int] = field(default_factory=list)
    raised: list[tuple[int, str]] = field(default_factory=list)
    power: list[tuple[int, float, str]] = field(default_factory=list)
    battery: list[tuple[int, float | None]] = field(default_factory=list)
    odometry: list[tuple[int, float, float, float]] = field(default_factory=list)
    delay_error_ms_max: float | None = None
    dropped: int = 0


def read_life(path: Path, result: Path, run: int) -> LifeData | None:
    """Read one runner's flight log and result; None if it never drove (no log)."""
    life = LifeData(run)
    period_ns, deadline_ns, kept_ns = 100_000_000, None, 0
    try:
        for topic, stamp_ns, record in read_messages(path):
            if topic == "/run":
                period_ns = round(record["tick_period_ms"] * 1e6)
            elif topic == "/tick":
                at_ns = record["start_ns"] - round(record["late_ms"] * 1e6)
                if deadline_ns is not None:
                    life.missed += max(0, round((at_ns - deadline_ns) / period_ns) - 1)
                deadline_ns = at_ns
                life.ticks += 1
                life.tick_ns.append(record["start_ns"])
                life.tick_ms.append(round(record["late_ms"] + record["duration_ms"], 3))
                life.delay_s.append(_rounded(record["delay_s"]))
                life.frame_age_ms.append(_rounded(record["frame_age_ms"]))
                life.reasons[record["reason"]] = life.reasons.get(record["reason"], 0) + 1
            elif topic == "/semantic":
                life.generation_ms.append(round((record["finished_ns"] - record["started_ns"]) / 1e6, 2))
                life.ready_ns.append(record["ready_ns"])
            elif topic == "/fault" and record["change"] == "raised":
                life.raised.append((stamp_ns, record["name"]))
            elif topic == "/power" and record["total_w"] is not None:
                life.power.append((stamp_ns, record["total_w"], record["tagged"]))
            elif topic == "/battery":
                life.battery.append((stamp_ns, record["soc_percent"]))
            elif topic == "/odometry" and record["pose"] is not None and stamp_ns - kept_ns >= 1e9 / ODOMETRY_HZ:
                kept_ns = stamp_ns
                life.odometry.append((stamp_ns, *record["pose"]))
    except (OSError, RecordingError):
        return None
    try:
        content = read_json(result)
        life.delay_error_ms_max = content["delay_error_ms"]["max"]
        life.dropped = sum(content.get("recorder", {}).get("dropped", {}).values())
    except (OSError, ValueError, KeyError, AttributeError):
        pass  # the runner was killed before it wrote a result
    return life


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 4)


@dataclass(frozen=True)
class TraceData:
    """Ground truth of a leg: pose_ns [n], pose [n, 3] (m, m, rad); gaps between the bridge's commands, ms."""

    pose_ns: NDArray[np.int64]
    pose: Array
    command_gap_ms: Array
    command_ns: NDArray[np.int64]
    people_gap_m: list[tuple[int, float]]
    contacts: list[tuple[int, str]]
    """Start of each contact, ns, and the label of the touched object."""
    end: dict[str, Any]


def read_trace(path: Path, begins_ns: Sequence[int] = ()) -> TraceData:
    """Read a leg's trace; empty if the robot's side never started. Raises OSError.

    `begins_ns`: starts of the runners, each with a new bridge; the time between two bridges is no gap.
    """
    stamps: list[int] = []
    poses: list[tuple[float, float, float]] = []
    sent: list[int] = []
    stops: list[bool] = []
    near: list[tuple[int, float]] = []
    contacts: list[tuple[int, str]] = []
    touched: set[str] = set()
    end: dict[str, Any] = {}
    for line in read_lines(path) if path.exists() else ():
        kind = line.get("kind")
        if kind == "pose":
            stamps.append(line["t_ns"])
            poses.append((line["x"], line["y"], line["theta"]))
            contacts += [(line["t_ns"], label) for label in line["touching"] if label not in touched]
            touched = set(line["touching"])
        elif kind == "wire" and line["velocity"] is not None:
            # The bridge's own send time where the protocol has one; the receive time includes the simulator's delays.
            sent.append(int(line["request_id"] or line["t_ns"]))
            stops.append(line["name"] == _STOP_REQUEST)
        elif kind == "people" and poses and line["poses"]:
            x, y = poses[-1][:2]
            near.append((line["t_ns"], min(hypot(p[0] - x, p[1] - y) for p in line["poses"])))
        elif kind == "end":
            end = line
    at = np.array(sent, np.int64)
    gaps = np.diff(at)
    restarted = np.diff(np.searchsorted(np.sort(np.array(begins_ns, np.int64)), at)) > 0
    kept = (gaps > _REPEAT_NS / 4) & ~restarted & ~np.array(stops[:-1], bool)
    return TraceData(
        np.array(stamps, np.int64),
        np.array(poses, float).reshape(-1, 3),
        gaps[kept] / 1e6,
        at[1:][kept] if len(at) else at,
        near,
        contacts,
        end,
    )


def drift_segments(
    odometry: list[tuple[int, float, float, float]], trace: TraceData, disturbed: list[tuple[int, int]]
) -> list[tuple[float, float]]:
    """Return (position error m, true path m) of consecutive segments of one runner life, each starting without error.

    Segments that overlap `disturbed` (spans in ns in which a fault falsified odometry) are left out.
    """
    if len(odometry) < 2 or len(trace.pose_ns) < 2:
        return []
    times = np.array([row[0] for row in odometry], np.int64)
    found: list[tuple[float, float]] = []
    first = 0
    theta = np.unwrap(trace.pose[:, 2])
    for last in range(1, len(times)):
        if (times[last] - times[first]) / 1e9 < SEGMENT_S:
            continue
        a_ns, b_ns = int(times[first]), int(times[last])
        path_m = _path_m(trace, a_ns, b_ns)
        hit = any(begin <= b_ns and end >= a_ns for begin, end in disturbed)
        if path_m >= SEGMENT_M and not hit:
            truth = [
                SE2(*(float(np.interp(t, trace.pose_ns, column)) for column in (*trace.pose[:, :2].T, theta)))
                for t in (a_ns, b_ns)
            ]
            moved = SE2(*odometry[first][1:]).inverse() @ SE2(*odometry[last][1:])
            moved_truly = truth[0].inverse() @ truth[1]
            found.append((hypot(moved.x_m - moved_truly.x_m, moved.y_m - moved_truly.y_m), path_m))
        first = last
    return found


def disturbed_spans(events: list[dict[str, Any]]) -> list[tuple[int, int]]:
    """Return the spans (ns) in which a fault falsified or delayed the robot's state."""
    spans: list[tuple[int, int]] = []
    begun: int | None = None
    for event in events:
        if event["kind"] == "fault_on" and str(event["inject"]).startswith(("odometry", "state", "tip", "wrong")):
            begun = event["t_ns"]
        elif event["kind"] == "fault_off" and begun is not None:
            spans.append((begun, event["t_ns"] + 1_000_000_000))
            begun = None
    return spans


def faults_of(events: list[dict[str, Any]], lives: list[LifeData], trace: TraceData) -> list[dict[str, Any]]:
    """Return each injection with its effect time, the expected fault, and the faults that the runner raised.

    `moved_m`: true path during the fault; for a standing robot, a frozen image cannot be detected.
    """
    raised = sorted(entry for life in lives for entry in life.raised)
    found: dict[int, dict[str, Any]] = {}
    for event in events:
        if event["kind"] == "fault_on":
            row = {key: event[key] for key in ("number", "name", "fault", "expect", "t_ns")}
            nothing = {"end_ns": None, "effect_ns": None, "raised_ns": None, "other_ns": None, "moved_m": 0.0}
            found[event["number"]] = {**row, **nothing}
        elif event["kind"] == "fault_effect" and event["number"] in found:
            found[event["number"]]["effect_ns"] = event["effect_ns"]
        elif event["kind"] == "fault_off" and event["number"] in found:
            found[event["number"]]["end_ns"] = event["t_ns"]
    for row in found.values():
        until_ns = (row["end_ns"] or row["t_ns"]) + 2_000_000_000
        answers = [t for t, name in raised if name == row["fault"] and row["t_ns"] <= t <= until_ns]
        row["raised_ns"] = answers[0] if answers else None
        row["other_ns"] = next((t for t, _ in raised if row["t_ns"] <= t <= until_ns), None)
        row["moved_m"] = round(_path_m(trace, row["t_ns"], row["end_ns"] or row["t_ns"]), 3)
    return list(found.values())


def _path_m(trace: TraceData, begin_ns: int, end_ns: int) -> float:
    inside = (trace.pose_ns >= begin_ns) & (trace.pose_ns <= end_ns)
    steps = np.diff(trace.pose[inside][:, :2], axis=0)
    return float(np.hypot(steps[:, 0], steps[:, 1]).sum())


def analyse(folder: Path) -> dict[str, Any]:
    """Analyse a leg's folder for the report, write the analysis as JSON and return it. Raises OSError."""
    about = read_json(folder / LEG)
    events = list(read_lines(folder / EVENTS))
    samples = list(read_lines(folder / SAMPLES))
    trace = read_trace(folder / TRACE, [event["t_ns"] for event in events if event["kind"] == "life_begin"])
    runs = sorted(event["run"] for event in events if event["kind"] == "armed")
    read = (read_life(folder / f"flight-{run}.mcap", folder / f"edge-run-{run}.json", run) for run in runs)
    lives = [life for life in read if life is not None]
    disturbed = disturbed_spans(events)
    drift = [segment for life in lives for segment in drift_segments(life.odometry, trace, disturbed)]
    stalls = read_stalls(folder / STALLS)
    analysis = {
        "leg": about,
        "begin_ns": events[0]["t_ns"] if events else 0,
        "elapsed_s": samples[-1]["elapsed_s"] if samples else 0.0,
        "tasks": [event for event in events if event["kind"] == "task_end"],
        "task_begins": [event for event in events if event["kind"] == "task_begin"],
        "life_ends": [event for event in events if event["kind"] == "life_end"],
        "why": next((event["why"] for event in events if event["kind"] == "leg_end"), "killed"),
        "faults": faults_of(events, lives, trace),
        "lives": [life.__dict__ for life in lives],
        "drift": drift,
        "real_time_factor": trace.end.get("real_time_factor"),
        "fell": trace.end.get("fell", False),
        "command_gap_ms": [round(float(gap), 4) for gap in trace.command_gap_ms],
        "command_ns": [int(t) for t in trace.command_ns],
        "stalls": None if stalls is None else stalls.tolist(),
        "truth": [
            [int(t), *(round(float(v), 3) for v in pose)]
            for t, pose in zip(trace.pose_ns[::5], trace.pose[::5], strict=True)
        ],
        "nearest_person": _nearest(trace),
        "contacts": trace.contacts,
    }
    write_whole(folder / ANALYSIS, json.dumps(analysis) + "\n")
    return analysis


def _nearest(trace: TraceData) -> list[float] | None:
    if not trace.people_gap_m:
        return None
    t_ns, gap_m = min(trace.people_gap_m, key=lambda entry: entry[1])
    return [t_ns, round(gap_m, 3)]


MOMENTS: Final = "moments.json"
BEFORE_S: Final = 5.0
AFTER_S: Final = 0.5
FPS: Final = 5
_SIZE: Final = (320, 180)
_COLOURS: Final = 96
_BAR_PX: Final = 16


@dataclass(frozen=True)
class Moment:
    """A remarkable moment; a higher `rank` is worse among moments of one kind."""

    kind: str
    t_ns: int
    rank: float
    what: str
    gif: str = ""


def worst(analysis: Mapping[str, Any]) -> list[Moment]:
    """Return the worst tick, stop, collision and near miss of a leg, if any."""
    found: list[Moment] = []
    ticks = [
        (ms, t_ns) for life in analysis["lives"] for t_ns, ms in zip(life["tick_ns"], life["tick_ms"], strict=True)
    ]
    if ticks:
        ms, t_ns = max(ticks)
        found.append(Moment("worst tick", t_ns, ms, f"{ms:.1f} ms from its deadline to its command"))
    stops = [end for end in analysis["life_ends"] if end["cause"] != "leg"]
    if stops:
        # Unexplained stops rank first, then those after a contact, then those after an injected fault.
        rank = {"": 2.0, "contact": 1.0}
        end = max(stops, key=lambda end: rank.get(end["explained"], 0.0))
        why = end["cause"] or f"ended with code {end['code']}"
        found.append(Moment("worst stop", end["t_ns"], rank.get(end["explained"], 0.0), why))
    contacts = sorted(analysis["contacts"], key=lambda contact: (contact[1] != "person", contact[0]))
    if contacts:
        t_ns, label = contacts[0]
        found.append(Moment("collision", t_ns, 1.0 if label == "person" else 0.0, f"touched {label}"))
    if analysis["nearest_person"] is not None:
        t_ns, gap_m = analysis["nearest_person"]
        found.append(Moment("nearest person", t_ns, -gap_m, f"{gap_m:.2f} m from a person's centre"))
    return found


def keep_moments(folder: Path, analysis: Mapping[str, object]) -> None:
    """Write the animations of the worst moments into the leg's folder. Raises OSError."""
    kept, moments = [], worst(analysis)
    for moment, frames in zip(moments, _frames(folder, [moment.t_ns for moment in moments]), strict=True):
        name = f"{moment.kind.replace(' ', '-')}.gif"
        if frames:
            _write(folder / name, frames, moment)
        kept.append({**moment.__dict__, "gif": name if frames else ""})
    write_whole(folder / MOMENTS, json.dumps(kept, indent=1) + "\n")


def read_moments(folder: Path) -> list[Moment]:
    """Read the moments written by `keep_moments`; empty if the leg was killed before."""
    try:
        return [Moment(**row) for row in read_json(folder / MOMENTS)]
    except (OSError, ValueError, TypeError):
        return []


def _frames(folder: Path, moments_ns: Sequence[int]) -> list[list[tuple[float, bytes]]]:
    """Return (time relative to the moment s, JPEG) of the images around each moment, from the leg's flight logs."""
    found: list[list[tuple[float, bytes]]] = [[] for _ in moments_ns]
    # The first part of each log: its other parts are read with it, hundreds of megabytes of a leg.
    for log in sorted(path for path in folder.glob("flight-*.mcap") if "." not in path.stem):
        try:
            for topic, stamp_ns, payload in read_messages(log):
                for t_ns, frames in zip(moments_ns, found, strict=True):
                    at_s = (stamp_ns - t_ns) / 1e9
                    if topic == "/camera" and -BEFORE_S <= at_s <= AFTER_S:
                        frames.append((at_s, jpeg_bytes(payload)))
        except (OSError, RecordingError, ValueError):
            continue  # the runner was killed before it wrote data
    return [_thinned(frames) for frames in found]


def _thinned(frames: list[tuple[float, bytes]]) -> list[tuple[float, bytes]]:
    kept: list[tuple[float, bytes]] = []
    for at_s, jpeg in sorted(frames, key=lambda frame: frame[0]):
        if not kept or at_s - kept[-1][0] >= 0.9 / FPS:
            kept.append((at_s, jpeg))
    return kept


def _write(path: Path, frames: list[tuple[float, bytes]], moment: Moment) -> None:
    pictures = []
    for at_s, jpeg in frames:
        try:
            eye = Image.open(io.BytesIO(jpeg)).convert("RGB").resize(_SIZE)
        except (UnidentifiedImageError, OSError):
            continue  # an invalid image, caused by an injected fault
        picture = Image.new("RGB", (_SIZE[0], _SIZE[1] + _BAR_PX), (250, 250, 248))
        picture.paste(eye, (0, _BAR_PX))
        line = f"{moment.kind}  {at_s:+.1f} s"
        ImageDraw.Draw(picture).text((4, 2), line, fill=(179, 38, 30) if at_s >= 0 else (29, 39, 51))
        pictures.append(picture.quantize(_COLOURS))
    if pictures:
        period_ms = round(1000 / FPS)
        durations = [period_ms] * (len(pictures) - 1) + [1500]
        pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=durations, loop=0)
