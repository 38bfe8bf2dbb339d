"""Modes of a rover: the autopilots' numbers, and the few kinds of mode that the bridge distinguishes. No library."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

DRIVE, HOLD, PILOT, OTHER = "drive", "hold", "pilot", "other"
"""Kinds of mode: setpoints drive the rover; it stands; a person's sticks drive it; the autopilot drives by itself."""

# Modes of a RobotState: our own numbers, of the kind of mode and of whether the motors are armed.
DISARMED: Final = 1
DISARMED_DRIVE: Final = 2
ARMED_DRIVE: Final = 3
ARMED_HOLD: Final = 4
ARMED_PILOT: Final = 5
ARMED_OTHER: Final = 6
MODE_NAMES: Final[Mapping[int, str]] = {
    DISARMED: "disarmed",
    DISARMED_DRIVE: "disarmed in the setpoint mode",
    ARMED_DRIVE: "armed in the setpoint mode",
    ARMED_HOLD: "armed in hold",
    ARMED_PILOT: "armed in a mode of the remote",
    ARMED_OTHER: "armed in an automatic mode",
}

# Steps of a RobotTable.
STEP_HOLD: Final = 1
STEP_DRIVE: Final = 2
STEP_ARM: Final = 3
STEP_NAMES: Final[Mapping[int, str]] = {STEP_HOLD: "hold", STEP_DRIVE: "setpoint mode", STEP_ARM: "arm"}

_PX4_MAIN_SHIFT: Final = 16
_PX4_SUB_SHIFT: Final = 24
_PX4_AUTO: Final = 4
_PX4_LOITER: Final = 3
_PX4_OFFBOARD: Final = 6
# px4_custom_mode.h: manual, altitude, position, acro, stabilized.
_PX4_PILOT: Final = frozenset({1, 2, 3, 5, 7})


@dataclass(frozen=True)
class Autopilot:
    """One autopilot's numbers. `heartbeat`: its MAV_AUTOPILOT; `drive`, `hold`: param2 and param3 of DO_SET_MODE.

    `stream_first_s`: time for which setpoints must have arrived before it accepts the drive mode.
    """

    name: str
    heartbeat: int
    drive: tuple[int, int]
    hold: tuple[int, int]
    stream_first_s: float

    def kind_of(self, custom_mode: int) -> str:
        """Return the kind of a heartbeat's `custom_mode`; an unknown mode is one in which the autopilot drives."""
        if self.name == "ardupilot":
            return _ARDUPILOT_KINDS.get(custom_mode, OTHER)
        main, sub = custom_mode >> _PX4_MAIN_SHIFT & 0xFF, custom_mode >> _PX4_SUB_SHIFT & 0xFF
        if main == _PX4_OFFBOARD:
            return DRIVE
        if (main, sub) == (_PX4_AUTO, _PX4_LOITER):
            return HOLD
        return PILOT if main in _PX4_PILOT else OTHER


# ROVER_MODE of MAVLink's ardupilotmega dialect: manual, acro, steering, hold, simple, guided.
_ARDUPILOT_KINDS: Final[Mapping[int, str]] = {0: PILOT, 1: PILOT, 3: PILOT, 4: HOLD, 7: PILOT, 15: DRIVE}

PX4: Final = Autopilot("px4", 12, (_PX4_OFFBOARD, 0), (_PX4_AUTO, _PX4_LOITER), 1.1)  # it asks for one second
ARDUPILOT: Final = Autopilot("ardupilot", 3, (15, 0), (4, 0), 0.0)
BY_NAME: Final[Mapping[str, Autopilot]] = {each.name: each for each in (PX4, ARDUPILOT)}


def name_of_heartbeat(autopilot: int) -> str:
    """Return the name of a heartbeat's MAV_AUTOPILOT, for the comparison with the robot file."""
    names = {each.heartbeat: each.name for each in BY_NAME.values()}
    return names.get(autopilot, f"autopilot number {autopilot}")


def mode_of(kind: str, armed: bool) -> int:
    """Return the RobotState mode of a kind of mode."""
    if not armed:
        return DISARMED_DRIVE if kind == DRIVE else DISARMED
    return {DRIVE: ARMED_DRIVE, HOLD: ARMED_HOLD, PILOT: ARMED_PILOT, OTHER: ARMED_OTHER}[kind]
