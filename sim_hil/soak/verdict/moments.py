"""Worst moments of a leg as small animations of the robot's camera, made before the flight logs are deleted."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from PIL import Image, ImageDraw, UnidentifiedImageError

from edge.core.cli import write_whole
from edge.flightlog.reader import RecordingError, jpeg_bytes, read_messages

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
    kept = []
    for moment in worst(analysis):
        frames = _frames(folder, moment.t_ns)
        name = f"{moment.kind.replace(' ', '-')}.gif"
        if frames:
            _write(folder / name, frames, moment)
        kept.append({**moment.__dict__, "gif": name if frames else ""})
    write_whole(folder / MOMENTS, json.dumps(kept, indent=1) + "\n")


def read_moments(folder: Path) -> list[Moment]:
    """Read the moments written by `keep_moments`; empty if the leg was killed before."""
    try:
        return [Moment(**row) for row in json.loads((folder / MOMENTS).read_text(encoding="utf-8"))]
    except (OSError, ValueError, TypeError):
        return []


def _frames(folder: Path, t_ns: int) -> list[tuple[float, bytes]]:
    """Return (time relative to the moment s, JPEG) of the images around it, from the leg's flight logs."""
    low_ns, high_ns = t_ns - round(BEFORE_S * 1e9), t_ns + round(AFTER_S * 1e9)
    found: list[tuple[float, bytes]] = []
    for log in sorted(folder.glob("flight-*.mcap")):
        try:
            for topic, stamp_ns, payload in read_messages(log):
                if topic == "/camera" and low_ns <= stamp_ns <= high_ns:
                    found.append(((stamp_ns - t_ns) / 1e9, jpeg_bytes(payload)))
        except (OSError, RecordingError, ValueError):
            continue  # the runner was killed before it wrote data
    kept: list[tuple[float, bytes]] = []
    for at_s, jpeg in sorted(found, key=lambda frame: frame[0]):
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
