"""Builds the live view's messages from a run's newest records. Pure: no socket, no clock."""

from __future__ import annotations

import itertools
import json
import math
from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from edge.core.geometry import SE2
from edge.flightlog.standard_messages import Mount, jpeg_size
from edge.live.wire import EVENTS
from edge.odometry.camera_geometry import Attitude, FloorProjector
from edge.safety.faults.table import FAULTS

OVERLAY: Final = "/overlay"
_KEPT: Final = 24
_NEAREST_M: Final = 0.15
"""Distance before the lens from which on the floor is drawn, m: nearer points lie below the picture or behind it."""
_STEP_M: Final = 0.1


class Message(NamedTuple):
    """One message to a client: JSON text, or the bytes of a JPEG with its stamp."""

    topic: str
    stamp_ns: int
    data: str | bytes


class LiveState:
    """The newest records of a run, and the picture's overlay."""

    def __init__(self) -> None:
        self._newest: dict[str, Message] = {}
        # A new client gets the last events, and the newest record of every other topic.
        self._history: dict[str, deque[Message]] = {topic: deque(maxlen=_KEPT) for topic in EVENTS}
        self._mount: Mount | None = None
        self._size: tuple[int, int] | None = None
        self._attitude = Attitude()
        self._waypoints: list[SE2] = []  # in the odometry's frame

    def picture(self, topic: str, stamp_ns: int, jpeg: bytes) -> list[Message]:
        """Take a JPEG; return the messages for the clients."""
        try:
            self._size = jpeg_size(jpeg)
        except (ValueError, LookupError):
            return []
        return [self._keep(Message(topic, stamp_ns, jpeg))]

    def record(self, topic: str, stamp_ns: int, record: Mapping[str, Any]) -> list[Message]:
        """Take a record; return the messages for the clients: itself, and what a client needs beside it."""
        found = dict(record)
        overlay: dict[str, Any] | None = None
        try:
            if topic == "/run":
                self._mount = None if record.get("mount") is None else Mount.of_record(record["mount"])
                self._waypoints = []
            elif topic == "/odometry":
                self._attitude = Attitude(float(record.get("roll_rad", 0.0)), float(record.get("pitch_rad", 0.0)))
            elif topic == "/semantic":
                self._waypoints = _waypoints(record)
            elif topic == "/fault" and record["name"] in FAULTS:
                fault = FAULTS[record["name"]]
                found |= {"message": fault.message, "advice": fault.advice}
            elif topic == "/tick":
                overlay = {"plan": [], "waypoints": []}  # replaces the earlier plan where this one cannot be drawn
                overlay = self._overlay(record)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError):
            pass  # a malformed record is shown as it is
        messages = [self._keep(Message(topic, stamp_ns, text_of(topic, stamp_ns, found)))]
        if overlay is not None:
            messages.append(self._keep(Message(OVERLAY, stamp_ns, text_of(OVERLAY, stamp_ns, overlay))))
        return messages

    def snapshot(self) -> Iterator[Message]:
        """Return what a new client needs: the last events, then the newest of every other topic."""
        for topic in EVENTS:
            yield from self._history[topic]
        yield from self._newest.values()

    def _keep(self, message: Message) -> Message:
        if message.topic in self._history:
            self._history[message.topic].append(message)
        else:
            self._newest[message.topic] = message
        return message

    def _overlay(self, record: Mapping[str, Any]) -> dict[str, Any] | None:
        """Return plan and waypoints in pixels of the picture, as shares of its width and height."""
        if self._mount is None or self._size is None:
            return None
        width, height = self._size
        aspect = self._mount.aspect or width / height
        seen = FloorProjector(self._mount.geometry, width, max(1, round(width / aspect)))
        plan = [(float(x), float(y)) for x, y, *_ in record["trajectory"] or ()]
        places: list[tuple[float, float]] = []
        if record["pose"] is not None:
            to_base = SE2(*(float(v) for v in record["pose"])).inverse()
            places = [(at.x_m, at.y_m) for at in (to_base @ place for place in self._waypoints)]
        scale = (1 / width, aspect / width)
        return {
            "plan": self._pixels(seen, _line([(0.0, 0.0), *plan]) if plan else [], scale),
            "waypoints": self._pixels(seen, places, scale),
        }

    def _pixels(
        self, seen: FloorProjector, points: list[tuple[float, float]], scale: tuple[float, float]
    ) -> list[list[float]]:
        nearest_m = seen.geometry.forward_m + _NEAREST_M
        ahead = [(x, y) for x, y in points if x > nearest_m and math.isfinite(x + y)]
        if not ahead:
            return []
        pixels = seen.pixels(np.array(ahead, float), self._attitude) * np.array(scale)
        return [[round(float(u), 4), round(float(v), 4)] for u, v in pixels]


def text_of(topic: str, stamp_ns: int, record: Mapping[str, Any]) -> str:
    """Return the JSON text of a message."""
    return json.dumps({"topic": topic, "stamp_ns": stamp_ns, "record": record})


def _waypoints(record: Mapping[str, Any]) -> list[SE2]:
    points, anchor = record["waypoints"], record["anchor_pose"]
    if points is None or anchor is None:
        return []
    start = SE2(*(float(v) for v in anchor))
    return [start @ SE2(float(x), float(y), 0.0) for x, y in points]


def _line(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return points of a line at most _STEP_M apart, so that its part below the picture can be left out."""
    found = points[:1]
    for (ax, ay), (bx, by) in itertools.pairwise(points):
        count = min(200, max(1, math.ceil(math.hypot(bx - ax, by - ay) / _STEP_M)))
        found += [(ax + (bx - ax) * k / count, ay + (by - ay) * k / count) for k in range(1, count + 1)]
    return found
