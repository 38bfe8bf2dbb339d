"""A small, coherent demo run written to files: a robot walks 10 s down a corridor while a slow model thinks.

Used by the report's and the demo's tests. All numbers follow from one kinematic model, so that the report's
recomputations (Δt, path, odometry) have a known answer.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from edge.flightlog.recorder import Recorder

START_NS = 5_000_000_000_000
TICK_NS = 100_000_000
THINK_NS = 900_000_000
RELEASE_NS = 2_000_000_000
SPEED_MPS = 0.4
CALL_ERROR_MS = 1.3725
MACHINE = {"processor": "Synthetic 9000", "cores usable": "3"}
HOSTILE_TEXT = 'turn </pre><script>alert("x")</script> \u202eleft\u0007 & <b>go</b> \U0001f916'


def pose_at(t_s: float) -> tuple[float, float, float]:
    """Ground truth: still until 3 s (no semantic state yet), then forward with a slight weave."""
    moving_s = max(0.0, t_s - 3.0)
    return 1.0 + SPEED_MPS * moving_s, 0.3 * math.sin(0.6 * moving_s), 0.2 * math.sin(0.8 * moving_s)


def jpeg(t_s: float) -> bytes:
    """A corridor in one-point perspective that comes closer with time."""
    image = np.full((240, 320, 3), (205, 214, 220), np.uint8)
    centre = (160, 110)
    for corner, colour in (((0, 239), (150, 160, 170)), ((319, 239), (150, 160, 170))):
        cv2.line(image, centre, corner, colour, 3)
    size = int(10 + 4 * t_s)
    cv2.rectangle(image, (200, 110 - size), (200 + size, 110 + size), (40, 60, 190), -1)
    cv2.putText(image, f"{t_s:.1f} s", (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (60, 60, 60), 1)
    return cv2.imencode(".jpg", image)[1].tobytes()


def _box(x: float, y: float, w: float, d: float) -> list[list[float]]:
    return [[x, y], [x + w, y], [x + w, y + d], [x, y + d]]


SCENE = {
    "kind": "scene",
    "t_ns": START_NS - 2_000_000_000,
    "name": "corridor",
    "start": [1.0, 0.0, 0.0],
    "goal": [13.0, 0.6],
    "footprints": [
        {"label": "wall left", "kind": "wall", "polygon": _box(0, 1.5, 15, 0.15)},
        {"label": "wall right", "kind": "wall", "polygon": _box(0, -1.65, 15, 0.15)},
        {"label": "wall end", "kind": "wall", "polygon": _box(15, -1.65, 0.15, 3.3)},
        {"label": "vending machine", "kind": "vending_machine", "polygon": _box(13.2, 0.7, 0.9, 0.8)},
        {"label": "plant", "kind": "plant", "polygon": _box(5.0, -1.5, 0.4, 0.4)},
        {"label": "bench", "kind": "bench", "polygon": _box(8.0, 1.0, 1.5, 0.5)},
    ],
}


def trace_lines(duration_s: float) -> list[dict[str, Any]]:
    """The trace of edge-hil from 2 s before the first tick to 1 s after the last."""
    lines: list[dict[str, Any]] = [SCENE]
    for step in range(-20, int(duration_s * 10) + 10):
        t_s, t_ns = step / 10, START_NS + step * TICK_NS
        x, y, theta = pose_at(t_s)
        ahead = pose_at(t_s + 0.01)
        vx, vy, wz = ((b - a) / 0.01 for a, b in zip((x, y, theta), ahead, strict=True))
        pose = {"x": x, "y": y, "z": 0.31, "theta": theta, "vx": vx, "vy": vy, "wz": wz}
        lines.append({"t_ns": t_ns, "kind": "pose", **pose, "mode": 3})
        if step % 2 == 0:
            people = [[4 + 0.5 * t_s, 0.9, 0.0], [12 - 0.4 * t_s, -0.8, math.pi]]
            lines.append({"t_ns": t_ns, "kind": "people", "poses": people})
        if 0 <= step < duration_s * 10:
            moving = SPEED_MPS if t_s >= 3.0 else 0.0
            lines.append(wire(t_ns + 5_000_000, "Move", {"x": moving, "y": 0.0, "z": 0.0}))
    end_ns = START_NS + int(duration_s * 1e9)
    lines.append(wire(end_ns + 10_000_000, "Move", {"x": 0.0, "y": 0.0, "z": 0.0}))
    lines.append(wire(end_ns + 60_000_000, "StopMove", ""))
    lines.append({"t_ns": end_ns + 1_000_000_000, "kind": "end", **hil_result(duration_s)})
    return lines


def wire(t_ns: int, name: str, parameter: dict[str, float] | str) -> dict[str, Any]:
    """One request as the robot's side saw it."""
    text = json.dumps(parameter) if isinstance(parameter, dict) else parameter
    velocity = [0.0, 0.0, 0.0] if name == "StopMove" else None
    if isinstance(parameter, dict):
        velocity = [parameter[axis] for axis in "xyz"]
    request = {"service": "sport", "api_id": 1008, "name": name, "parameter": text, "velocity": velocity}
    return {"t_ns": t_ns, "kind": "wire", **request}


def hil_result(duration_s: float) -> dict[str, Any]:
    """JSON result of edge-hil."""
    moves = int(duration_s * 10) + 1
    return {
        "robot": "go2",
        "scene": "corridor",
        "seed": 7,
        "people": 2,
        "duration_s": duration_s + 3,
        "real_time_factor": 0.9996,
        "wire": {"commands": moves, "last_move": [0, 0, 0], "last_command": "StopMove", "last_command_zero": True},
        "path_m": 2.9,
        "fell": False,
        "collisions": ["plant"],
        "video_frames": 100,
        "state_hz": 50.0,
    }


def bridge_result(duration_s: float) -> dict[str, Any]:
    """JSON result of edge-bridge: every Move that the robot received was written by it."""
    return {
        "state": "stopped",
        "reason": "stopped by the client",
        "commands": hil_result(duration_s)["wire"]["commands"],
        "rejected": 0,
        "last_seq": int(duration_s * 10),
        "last_command": [0.0, 0.0, 0.0],
        "zero_after_stop": True,
        "malformed": {"client": 0, "robot": 0},
        "failed_writes": 0,
    }


def generations(duration_s: float) -> list[dict[str, Any]]:
    """/semantic records: a generation starts when the last one was released; the first anchor is the first frame."""
    records = []
    anchor_ns = START_NS
    while anchor_ns + THINK_NS + RELEASE_NS < START_NS + duration_s * 1e9:
        finished_ns, index = anchor_ns + THINK_NS, len(records)
        records.append(
            {
                "generation": index,
                "anchor_ns": anchor_ns,
                "anchor_pose": list(pose_at((anchor_ns - START_NS) / 1e9)),
                "started_ns": anchor_ns + 4_000_000,
                "finished_ns": finished_ns,
                "ready_ns": finished_ns + RELEASE_NS,
                "release_delay_s": 2.0,
                "frames_ns": [anchor_ns],
                "prompt_tokens": 1_180,
                "new_tokens": 24,
                "text": HOSTILE_TEXT if index == 0 else f"Ġqlr ##vine {index}\nof of of 0.31, -0.02",
                "waypoints": None if index == 0 else [[0.4, 0.0], [0.8, 0.1]],
                "prefill_ms": 610.0,
                "decode_ms": 260.0,
                "context_ms": 12.0,
            }
        )
        anchor_ns = START_NS + -(-(finished_ns + RELEASE_NS - START_NS) // TICK_NS) * TICK_NS
    return records


def tick_records(duration_s: float) -> list[dict[str, Any]]:
    """/tick records at 10 Hz; the robot drives once a generation is released."""
    semantics = generations(duration_s)
    x0, y0, theta0 = pose_at(0)
    ticks = []
    for tick in range(int(duration_s * 10)):
        start_ns = START_NS + tick * TICK_NS
        now_ns = start_ns + 25_000_000
        released = [s for s in semantics if s["ready_ns"] <= now_ns]
        used = released[-1] if released else None
        x, y, theta = pose_at((now_ns - START_NS) / 1e9)
        ticks.append(
            {
                "tick": tick,
                "now_ns": now_ns,
                "start_ns": start_ns,
                "duration_ms": 30.0 + (tick * 7919 % 13),
                "late_ms": 0.2,
                "encode_ms": 18.0,
                "act_ms": 6.0,
                "frame_ns": start_ns - 40_000_000,
                "frame_age_ms": 65.0,
                "generation": used["generation"] if used else None,
                "anchor_ns": used["anchor_ns"] if used else None,
                "delay_s": (now_ns - used["anchor_ns"]) / 1e9 if used else None,
                "offset": [0.1, 0.0, 0.0] if used else None,
                "pose": [x - x0 + 0.002 * tick, y - y0, theta - theta0],
                "state": [SPEED_MPS, 0.0, 0.0],
                "trajectory": [[0.4, 0, 0], [0.8, 0, 0], [1.2, 0, 0]] if used else None,
                "target": [0.4, 0.0, 0.0] if used else None,
                "command": [SPEED_MPS if used else 0.0, 0.0, 0.0],
                "reason": "ok" if used else "no-semantic-state",
            }
        )
    return ticks


def run_result(duration_s: float) -> dict[str, Any]:
    """JSON result of edge-run; it last asked the bridge before the zero command that the bridge adds by itself."""
    return {
        "control": {
            "ticks": int(duration_s * 10),
            "missed": 0,
            "tick_ms": {"p50": 36.0, "p99": 42.0, "p999": 42.0, "max": 42.0},
        },
        "reasoning": {
            "generations": len(generations(duration_s)),
            "failed": 0,
            "generation_ms": {"p50": 900.0, "p99": 905.0, "max": 905.0},
        },
        "delay_s": {"p50": 4.3, "p99": 5.7, "max": 5.8},
        "bridge": {
            "commands": bridge_result(duration_s)["commands"] - 1,
            "last_command": [0.0, 0.0, 0.0],
            "zero_after_stop": True,
        },
        "delay_error_ms": {"max": CALL_ERROR_MS},
        "faults": [],
        "duration_s": duration_s + 0.8,
        "peak_rss_bytes": 512 * 2**20,
    }


def write_flight_log(
    path: Path,
    duration_s: float,
    ticks: list[dict[str, Any]] | None = None,
    semantics: list[dict[str, Any]] | None = None,
) -> None:
    """The flight log of edge-run; ticks and generations may be replaced."""
    recorder = Recorder(path)
    instruction = "walk down the corridor and stop at the vending machine"
    delay = {"mean_s": 2.0, "sd_s": 0.0, "seed": 0}
    recorder.put("/run", START_NS, {"instruction": instruction, "mode": "async", "release_delay": delay})
    for tick in range(int(duration_s * 10)):
        recorder.put("/camera", START_NS + tick * TICK_NS, jpeg(tick / 10))
    for record in tick_records(duration_s) if ticks is None else ticks:
        recorder.put("/tick", record["now_ns"], record)
    for record in generations(duration_s) if semantics is None else semantics:
        recorder.put("/semantic", record["ready_ns"], record)
    recorder.put("/result", START_NS, run_result(duration_s))
    assert recorder.close()


def write_run(
    out: Path,
    duration_s: float = 12.0,
    *,
    ticks: list[dict[str, Any]] | None = None,
    semantics: list[dict[str, Any]] | None = None,
    trace: list[dict[str, Any]] | None = None,
    trained: bool = False,
) -> None:
    """Write every file of a run into `out`; any part may be replaced."""
    out.mkdir(parents=True, exist_ok=True)
    write_flight_log(out / "flight.mcap", duration_s, ticks, semantics)
    lines = trace_lines(duration_s) if trace is None else trace
    (out / "hil_trace.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    settings = {"duration_s": duration_s, "seed": 7, "people": 2, "artifacts": "artifacts", "machine": MACHINE}
    (out / "settings.json").write_text(json.dumps(settings))
    (out / "run.json").write_text(json.dumps(run_result(duration_s)))
    (out / "hil.json").write_text(json.dumps(hil_result(duration_s)))
    (out / "bridge.json").write_text(json.dumps(bridge_result(duration_s)))
    (out / "artifacts").mkdir(exist_ok=True)
    (out / "artifacts" / "manifest.json").write_text(json.dumps({"model": {"preset": "nano", "trained": trained}}))
