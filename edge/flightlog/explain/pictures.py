"""Pictures and facts of explanations as plain values, for a page or a contact sheet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
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

PictureKey = int | tuple[int, int]
"""Stamp, ns, of an event's picture; stamp and number of the generation of a text's picture."""


def drawn_pictures(path: Path, flight: Flight, wanted: Set[PictureKey]) -> dict[PictureKey, Picture]:
    """Return these pictures, BGR: an event's with plan and waypoints drawn, a text's with the text's waypoints.

    Raises RecordingError, OSError.
    """
    overlay = Overlay(flight.mount, CARD_PX)
    found: dict[PictureKey, Picture] = {}
    keys: dict[int, list[PictureKey]] = {}
    for key in wanted:
        keys.setdefault(key if isinstance(key, int) else key[0], []).append(key)
    for event in read_events(path):
        if not isinstance(event, RecordedFrame):
            continue
        for key in keys.get(event.stamp_ns, ()):
            drawn = _drawn(overlay, flight, event, key)
            if drawn is not None:
                found[key] = drawn
    return found


def _drawn(overlay: Overlay, flight: Flight, frame: RecordedFrame, key: PictureKey) -> Picture | None:
    if not isinstance(key, int):
        # The tick at the anchor drove by an earlier text.
        return overlay.draw(frame.jpeg, None, flight.generations.get(key[1]))
    ticks = flight.ticks_between(frame.stamp_ns, frame.stamp_ns + 500_000_000)
    tick = ticks[0] if ticks else None
    return overlay.draw(frame.jpeg, tick, None if tick is None else generation_of(flight, tick))


def wanted_stamps(found: Sequence[Explanation]) -> set[PictureKey]:
    """Return the keys of all pictures that the explanations show."""
    return {
        key for each in found if not each.refers for key in (_text_key(each), each.event_frame_ns) if key is not None
    }


def _text_key(each: Explanation) -> PictureKey | None:
    if each.anchor_frame_ns is None or each.generation is None:
        return None
    return each.anchor_frame_ns, each.generation


def card(
    flight: Flight, each: Explanation, pictures: Mapping[PictureKey, Picture], *, decisive: bool
) -> dict[str, Any]:
    """Return an explanation with its pictures as JPEG: the anchor's, which the text describes, and the event's."""
    shown: list[dict[str, Any]] = []
    if each.refers:
        return {**each.as_json(), "steps": [], "evidence": [], "pictures": shown, "decisive": decisive}
    for name, key in (("the text's picture", _text_key(each)), ("the event", each.event_frame_ns)):
        if key is not None and key in pictures:
            at_ns = key if isinstance(key, int) else key[0]
            shown.append({"jpeg": jpeg(pictures[key]), "caption": f"{name}, {flight.seconds(at_ns):.1f} s"})
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
