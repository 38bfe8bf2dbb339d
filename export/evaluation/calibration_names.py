"""Names of calibration data: without OpenCV, so that `--calibration` is refused at once."""

from __future__ import annotations

from pathlib import Path
from typing import Final

SETS: Final = Path(__file__).with_name("calibration_sets")
USER_KINDS: Final = ("folder", "video")
"""Kinds of the user's data: `KIND:PATH`."""


def list_calibration_sets() -> list[str]:
    """Return the names of the shipped sets."""
    return sorted(path.parent.name for path in SETS.glob("*/set.toml"))


def name_refusal(name: str) -> str | None:
    """Return why a name is no calibration data, as one line; None for a shipped set, or a user's path, unopened."""
    kind, _, path = name.partition(":")
    if (kind in USER_KINDS and path) or name in list_calibration_sets():
        return None
    known = ", ".join(list_calibration_sets())
    return f"calibration set {name!r} is not known; expected one of: {known}, folder:PATH, video:PATH"
