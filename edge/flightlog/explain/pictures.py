"""Pictures and facts of explanations as plain values, for a page or a contact sheet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np

from edge.flightlog.explain.chain import generation_of
from edge.flightlog.explain.explanation import Explanation
from edge.flightlog.explain.flight import Flight
from edge.flightlog.explain.overlay import Overlay, Picture, label
from edge.flightlog.replay.records import RecordedFrame, read_events

CARD_PX: Final = 480
_QUALITY: Final = 82
_TILE_PX: Final = 400
_TILE_TEXT_PX: Final = 44
_COLUMNS: Final = 4


def drawn_pictures(path: Path, flight: Flight, stamps_ns: set[int]) -> dict[int, Picture]:
    """Return the pictures of these stamps, BGR, with plan and waypoints drawn. Raises RecordingError, OSError."""
    overlay, found = Overlay(flight.mount, CARD_PX), {}
    for event in read_events(path):
        if isinstance(event, RecordedFrame) and event.stamp_ns in stamps_ns:
            ticks = flight.ticks_between(event.stamp_ns, event.stamp_ns + 500_000_000)
            tick = ticks[0] if ticks else None
            drawn = overlay.draw(event.jpeg, tick, None if tick is None else generation_of(flight, tick))
            if drawn is not None:
                found[event.stamp_ns] = drawn
    return found


def wanted_stamps(found: Sequence[Explanation]) -> set[int]:
    """Return the stamps of all pictures that the explanations show, ns."""
    return {
        at for each in found if not each.refers for at in (each.anchor_frame_ns, each.event_frame_ns) if at is not None
    }


def card(flight: Flight, each: Explanation, pictures: Mapping[int, Picture], *, decisive: bool) -> dict[str, Any]:
    """Return an explanation with its pictures as JPEG: the anchor's, which the text describes, and the event's."""
    shown: list[dict[str, Any]] = []
    if each.refers:
        return {**each.as_json(), "steps": [], "evidence": [], "pictures": shown, "decisive": decisive}
    for name, at_ns in (("the text's picture", each.anchor_frame_ns), ("the event", each.event_frame_ns)):
        if at_ns is not None and at_ns in pictures:
            shown.append({"jpeg": jpeg(pictures[at_ns]), "caption": f"{name}, {flight.seconds(at_ns):.1f} s"})
    return {**each.as_json(), "steps": list(each.steps), "pictures": shown, "decisive": decisive}


def contact_sheet(tiles: Sequence[tuple[Picture, str, str]]) -> bytes | None:
    """Return pictures with two lines of text each, four to a row, as JPEG; None without a picture."""
    if not tiles:
        return None
    cells = [_tile(*tile) for tile in tiles]
    height_px = max(cell.shape[0] for cell in cells)
    blank = np.full((height_px, _TILE_PX, 3), 255, np.uint8)
    rows = []
    for at in range(0, len(cells), _COLUMNS):
        row = [_padded(cell, blank) for cell in cells[at : at + _COLUMNS]]
        rows.append(np.hstack([*row, *[blank] * (_COLUMNS - len(row))]))
    return jpeg(np.vstack(rows))


def jpeg(picture: Picture) -> bytes:
    """Return a picture, BGR, as JPEG."""
    return bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes())


def _tile(picture: Picture, title: str, cause: str) -> Picture:
    height_px = round(picture.shape[0] * _TILE_PX / picture.shape[1])
    small = cv2.resize(picture, (_TILE_PX - 8, height_px), interpolation=cv2.INTER_AREA)
    tile = np.full((height_px + _TILE_TEXT_PX + 8, _TILE_PX, 3), 255, np.uint8)
    tile[4 : 4 + height_px, 4 : _TILE_PX - 4] = small
    tile[4 + height_px : -4, 4 : _TILE_PX - 4] = 40
    label(tile, title[:52], (10, height_px + 20), (255, 255, 255))
    label(tile, cause[:52], (10, height_px + 40), (120, 200, 255))
    return tile


def _padded(cell: Picture, blank: Picture) -> Picture:
    whole = blank.copy()
    whole[: cell.shape[0]] = cell
    return whole
