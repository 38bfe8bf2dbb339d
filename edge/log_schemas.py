"""JSON schemas of the flight log's topics, so that a viewer (Foxglove) can list and plot the fields.

A table, not code: one entry per topic. Names carry their units; stamps are monotonic ns of the recording machine.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

Schema = dict[str, Any]

_INT: Schema = {"type": "integer"}
_NUMBER: Schema = {"type": "number"}
_TEXT: Schema = {"type": "string"}
_INT_OR_NULL: Schema = {"type": ["integer", "null"]}
_NUMBER_OR_NULL: Schema = {"type": ["number", "null"]}
_VECTOR: Schema = {"type": "array", "items": _NUMBER_OR_NULL}
_VECTOR_OR_NULL: Schema = {"type": ["array", "null"], "items": _NUMBER_OR_NULL}
_ROWS_OR_NULL: Schema = {"type": ["array", "null"], "items": _VECTOR}


def _record(title: str, **properties: Schema) -> Schema:
    return {"title": title, "type": "object", "properties": properties}


COMPRESSED_IMAGE: Schema = _record(
    "foxglove.CompressedImage",
    timestamp={"type": "object", "title": "time", "properties": {"sec": _INT, "nsec": _INT}},
    frame_id=_TEXT,
    format=_TEXT,
    data={"type": "string", "contentEncoding": "base64"},
)
"""Foxglove's well-known schema; the name in the title is what makes a viewer show the topic as a picture."""

SCHEMAS: Mapping[str, Schema] = {
    "/run": _record(
        "tic_vla.Run",
        instruction=_TEXT,
        mode=_TEXT,
        artifacts=_TEXT,
        manifest_sha256=_TEXT,
        robot=_TEXT,
        release_delay={},
        started_ns=_INT,
        tick_period_ms=_NUMBER,
    ),
    "/tick": _record(
        "tic_vla.Tick",
        tick=_INT,
        now_ns=_INT,
        start_ns=_INT,
        duration_ms=_NUMBER,
        late_ms=_NUMBER,
        encode_ms=_NUMBER_OR_NULL,
        act_ms=_NUMBER_OR_NULL,
        frame_ns=_INT_OR_NULL,
        frame_age_ms=_NUMBER_OR_NULL,
        generation=_INT_OR_NULL,
        anchor_ns=_INT_OR_NULL,
        delay_s=_NUMBER_OR_NULL,
        offset=_VECTOR_OR_NULL,
        pose=_VECTOR_OR_NULL,
        state=_VECTOR_OR_NULL,
        trajectory=_ROWS_OR_NULL,
        target=_VECTOR_OR_NULL,
        command=_VECTOR,
        reason=_TEXT,
    ),
    "/semantic": _record(
        "tic_vla.Semantic",
        generation=_INT,
        anchor_ns=_INT,
        anchor_pose=_VECTOR_OR_NULL,
        started_ns=_INT,
        finished_ns=_INT,
        ready_ns=_INT,
        release_delay_s=_NUMBER,
        frames_ns={"type": "array", "items": _INT},
        prompt_tokens=_INT,
        new_tokens=_INT,
        text=_TEXT,
        waypoints=_ROWS_OR_NULL,
        prefill_ms=_NUMBER,
        decode_ms=_NUMBER,
        context_ms=_NUMBER,
    ),
    "/camera": COMPRESSED_IMAGE,
    "/result": {"title": "tic_vla.Result", "type": "object"},
}

ANY_OBJECT: Schema = {"title": "tic_vla.Object", "type": "object"}
"""For a topic that is not in the table."""
