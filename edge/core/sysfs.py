"""Numbers and names in small files of Linux; the root can be another folder."""

from __future__ import annotations

from pathlib import Path
from typing import Final

SYSFS: Final = Path("/sys")


def read_text(path: Path) -> str | None:
    """Return the file's stripped text; None if it is missing, unreadable or empty."""
    try:
        return path.read_text(encoding="ascii", errors="replace").strip() or None
    except OSError:
        return None


def read_int(path: Path) -> int | None:
    """Return the file's whole number; None without one."""
    text = read_text(path)
    try:
        return None if text is None else int(text)
    except ValueError:
        return None


def hwmon_named(sysfs_root: Path, name: str) -> list[Path]:
    """Return the folders of hwmon devices with that `name`; their index differs between boots."""
    return [path for path in sorted((sysfs_root / "class/hwmon").glob("hwmon*")) if read_text(path / "name") == name]
