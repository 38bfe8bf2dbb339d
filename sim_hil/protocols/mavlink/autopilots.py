"""What distinguishes the two autopilots that the rover can announce: numbers of modes and of the autopilot itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from pymavlink.dialects.v20 import common

from sim_hil.protocols.mavlink.vehicle import Mode, custom_mode_of, find_mode

# ROVER_MODE of MAVLink's ardupilotmega dialect; GUIDED is ArduPilot's mode for setpoints.
_ARDUPILOT_MODES: Final = {Mode.MANUAL: 0, Mode.HOLD: 4, Mode.OFFBOARD: 15}


@dataclass(frozen=True)
class Autopilot:
    """Personality of the rover. `has_odometry`: it sends ODOMETRY; `stays`: it stays in a mode without setpoints."""

    name: str
    number: int
    has_odometry: bool
    stays: bool

    def custom_mode(self, mode: Mode) -> int:
        """Return the value of a heartbeat's `custom_mode`."""
        return _ARDUPILOT_MODES[mode] if self.name == "ardupilot" else mode.custom_mode

    def mode_of(self, custom_mode: int) -> Mode | None:
        """Return the mode of a SET_MODE's `custom_mode`; None if unknown."""
        return self.find(custom_mode, 0) if self.name == "ardupilot" else custom_mode_of(custom_mode)

    def find(self, main: int, sub: int) -> Mode | None:
        """Return the mode of a DO_SET_MODE's param2 and param3; None if unknown."""
        if self.name == "ardupilot":
            return next((mode for mode, number in _ARDUPILOT_MODES.items() if number == main), None)
        return find_mode(main, sub)


PX4: Final = Autopilot("px4", common.MAV_AUTOPILOT_PX4, has_odometry=True, stays=False)
ARDUPILOT: Final = Autopilot("ardupilot", common.MAV_AUTOPILOT_ARDUPILOTMEGA, has_odometry=False, stays=True)
BY_NAME: Final = {each.name: each for each in (PX4, ARDUPILOT)}
