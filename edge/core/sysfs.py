"""Numbers and names in small files of Linux; the root can be another folder."""

from __future__ import annotations

from pathlib import Path
from typing import Final

SYSFS: Final = Path("/sys")


def read_text(path: Path) -> str | None:
    """Text of the file without white space around it; None if it is missing, unreadable or empty."""
    try:
        return path.read_text(encoding="ascii", errors="replace").strip() or None
    except OSError:
        return None


def read_int(path: Path) -> int | None:
    """Whole number in the file; None if there is none."""
    text = read_text(path)
    try:
        return None if text is None else int(text)
    except ValueError:
        return None


def hwmon_named(sysfs_root: Path, name: str) -> list[Path]:
    """Folders of hwmon devices whose `name` is that one; their index differs from boot to boot."""
    return [path for path in sorted((sysfs_root / "class/hwmon").glob("hwmon*")) if read_text(path / "name") == name]
