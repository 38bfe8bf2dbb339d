"""The plan and the text's waypoints drawn into the camera's picture, on the floor where the robot would go."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt

from edge.core.geometry import SE2
from edge.core.jpeg import jpeg_refusal
from edge.flightlog.explain.flight import ASPECTS
from edge.flightlog.replay.records import RecordedGeneration, RecordedTick
from edge.flightlog.standard_messages import Mount
from edge.odometry.camera_geometry import Attitude, FloorProjector
from edge.state.reasoning_text import WAYPOINT_TIMES_S, parse_waypoints

Picture = npt.NDArray[np.uint8]
Array = npt.NDArray[np.float64]

WIDTH_PX: Final = 640
DEFAULT_ASPECT: Final = 16 / 9
"""Of the drawn picture: the front camera's; a squeezed picture is stretched back to it."""
PLAN_COLOUR: Final = (200, 160, 30)
WAYPOINT_COLOUR: Final = (20, 140, 240)
"""BGR, as OpenCV writes."""
_PLAN_HALF_M: Final = 0.15
"""Half of the plan's drawn width, m: half of a robot's."""
_NEAREST_M: Final = 0.15
"""Distance before the lens from which on floor is drawn, m."""
_STEPS: Final = 12
_AROUND_PX: Final = tuple(shift for shift in itertools.product((-1, 0, 1), repeat=2) if shift != (0, 0))
"""Shifts of a text that draw its edge, px. A thicker text would be wider in OpenCV 5, and its edge beside the text."""


class Overlay:
    """Projector of one camera's floor points into its enlarged picture; without a mount the picture stays as it is."""

    def __init__(self, mount: Mount | None, width_px: int = WIDTH_PX) -> None:
        self._mount, self._width_px = mount, width_px

    def draw(self, jpeg: bytes, tick: RecordedTick | None, generation: RecordedGeneration | None) -> Picture | None:
        """Return the picture, BGR, with the tick's plan and the generation's waypoints.

        None for a JPEG that is damaged or of a size that no camera has: decoding one could fill the memory.
        Without a tick, the picture is the generation's anchor: its waypoints are drawn as written, and no plan.
        """
        refused = jpeg_refusal(jpeg) is not None
        image = None if refused else cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
        if image is None:
            return None
        aspect = image.shape[1] / image.shape[0]
        if not ASPECTS[0] <= aspect <= ASPECTS[1]:
            return None
        if self._mount is not None and self._mount.aspect is not None:
            aspect = self._mount.aspect
        size = (self._width_px, 2 * round(self._width_px / aspect / 2))
        picture: Picture = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_LINEAR), np.uint8)
        if self._mount is None:
            return picture
        floor = FloorProjector(self._mount.geometry, *size)
        if tick is not None and tick.rows is not None and np.isfinite(tick.rows).all():
            self._draw_plan(picture, floor, tick.rows)
        if generation is not None:
            self._draw_waypoints(picture, floor, waypoints_seen(tick, generation))
        return picture

    def _draw_plan(self, picture: Picture, floor: FloorProjector, rows: Array) -> None:
        """Draw the plan as a ribbon of a robot's width."""
        line = _smooth(np.vstack((np.zeros((1, 3)), rows)))
        left = line[:, :2] + _PLAN_HALF_M * np.stack((-np.sin(line[:, 2]), np.cos(line[:, 2])), axis=1)
        right = 2 * line[:, :2] - left
        seen = self._visible(line[:, :2]) & self._visible(left) & self._visible(right)
        if int(seen.sum()) < 2:
            return
        edge = np.vstack((left[seen], right[seen][::-1]))
        outline = np.round(floor.pixels(edge, Attitude())).astype(np.int32)
        shade = picture.copy()
        cv2.fillPoly(shade, [outline], PLAN_COLOUR, cv2.LINE_AA)
        picture[:] = cv2.addWeighted(shade, 0.45, picture, 0.55, 0)
        middle = np.round(floor.pixels(line[seen][:, :2], Attitude())).astype(np.int32)
        cv2.polylines(picture, [middle], False, PLAN_COLOUR, 2, cv2.LINE_AA)

    def _draw_waypoints(self, picture: Picture, floor: FloorProjector, points: Sequence[tuple[float, float]]) -> None:
        """Draw the waypoints as numbered discs, joined by a line."""
        places = np.array(points, np.float64).reshape(-1, 2)
        seen = self._visible(places)
        pixels = np.round(floor.pixels(places[seen], Attitude())).astype(np.int32)
        if len(pixels) > 1:
            cv2.polylines(picture, [pixels], False, WAYPOINT_COLOUR, 1, cv2.LINE_AA)
        for (x, y), time_s in zip(pixels.tolist(), np.array(WAYPOINT_TIMES_S)[: len(places)][seen], strict=True):
            cv2.circle(picture, (x, y), 6, WAYPOINT_COLOUR, -1, cv2.LINE_AA)
            cv2.circle(picture, (x, y), 6, (255, 255, 255), 1, cv2.LINE_AA)
            label(picture, f"{time_s:g} s", (x + 9, y + 4), (255, 255, 255))

    def _visible(self, points: Array) -> npt.NDArray[np.bool_]:
        assert self._mount is not None
        return np.asarray(points[:, 0] > self._mount.geometry.forward_m + _NEAREST_M)


def waypoints_seen(tick: RecordedTick | None, generation: RecordedGeneration) -> list[tuple[float, float]]:
    """Return a generation's waypoints in the robot's frame at a tick, m; None: at the generation's anchor."""
    back = SE2(0.0, 0.0, 0.0) if tick is None else tick.offset.inverse()
    places = [back @ SE2(x_m, y_m, 0.0) for x_m, y_m in parse_waypoints(generation.text) or ()]
    return [(place.x_m, place.y_m) for place in places]


def label(picture: Picture, text: str, at: tuple[int, int], colour: tuple[int, int, int], scale: float = 0.45) -> None:
    """Write a text with a dark edge, readable on any picture; characters beyond ASCII become question marks."""
    shown = "".join(c if " " <= c <= "~" else "?" for c in text)
    for shift in _AROUND_PX:
        edge_at = (at[0] + shift[0], at[1] + shift[1])
        cv2.putText(picture, shown, edge_at, cv2.FONT_HERSHEY_SIMPLEX, scale, (20, 20, 20), 1, cv2.LINE_AA)
    cv2.putText(picture, shown, at, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, 1, cv2.LINE_AA)


def _smooth(rows: Array) -> Array:
    """Return poses [n, 3] between whole seconds, along curves that leave and enter each pose in its heading."""
    share = np.linspace(0, 1, _STEPS, endpoint=False)[:, None]
    pieces: list[Any] = []
    for a, b in itertools.pairwise(rows):
        length = float(np.hypot(*(b[:2] - a[:2])))
        out, into = length * np.array([np.cos(a[2]), np.sin(a[2])]), length * np.array([np.cos(b[2]), np.sin(b[2])])
        s2, s3 = share**2, share**3
        start, end = (2 * s3 - 3 * s2 + 1) * a[:2], (3 * s2 - 2 * s3) * b[:2]
        place = start + end + (s3 - 2 * s2 + share) * out + (s3 - s2) * into
        turn = (b[2] - a[2] + np.pi) % (2 * np.pi) - np.pi
        pieces.append(np.hstack((place, a[2] + share * turn)))
    return np.vstack((*pieces, rows[-1:]))
