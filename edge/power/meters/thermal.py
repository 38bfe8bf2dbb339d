"""Reads temperatures, and whether heat or over-current throttles the machine's clocks.

Zones are found by `type`, because numbers differ between boards and releases. The relevant values are distances to the
board's trip points: at `passive` Linux begins to throttle, at `critical` it cuts the power.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from edge.core.sysfs import SYSFS, hwmon_named, read_int, read_text

JUNCTION: Final = ("tj-thermal", "tj-therm", "Tj-therm")
"""Zone of Jetson's hottest point; on some carrier boards it exists without a reading."""
LOWEST_C, HIGHEST_C = -40.0, 150.0
"""A disabled Jetson zone reads -256 °C."""
LOWEST_TRIP_C: Final = 50.0
"""Passive trips below this are unset user trips."""
WARNS_ONLY: Final = "hot-surface-alert"
"""Jetson's cooling device that warns of a hot surface from 70 °C on and throttles nothing."""
# A running fan is no throttling, and some boards cap devfreq at rest.
_THROTTLES = re.compile(r"(.*-throttle-alert|Processor|(thermal-)?cpufreq-(cpu)?\d+)")
EVENTS: Final = ("oc1", "oc2", "oc3")
"""Counters of under-voltage, average over-current and instantaneous over-current."""
_EVENT_FOLDERS = "devices/platform/**/soctherm-oc-event/hwmon/hwmon*"


@dataclass(frozen=True)
class ThermalState:
    """One reading; None for a value that the board does not report."""

    stamp_ns: int
    zones_c: Mapping[str, float] = field(default_factory=dict)
    hottest_c: float | None = None
    throttle_margin_c: float | None = None
    """Degrees below the nearest passive trip point; negative above it."""
    trip_margin_c: float | None = None
    """Degrees below the nearest critical trip point."""
    throttling: tuple[str, ...] = ()
    """Present causes of throttling."""

    @property
    def throttled(self) -> bool:
        """Whether clocks are throttled now."""
        return bool(self.throttling)


@dataclass(frozen=True)
class _Zone:
    name: str
    temp: Path
    passive_c: float | None
    critical_c: float | None


class ThermalReader:
    """Reads zones, cooling devices and throttle counters below a sysfs root."""

    def __init__(self, sysfs_root: Path = SYSFS) -> None:
        thermal = sysfs_root / "class/thermal"
        self._zones = [zone for path in sorted(thermal.glob("thermal_zone*")) if (zone := _zone(path)) is not None]
        self._cooling = [
            (name, path / "cur_state")
            for path in sorted(thermal.glob("cooling_device*"))
            if (name := read_text(path / "type")) is not None and _THROTTLES.fullmatch(name)
        ]
        cpus = sysfs_root / "devices/system/cpu"
        self._counters = sorted(cpus.glob("cpu[0-9]*/thermal_throttle/package_throttle_count"))
        self._counts = {path: read_int(path) for path in self._counters}

    def read(self, now_ns: int) -> ThermalState:
        """Return one reading without the unreadable values; never raises."""
        zones: dict[str, float] = {}
        throttle_c: list[float] = []
        trip_c: list[float] = []
        for zone in self._zones:
            milli_c = read_int(zone.temp)
            if milli_c is None or not LOWEST_C <= milli_c / 1e3 <= HIGHEST_C:
                continue
            zones[zone.name] = max(milli_c / 1e3, zones.get(zone.name, LOWEST_C))
            if zone.passive_c is not None:
                throttle_c.append(zone.passive_c - milli_c / 1e3)
            if zone.critical_c is not None:
                trip_c.append(zone.critical_c - milli_c / 1e3)
        return ThermalState(
            stamp_ns=now_ns,
            zones_c=zones,
            hottest_c=next((zones[name] for name in JUNCTION if name in zones), max(zones.values(), default=None)),
            throttle_margin_c=min(throttle_c, default=None),
            trip_margin_c=min(trip_c, default=None),
            throttling=self._throttling(),
        )

    def _throttling(self) -> tuple[str, ...]:
        found = [name for name, path in self._cooling if (read_int(path) or 0) > 0]
        for path in self._counters:
            count, last = read_int(path), self._counts[path]
            if count is not None and last is not None and count > last:
                found.append(f"{path.parent.parent.name} package")
            self._counts[path] = count
        return tuple(found)


def _zone(path: Path) -> _Zone | None:
    name = read_text(path / "type")
    if name is None:
        return None
    trips: dict[str, list[float]] = {"passive": [], "critical": []}
    for kind_file in sorted(path.glob("trip_point_*_type")):
        kind = read_text(kind_file)
        milli_c = read_int(kind_file.with_name(kind_file.name.replace("_type", "_temp")))
        if kind == "passive" and _bound(path, kind_file.name.split("_")[2]) == {WARNS_ONLY}:
            continue
        if kind in trips and milli_c is not None and LOWEST_TRIP_C <= milli_c / 1e3 <= HIGHEST_C:
            trips[kind].append(milli_c / 1e3)
    return _Zone(name, path / "temp", min(trips["passive"], default=None), min(trips["critical"], default=None))


def _bound(zone: Path, trip: str) -> set[str]:
    """Return the types of the cooling devices that a zone's trip point controls."""
    files = [path for path in zone.glob("cdev*_trip_point") if read_text(path) == trip]
    return {name for path in files if (name := read_text(zone / path.name.partition("_")[0] / "type")) is not None}


class OverCurrentEvents:
    """Count of over-current and under-voltage events that throttled a Jetson since this object's creation.

    The hardware counts since boot; only the events of this run matter. Empty on boards without such counters.
    """

    def __init__(self, sysfs_root: Path = SYSFS) -> None:
        folders = hwmon_named(sysfs_root, "soctherm_oc") or sorted(sysfs_root.glob(_EVENT_FOLDERS))
        self._files = {name: path for f in folders for name in EVENTS if (path := f / f"{name}_event_cnt").exists()}
        self._last = {name: count for name, path in self._files.items() if (count := read_int(path)) is not None}
        self._events = dict.fromkeys(self._last, 0)

    def read(self) -> dict[str, int]:
        """Return the events so far by counter; a counter that decreased was reset and counts from zero."""
        for name, last in self._last.items():
            count = read_int(self._files[name])
            if count is not None:
                self._events[name] += count - last if count >= last else count
                self._last[name] = count
        return dict(self._events)
