"""Reads a flight log for replay: checked records, in the order of their stamps."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
import numpy.typing as npt

from edge.core.geometry import SE2
from edge.flightlog.reader import Damage, RecordingError, jpeg_bytes, read_messages
from edge.reasoning.decoding_rules import FOLLOWS, FREE, DecodingContext, TurnDistances
from edge.reasoning.path_memory import PastPath
from edge.reasoning.prompt import format_before
from edge.state.reasoning_text import LEFT, PROGRESS_HEAD, RIGHT, Progress, parse_progress
from firmware_bridge.core.config import ConfigError, LimitsConfig

_ORDER_WINDOW_NS = 5_000_000_000
"""Largest time by which records of different threads may be out of order in the file."""
_MISSHAPEN = (LookupError, TypeError, ValueError, AttributeError, OverflowError)

_Parsed = TypeVar("_Parsed")
Rows = npt.NDArray[np.float64]


@dataclass(frozen=True)
class RecordedRun:
    """Configuration of the run, from the first record of every log."""

    instruction: str
    mode: str
    manifest_sha256: str
    limits: LimitsConfig | None
    """None: a log without limits, so that commands cannot be computed again."""


@dataclass(frozen=True)
class RecordedFrame:
    """A recorded camera picture."""

    stamp_ns: int
    jpeg: bytes


@dataclass(frozen=True)
class RecordedGeneration:
    """Inputs and text of a generation."""

    number: int
    ready_ns: int
    instruction: str | None
    """None: the run's."""
    frames_ns: tuple[int, ...]
    poses: tuple[SE2, ...] | None
    """`T_odom_base` of each frame; None: a log without poses."""
    anchor_pose: SE2
    way: PastPath | None
    """The path in the prompt; None: a log from before it was recorded."""
    context: DecodingContext
    max_new_tokens: int
    text: str


@dataclass(frozen=True)
class RecordedTick:
    """Inputs and outputs of a tick."""

    number: int
    now_ns: int
    acted_ns: int
    frame_ns: int | None
    generation: int | None
    delay_s: float
    """Δt, s."""
    delay_given_s: float
    """Δt as the policy received it, s: within its training range."""
    offset: SE2
    pose: SE2 | None
    state: tuple[float, float, float]
    rows: Rows | None
    """The plan at whole seconds, [seconds, 3]; NaN where the log has null."""
    command: tuple[float, float, float]
    reason: str
    speed_scale: float


Event = RecordedFrame | RecordedGeneration | RecordedTick
NO_TICK: Final = (
    "no /tick record could be read: the run ended before its first control tick, or the log is cut or damaged"
)


def read_run(path: Path) -> RecordedRun:
    """Read the `/run` record; raises RecordingError without one, OSError."""
    for topic, _, payload in read_messages(path):
        if topic == "/run":
            return _read(path, "/run", _run, payload)
    raise RecordingError(
        f"{path}: no /run record could be read; expected a log of edge-run --record, not cut or damaged at its start"
    )


def read_events(path: Path, damages: list[Damage] | None = None) -> Iterator[Event]:
    """Yield frames, generations and ticks in the order of their stamps; raises RecordingError for a malformed one.

    `damages`: see `read_messages`.
    """
    waiting: list[tuple[int, int, Event]] = []
    newest_ns = count = 0
    for topic, stamp_ns, payload in read_messages(path, damages):
        event: Event
        if topic == "/tick":
            event = tick = _read(path, topic, _tick, payload)
            stamp_ns = tick.now_ns
        elif topic == "/semantic":
            event = generation = _read(path, topic, _generation, payload)
            stamp_ns = generation.ready_ns
        elif topic == "/camera":
            event = RecordedFrame(stamp_ns, _read(path, topic, jpeg_bytes, payload))
        else:
            continue
        count += 1
        heapq.heappush(waiting, (stamp_ns, count, event))
        newest_ns = max(newest_ns, stamp_ns)
        while waiting[0][0] < newest_ns - _ORDER_WINDOW_NS:
            yield heapq.heappop(waiting)[2]
    while waiting:
        yield heapq.heappop(waiting)[2]


def _read(path: Path, topic: str, parse: Callable[[dict[str, Any]], _Parsed], payload: dict[str, Any]) -> _Parsed:
    try:
        return parse(payload)
    except (*_MISSHAPEN, ConfigError) as error:
        raise RecordingError(f"{path}: a {topic} record lacks or misshapes a field ({error!r})") from error


def _run(payload: Mapping[str, Any]) -> RecordedRun:
    limits = payload.get("limits")
    return RecordedRun(
        instruction=_text(payload["instruction"]),
        mode=_text(payload["mode"]),
        manifest_sha256=_text(payload["manifest_sha256"]),
        limits=None if limits is None else LimitsConfig(**{key: float(value) for key, value in limits.items()}),
    )


def _generation(payload: Mapping[str, Any]) -> RecordedGeneration:
    frames_ns = tuple(int(stamp_ns) for stamp_ns in payload["frames_ns"])
    poses = payload.get("frame_poses")
    if not frames_ns or (poses is not None and len(poses) != len(frames_ns)):
        raise ValueError(f"{len(frames_ns)} frames, {poses and len(poses)} poses")
    return RecordedGeneration(
        number=int(payload["generation"]),
        ready_ns=int(payload["ready_ns"]),
        instruction=None if "instruction" not in payload else _text(payload["instruction"]),
        frames_ns=frames_ns,
        poses=None if poses is None else tuple(_pose(pose) for pose in poses),
        anchor_pose=_pose(payload["anchor_pose"]),
        way=None if "way" not in payload else tuple(_point(point) for point in payload["way"]),
        context=DecodingContext(
            _before(payload.get("before", format_before(None))),
            _follow(payload.get("follow", FREE)),
            _turn(payload.get("turn"), payload.get("turn_left_m")),
            _flag(payload.get("turn_may_be_done", True)),
            _flag(payload.get("keeps_form", False)),
        ),
        # Without the recorded cap: use the text's own token count, which gives the same keys and values.
        max_new_tokens=int(payload.get("max_new_tokens", payload["new_tokens"])),
        text=_text(payload["text"]),
    )


def _tick(payload: Mapping[str, Any]) -> RecordedTick:
    offset, pose, state, rows = (payload[key] for key in ("offset", "pose", "state", "trajectory"))
    driven = payload["generation"] is not None and offset is not None and state is not None
    now_ns = int(payload["now_ns"])
    delay_s = float(payload["delay_s"]) if driven else math.nan
    return RecordedTick(
        number=int(payload["tick"]),
        now_ns=now_ns,
        acted_ns=now_ns + round(float(payload["act_ms"] or 0.0) * 1e6),
        frame_ns=None if payload["frame_ns"] is None else int(payload["frame_ns"]),
        generation=int(payload["generation"]) if driven else None,
        delay_s=delay_s,
        # A log from before Δt was clamped: the policy received it as it was.
        delay_given_s=float(payload.get("delay_given_s", delay_s)) if driven else math.nan,
        offset=_pose(offset) if driven else SE2(0.0, 0.0, 0.0),
        pose=None if pose is None else _pose(pose),
        state=_triple(state) if driven else (0.0, 0.0, 0.0),
        rows=None if rows is None else np.array(rows, dtype=np.float64).reshape(-1, 3),
        command=_triple(payload["command"]),
        reason=_text(payload["reason"]),
        speed_scale=float(payload.get("speed_scale", 1.0)),
    )


def _pose(values: Any) -> SE2:
    return SE2(*_triple(values))


def _point(values: Any) -> tuple[float, float]:
    x_m, y_m = (float(value) for value in values)
    return x_m, y_m


def _before(value: Any) -> Progress | None:
    text = _text(value)
    progress = parse_progress(PROGRESS_HEAD + text)
    if format_before(progress) != text:
        raise ValueError(f"{text[:60]!r} is no progress")
    return progress


def _follow(value: Any) -> str:
    if value not in FOLLOWS:
        raise ValueError(f"follow is {str(value)[:60]!r}")
    return str(value)


def _turn(side: Any, left_m: Any) -> TurnDistances | None:
    if side is None:
        return None
    known_m = tuple(float(metres) for metres in left_m) if isinstance(left_m, list) else ()
    if side not in (LEFT, RIGHT) or not known_m or not all(map(math.isfinite, known_m)):
        raise ValueError(f"turn is {str(side)[:60]!r} by {str(left_m)[:60]}")
    return TurnDistances(str(side), known_m)


def _flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise TypeError(f"expected true or false, found {type(value).__name__}")
    return value


def _triple(values: Any) -> tuple[float, float, float]:
    a, b, c = (float(value) for value in values)
    return a, b, c


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"expected a text, found {type(value).__name__}")
    return value
