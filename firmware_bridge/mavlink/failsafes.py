"""The autopilot's own failsafe parameters: read before every arming, compared with the robot file. Pure."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Final

from firmware_bridge.core.config import MavlinkConfig

_RETRY_NS: Final = 200_000_000
_RECHECK_NS: Final = 2_000_000_000  # while one is weak: an operator may just have corrected it
_INTEGERS: Final = {1: "<B", 2: "<b", 3: "<H", 4: "<h", 5: "<I", 6: "<i"}  # MAV_PARAM_TYPE
_BYTES: Final = 4


@dataclass(frozen=True)
class Expectation:
    """What a parameter must be: at most `most`, or one of `values`. `names`: the same one in different versions."""

    names: tuple[str, ...]
    most: float = math.inf
    values: tuple[int, ...] = ()
    unit: str = ""
    meaning: str = ""

    def complaint(self, value: float) -> str | None:
        """Return what is wrong with a value and how to correct it; None for a good one."""
        if self.values:
            good, wanted = value in self.values, " or ".join(map(str, self.values))
        else:
            good, wanted = 0 <= value <= self.most, f"at most {self.most:g}{self.unit}"
        if good:
            return None
        name, best = self.names[0], self.values[0] if self.values else self.most
        meaning = f" ({self.meaning})" if self.meaning else ""
        return f"{name} is {value:g}{self.unit}, expected {wanted}{meaning}; set it with: param set {name} {best:g}"


def expectations(config: MavlinkConfig) -> tuple[Expectation, ...]:
    """Return what the robot file requires of this autopilot.

    PX4 leaves offboard mode COM_OF_LOSS_T after the last setpoint; COM_DL_LOSS_T watches ground stations only, not the
    bridge, which is an onboard computer (Commander.cpp, `heartbeat_type_gcs`). ArduPilot Rover stops 3 s after the last
    setpoint, which no parameter changes (mode_guided.cpp), and reacts to missing heartbeats of the station SYSID_MYGCS.
    """
    if config.autopilot == "ardupilot":
        return (
            Expectation(("FS_GCS_ENABLE",), values=(1,), meaning="react to missing heartbeats"),
            Expectation(("FS_ACTION",), values=(2,), meaning="hold"),
            Expectation(("FS_TIMEOUT",), most=config.station_loss_max_s, unit=" s"),
            Expectation(("FS_GCS_TIMEOUT",), most=config.station_loss_max_s, unit=" s"),
            Expectation(("SYSID_MYGCS", "MAV_GCS_SYSID"), values=(config.station,), meaning="the bridge's number"),
        )
    return (
        Expectation(("COM_OF_LOSS_T",), most=config.setpoint_loss_max_s, unit=" s"),
        Expectation(("COM_OBL_RC_ACT",), values=(5, 6, 7), meaning="hold, terminate or disarm"),
        Expectation(("COM_DL_LOSS_T",), most=config.station_loss_max_s, unit=" s"),
    )


class FailsafeCheck:
    """Reads the expected parameters one after the other; `unsafe` is the first complaint, None without one."""

    def __init__(self, config: MavlinkConfig) -> None:
        self.unsafe: str | None = None
        self._bytewise = config.autopilot == "px4"
        self._expected = expectations(config)
        self._values: dict[str, float] = {}
        self._missing: set[Expectation] = set()
        self._retry_ns = self._recheck_ns = 0
        self._turn = 0

    def begin(self) -> None:
        """Read all parameters again, unless that is under way."""
        if not self._missing:
            self._missing, self._retry_ns = set(self._expected), 0

    @property
    def is_complete(self) -> bool:
        """Whether every parameter was read since the last `begin`."""
        return not self._missing and bool(self._values)

    @property
    def missing(self) -> str:
        """Names of the parameters that have not been answered yet."""
        return ", ".join(each.names[0] for each in self._expected if each in self._missing)

    def due(self, now_ns: int) -> list[str]:
        """Return the names to request now; a weak parameter is requested again until it is strong enough."""
        if self.unsafe is not None and not self._missing and now_ns >= self._recheck_ns:
            self._recheck_ns = now_ns + _RECHECK_NS
            self.begin()
        if not self._missing or now_ns < self._retry_ns:
            return []
        self._retry_ns, self._turn = now_ns + _RETRY_NS, self._turn + 1
        waiting = [each for each in self._expected if each in self._missing]
        return [each.names[self._turn % len(each.names)] for each in waiting]

    def value(self, name: str, value: float, wire_type: int) -> None:
        """Take a PARAM_VALUE, also one that another station has caused."""
        expected = next((each for each in self._expected if name in each.names), None)
        if expected is None:
            return
        if self._bytewise and wire_type in _INTEGERS:
            value = float(struct.unpack_from(_INTEGERS[wire_type], struct.pack("<f", value).ljust(_BYTES, b"\0"))[0])
        self._values[expected.names[0]] = value if math.isfinite(value) else math.inf
        self._missing.discard(expected)
        complaints = [
            each.complaint(self._values[each.names[0]]) for each in self._expected if each.names[0] in self._values
        ]
        self.unsafe = next((each for each in complaints if each is not None), None)
