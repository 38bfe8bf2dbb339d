"""Data of one run for its report: flight log, ground-truth trace and results of the commands.

All stamps are monotonic ns of one machine, so the runner's ticks and the simulated robot's truth share one axis.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge.flightlog.reader import RecordingError, jpeg_bytes, read_messages
from firmware_bridge.system.input_file import read_json

Record = dict[str, Any]
Array = NDArray[np.float64]


MISSHAPEN = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError)
"""Exceptions of reading a record with a missing or malformed field (including numpy's)."""


class ReportError(ValueError):
    """Missing or invalid file of the run; its text is one line."""


@dataclass(frozen=True)
class FlightLog:
    """The runner's record; `frame_stamps_ns` are the log times of all recorded camera frames."""

    path: Path
    run: Record
    ticks: list[Record]
    semantics: list[Record]
    frame_stamps_ns: frozenset[int]

    @property
    def tick_ms(self) -> Array:
        """[ticks] time from each tick's deadline to its sent command, ms; includes a late wake-up."""
        return np.array([tick["late_ms"] + tick["duration_ms"] for tick in self.ticks], float)

    @property
    def start_ns(self) -> int:
        """Zero of all time axes: the start of the first tick."""
        return int(self.ticks[0]["start_ns"])


@dataclass(frozen=True)
class Trace:
    """Record of the simulated robot's side: ground truth and received requests."""

    scene: Record
    pose_ns: NDArray[np.int64]
    """[n] stamps of the ground-truth poses."""
    pose: Array
    """[n, 3] x, y (m), theta (rad, unwrapped) in the world frame."""
    velocity: Array
    """[n, 3] forward and leftward speed in the body frame (m/s) and yaw rate (rad/s)."""
    people: list[Array]
    """One [people, 3] array of x, y (m), heading (rad) per record."""
    people_ns: NDArray[np.int64]
    """[n] stamps of those records."""
    wire: list[Record]
    end: Record


@dataclass(frozen=True)
class RunData:
    """Complete data of a run; `settings`: its options, `results`: JSON result by command name."""

    settings: Record
    log: FlightLog
    trace: Trace
    results: dict[str, Record]
    manifest: Record

    @property
    def duration_s(self) -> float:
        """Requested driving time, s; the actual one would lower the limits of a runner that ended early."""
        return float(self.settings["duration_s"])


def load_json(path: Path) -> Record:
    """Read a JSON object from a file. Raises ReportError that names the file."""
    try:
        value = read_json(path)
    except FileNotFoundError:
        raise ReportError(f"{path} is missing; expected the JSON result of the run") from None
    except (OSError, ValueError) as error:
        raise ReportError(f"{path} cannot be read as JSON: {error}") from None
    if not isinstance(value, dict):
        raise ReportError(f"{path}: expected a JSON object, found {type(value).__name__}")
    return value


def seconds(path: Path, record: Record, key: str) -> float:
    """Return a time of `record` in s, which was read from `path`. Raises ReportError if it is missing."""
    value = record.get(key)
    if not isinstance(value, int | float) or not 0 <= value < math.inf:
        raise ReportError(f"{path}: expected a time in seconds under '{key}', found {value!r}")
    return float(value)


def load_flight_log(path: Path) -> FlightLog:
    """Read the recorded run without the pictures' bytes (see `load_frames`). Raises ReportError."""
    run: Record = {}
    ticks: list[Record] = []
    semantics: list[Record] = []
    stamps: set[int] = set()
    try:
        for topic, stamp_ns, payload in read_messages(path):
            if topic == "/tick":
                ticks.append(payload)
            elif topic == "/semantic":
                semantics.append(payload)
            elif topic == "/camera":
                stamps.add(stamp_ns)
            elif topic == "/run":
                run = payload
    except FileNotFoundError:
        raise ReportError(f"{path} is missing; expected the flight log written by edge-run --record") from None
    except (OSError, RecordingError) as error:
        raise ReportError(str(error)) from None
    if not ticks:
        raise ReportError(f"{path} holds no /tick record: the runner ended before its first control tick")
    try:
        semantics.sort(key=lambda s: s["ready_ns"])
    except MISSHAPEN as error:
        raise ReportError(f"{path}: a /semantic record lacks or misshapes a field: {error!r}") from error
    return FlightLog(path, run, ticks, semantics, frozenset(stamps))


def load_frames(path: Path, stamps_ns: set[int]) -> dict[int, bytes]:
    """Read the JPEG bytes of the camera frames with these stamps, in a second pass to save memory."""
    return {
        stamp_ns: jpeg_bytes(payload)
        for topic, stamp_ns, payload in read_messages(path)
        if topic == "/camera" and stamp_ns in stamps_ns
    }


def load_trace(path: Path) -> Trace:
    """Read the ground truth of edge-hil; ignores an incomplete last line. Raises ReportError for other damage."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        raise ReportError(f"{path} is missing; expected the trace written by edge-hil --trace") from None
    except (OSError, ValueError) as error:
        raise ReportError(f"{path} cannot be read as UTF-8 text, one JSON object a line: {error}") from None
    by_kind: dict[str, list[Record]] = {"scene": [], "pose": [], "people": [], "wire": [], "end": []}
    for number, line in enumerate(lines, start=1):
        try:
            record = json.loads(line)
            by_kind.setdefault(record["kind"], []).append(record)
        except (ValueError, KeyError, TypeError):
            if number == len(lines):
                break
            raise ReportError(f"{path}:{number}: expected one JSON object with a 'kind', found {line[:60]!r}") from None
    if not by_kind["scene"] or not by_kind["pose"]:
        raise ReportError(f"{path} holds no scene or no pose record: the simulation ended before it started")
    try:
        return _trace(by_kind)
    except MISSHAPEN as error:
        raise ReportError(f"{path}: a record lacks or misshapes a field: {error!r}") from error


def _trace(by_kind: dict[str, list[Record]]) -> Trace:
    poses = by_kind["pose"]
    theta = np.unwrap([float(p["theta"]) for p in poses])
    return Trace(
        scene=by_kind["scene"][0],
        pose_ns=np.array([p["t_ns"] for p in poses], np.int64),
        pose=np.column_stack([[float(p["x"]) for p in poses], [float(p["y"]) for p in poses], theta]),
        velocity=_body_velocity(poses, theta),
        people_ns=np.array([p["t_ns"] for p in by_kind["people"]], np.int64),
        people=[np.asarray(p["poses"], float).reshape(-1, 3) for p in by_kind["people"]],
        wire=by_kind["wire"],
        end=by_kind["end"][-1] if by_kind["end"] else {},
    )


def _body_velocity(poses: list[Record], theta: Array) -> Array:
    """Rotate world-frame velocities [n, 3] into the body frame."""
    vx, vy, wz = (np.array([float(p[key]) for p in poses]) for key in ("vx", "vy", "wz"))
    cos, sin = np.cos(theta), np.sin(theta)
    return np.column_stack([cos * vx + sin * vy, -sin * vx + cos * vy, wz])


def truth_at(trace: Trace, stamps_ns: NDArray[np.int64]) -> Array:
    """Interpolate the ground-truth pose [n, 3] linearly at these stamps (theta is unwrapped)."""
    base = trace.pose_ns[0]
    at, samples = (stamps_ns - base).astype(float), (trace.pose_ns - base).astype(float)
    return np.column_stack([np.interp(at, samples, trace.pose[:, axis]) for axis in range(3)])


def odometry_in_world(data: RunData) -> tuple[NDArray[np.int64], Array]:
    """Align the runner's odometry path with the world at its first pose; returns stamps [n] and poses [n, 3].

    `T_world_odom = T_world_base(t0) · T_odom_base(t0)⁻¹`; the growing distance to the truth is odometry drift.
    """
    ticks = [tick for tick in data.log.ticks if tick["pose"] is not None]
    stamps_ns = np.array([tick["now_ns"] for tick in ticks], np.int64)
    if not ticks:
        return stamps_ns, np.zeros((0, 3))
    odom = np.array([tick["pose"] for tick in ticks], float)
    start = truth_at(data.trace, stamps_ns[:1])[0]
    turn = start[2] - odom[0, 2]
    cos, sin = math.cos(turn), math.sin(turn)
    delta = odom[:, :2] - odom[0, :2]
    world = delta @ np.array([[cos, sin], [-sin, cos]]) + start[:2]
    return stamps_ns, np.column_stack([world, odom[:, 2] + turn])
