"""Parameters of the vehicle: a table with ranges, encoded as in PX4 (integers bytewise in the float) or ArduPilot."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from math import inf, isfinite
from types import MappingProxyType
from typing import Final

from pymavlink.dialects.v20 import common

from sim_hil.protocols.mavlink.wire import Message

_INT: Final = common.MAV_PARAM_TYPE_INT32
_REAL: Final = common.MAV_PARAM_TYPE_REAL32


@dataclass(frozen=True)
class Parameter:
    """Default and range of a parameter; `integer` selects its type on the wire."""

    default: float
    low: float
    high: float
    integer: bool = False

    @property
    def wire_type(self) -> int:
        """Value of MAV_PARAM_TYPE."""
        return int(_INT if self.integer else _REAL)


# Names are those of PX4 where it has a parameter with the same meaning.
TABLE: Final[Mapping[str, Parameter]] = MappingProxyType(
    {
        "BAT_LOW_THR": Parameter(0.10, 0.0, 0.9),  # charge (0..1) at or below which arming is denied
        "COM_ARM_TILT": Parameter(25.0, 5.0, 60.0),  # tilt beyond which arming is denied, degrees
        "COM_DISARM_GCS": Parameter(2.0, 0.0, 60.0),  # time from the loss of the station to the disarm, s
        "COM_DL_LOSS_T": Parameter(3.5, 1.5, 60.0),  # timeout of the station's heartbeat, s: three are missed
        "COM_OBL_RC_ACT": Parameter(5, 5, 5, integer=True),  # reaction to missing setpoints: hold
        "COM_OF_LOSS_T": Parameter(0.5, 0.1, 1.0),  # timeout of setpoints, s; the drive's own timeout is 1 s
        "MAV_GCS_SYSID": Parameter(0, 0, 255, integer=True),  # number of the only station that may drive; 0: any
        "MAV_SYS_ID": Parameter(1, 1, 255, integer=True),
        "RO_MAN_SPEED": Parameter(0.6, 0.1, 1.5),  # m/s at full stick
        "RO_MAN_YAW_RATE": Parameter(60.0, 10.0, 115.0),  # degrees/s at full stick
        "RO_SPEED_LIM": Parameter(1.5, 0.1, 1.5),  # m/s
        "RO_YAW_RATE_LIM": Parameter(115.0, 10.0, 115.0),  # degrees/s
    }
)
NAMES: Final = tuple(TABLE)
# The names and ranges of ArduPilot Rover. A missing station makes it hold; only the timeout and the switch have effect.
ARDUPILOT_TABLE: Final[Mapping[str, Parameter]] = MappingProxyType(
    {
        "FS_ACTION": Parameter(2, 0, 5, integer=True),
        "FS_GCS_ENABLE": Parameter(1, 0, 2, integer=True),
        "FS_GCS_TIMEOUT": Parameter(5.0, 2.0, 120.0),
        "FS_TIMEOUT": Parameter(1.5, 1.0, 100.0),
        "SYSID_MYGCS": Parameter(255, 1, 255, integer=True),
    }
)
_ARDUPILOT_SETPOINT_S: Final = 3.0  # fixed in its source
_READ_ONLY: Final = ("MAV_SYS_ID",)  # stations address the rover by it; set on the command line


class Parameters:
    """Parameter values of one vehicle."""

    def __init__(self, autopilot: str = "px4", **given: float) -> None:
        """Set the defaults, replaced by `given`. Raises ValueError for an unknown name or a bad value.

        With `autopilot` "ardupilot", stations see ARDUPILOT_TABLE, and the rover's own values keep their defaults.
        """
        self._is_ardupilot = autopilot == "ardupilot"
        self.table = ARDUPILOT_TABLE if self._is_ardupilot else TABLE
        self.names = tuple(self.table)
        self._values = {name: parameter.default for name, parameter in {**TABLE, **self.table}.items()}
        if self._is_ardupilot:
            self._values["COM_OF_LOSS_T"] = _ARDUPILOT_SETPOINT_S
        for name, value in given.items():
            table = self.table if name in self.table else TABLE
            if name not in table or not _fits(table[name], value):
                raise ValueError(f"parameter {name}: expected a known name and a value in its range, found {value}")
            self._values[name] = float(value)

    def __getitem__(self, name: str) -> float:
        if self._is_ardupilot and name == "COM_DL_LOSS_T":
            return self._values["FS_GCS_TIMEOUT"] if self._values["FS_GCS_ENABLE"] else inf
        return self._values[name]

    def set(self, message: Message) -> str | None:
        """Execute a PARAM_SET; return the name, even if the value is refused; None for an unknown name."""
        name = message.param_id
        if name not in self.table:
            return None
        bytewise = not self._is_ardupilot
        value = decode_value(message.param_value, message.param_type) if bytewise else message.param_value
        parameter = self.table[name]
        if message.param_type == parameter.wire_type and name not in _READ_ONLY and _fits(parameter, value):
            self._values[name] = value
        return str(name)

    def message(self, name: str) -> Message:
        """Return the PARAM_VALUE message of a parameter."""
        parameter, value = self.table[name], self._values[name]
        wire = _from_int(round(value)) if parameter.integer and not self._is_ardupilot else value
        return common.MAVLink_param_value_message(
            name.encode("ascii"), wire, parameter.wire_type, len(self.names), self.names.index(name)
        )


def _fits(parameter: Parameter, value: float) -> bool:
    return isfinite(value) and parameter.low <= value <= parameter.high


def _from_int(value: int) -> float:
    return float(struct.unpack("<f", struct.pack("<i", value))[0])


def decode_value(value: float, wire_type: int) -> float:
    """Decode the value of a PARAM_SET or PARAM_VALUE."""
    if wire_type == _INT:
        return float(struct.unpack("<i", struct.pack("<f", value))[0])
    return value
