"""Over-current and under-voltage events that a Jetson's hardware has throttled for.

The counters run since boot, and one of thousands is no fault by itself: what matters is how many a run has added.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

from edge.core.sysfs import SYSFS, hwmon_named, read_int

EVENTS: Final[Mapping[str, str]] = {
    "oc1": "under-voltage",
    "oc2": "average over-current",
    "oc3": "instantaneous over-current",
}
_PLATFORM = "devices/platform/**/soctherm-oc-event/hwmon/hwmon*"


class OverCurrentEvents:
    """Events by counter since this object was made; empty on boards without such counters."""

    def __init__(self, sysfs_root: Path = SYSFS) -> None:
        folders = hwmon_named(sysfs_root, "soctherm_oc") or sorted(sysfs_root.glob(_PLATFORM))
        self._files = {name: path for f in folders for name in EVENTS if (path := f / f"{name}_event_cnt").exists()}
        self._last = {name: count for name, path in self._files.items() if (count := read_int(path)) is not None}
        self._events = dict.fromkeys(self._last, 0)

    def read(self) -> dict[str, int]:
        """Events so far; a counter that went back was reset and counts from zero."""
        for name, last in self._last.items():
            count = read_int(self._files[name])
            if count is not None:
                self._events[name] += count - last if count >= last else count
                self._last[name] = count
        return dict(self._events)
