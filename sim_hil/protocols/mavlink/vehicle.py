"""State machine of the rover: control by one station, modes, arming, failsafes. Pure: no clock, no network.

All times are the robot's own clock, s. One station is in control: the first that sends a request related to motion. It
stays in control until it disarms the base or falls silent, or until another station changes the mode: PX4 and
ArduPilot accept a mode from every station. Every station may receive reports and stop the base. The modes have PX4's
numbers (px4_custom_mode.h).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from math import degrees, radians
from typing import Final, NamedTuple

from pymavlink.dialects.v20 import common

from sim_hil.protocols.base import Base
from sim_hil.protocols.mavlink.parameters import Parameters
from sim_hil.protocols.mavlink.setpoints import Setpoint, Sticks

_MAIN_SHIFT: Final = 16
_SUB_SHIFT: Final = 24


class Mode(Enum):
    """Mode of the rover; the value is PX4's (main mode, sub mode)."""

    MANUAL = (1, 0)
    HOLD = (4, 3)  # AUTO, LOITER
    OFFBOARD = (6, 0)

    @property
    def custom_mode(self) -> int:
        """Value of a heartbeat's `custom_mode`."""
        main, sub = self.value
        return int(main) << _MAIN_SHIFT | int(sub) << _SUB_SHIFT

    @property
    def base_flags(self) -> int:
        """Bits of a heartbeat's `base_mode` for this mode."""
        flags = {
            Mode.MANUAL: common.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED,
            Mode.HOLD: common.MAV_MODE_FLAG_AUTO_ENABLED | common.MAV_MODE_FLAG_GUIDED_ENABLED,
            Mode.OFFBOARD: common.MAV_MODE_FLAG_GUIDED_ENABLED,
        }
        return int(common.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | flags[self])


def find_mode(main: int, sub: int) -> Mode | None:
    """Return the mode of a main and a sub mode; sub mode 0 selects the main mode's only one. None if unknown."""
    for mode in Mode:
        if mode.value[0] == main and sub in (0, mode.value[1]):
            return mode
    return None


def custom_mode_of(value: int) -> Mode | None:
    """Return the mode of a `custom_mode` value; None if unknown."""
    return find_mode(value >> _MAIN_SHIFT & 0xFF, value >> _SUB_SHIFT & 0xFF)


_COMMAND_S: Final = 0.02  # period at which a setpoint in the local frame is converted to the base's frame
_NEVER_S: Final = -1e9
_STOP: Final = (0.0, 0.0, 0.0)
_SEVERITY_STOPPED: Final = common.MAV_SEVERITY_CRITICAL
_SEVERITY_REFUSED: Final = common.MAV_SEVERITY_WARNING
_SEVERITY_NEWS: Final = common.MAV_SEVERITY_INFO
ACCEPTED: Final[int] = common.MAV_RESULT_ACCEPTED
REJECTED: Final[int] = common.MAV_RESULT_TEMPORARILY_REJECTED
DENIED: Final[int] = common.MAV_RESULT_DENIED
FAILED: Final[int] = common.MAV_RESULT_FAILED
_MAX_TEXTS: Final = 20


class Station(NamedTuple):
    """Sender of a message; the address distinguishes two ground stations with the same MAVLink number."""

    system: int
    address: tuple[str, int]


class Text(NamedTuple):
    """One line of text for the operator; `severity` is MAV_SEVERITY."""

    severity: int
    text: str


@dataclass(frozen=True)
class Health:
    """State for the arming checks: charge 0..1, tilt of the base, rad; and its yaw in the local frame, rad."""

    charge: float = 1.0
    tilt_rad: float = 0.0
    yaw_rad: float = 0.0


class Vehicle:
    """State machine of one rover; call `step` after every physics step."""

    def __init__(self, base: Base, parameters: Parameters, *, stays: bool = False) -> None:
        """`stays`: without setpoints it stops but stays in OFFBOARD, as ArduPilot does in its mode GUIDED."""
        self._base = base
        self._stays = stays
        self._parameters = parameters
        self.armed = False
        self.mode = Mode.HOLD
        self.estop = False
        self.failsafe = False
        """Whether a failsafe has left the rover in its mode; the next mode ends it."""
        self.button = False
        self.pilot = False
        """A person has switched the remote to MANUAL; when it ends, to HOLD."""
        self._had_pilot = False
        self.health = Health()
        self.controller: Station | None = None
        self.refused_setpoints = 0
        self._heartbeats_s: dict[Station, float] = {}
        self._offered_s: dict[Station, float] = {}  # a station's last setpoint, also one that was refused
        self._controller_s = 0.0
        self._setpoint: Setpoint | None = None
        self._setpoint_s = _NEVER_S
        self._sticks: Sticks | None = None
        self._sticks_s = _NEVER_S
        self._station_lost = False
        self._next_command_s = 0.0
        self._texts: list[Text] = []

    def take_texts(self) -> list[Text]:
        """Return the texts since the last call."""
        texts, self._texts = self._texts, []
        return texts

    def send_text(self, severity: int, text: str) -> None:
        """Queue a text for the operator; the queue is bounded."""
        if len(self._texts) < _MAX_TEXTS:
            self._texts.append(Text(severity, text))

    # Stations

    def heartbeat(self, station: Station, now_s: float) -> None:
        """Register a heartbeat of a station."""
        self._heartbeats_s[station] = now_s
        if station == self.controller:
            self._controller_s = now_s
            self._station_lost = False

    def forget_silent(self, now_s: float) -> None:
        """Remove stations whose heartbeats have timed out."""
        loss_s = self._parameters["COM_DL_LOSS_T"]
        heartbeats = self._heartbeats_s.items()
        self._heartbeats_s = {station: at_s for station, at_s in heartbeats if now_s - at_s <= loss_s}
        self._offered_s = {station: at_s for station, at_s in self._offered_s.items() if self._fresh(at_s, now_s)}

    def take_control(self, station: Station, now_s: float) -> bool:
        """Give `station` control if no other station has it; return whether it is in control."""
        if not self._is_permitted(station):
            return False
        if station == self.controller:
            return True
        if self.controller is not None and (self.armed or not self._silent(now_s)):
            return False
        self._hand_over(station, now_s)
        return True

    def _is_permitted(self, station: Station) -> bool:
        return int(self._parameters["MAV_GCS_SYSID"]) in (0, station.system)

    def _hand_over(self, station: Station, now_s: float) -> None:
        self.controller = station
        self._controller_s = self._heartbeats_s.get(station, now_s)
        self._setpoint = self._sticks = None
        self._station_lost = False

    def may_change(self, station: Station, now_s: float) -> bool:
        """Return whether `station` may change settings that the station in control relies on."""
        return self.controller in (None, station) or (not self.armed and self._silent(now_s))

    def _silent(self, now_s: float) -> bool:
        return now_s - self._controller_s > self._parameters["COM_DL_LOSS_T"]

    # Requests

    def obstacle_to_arming(self, *, forced: bool = False) -> str | None:
        """Return why arming is denied, or None; `forced` skips the checks of battery and tilt."""
        if self.button:
            return "emergency stop button pressed"
        if self.estop:
            return "emergency stop: send a disarm first"
        if forced:
            return None
        if self.health.charge <= self._parameters["BAT_LOW_THR"]:
            return f"battery low ({100 * self.health.charge:.0f} %)"
        if self.health.tilt_rad > radians(self._parameters["COM_ARM_TILT"]):
            return f"tilted by {degrees(self.health.tilt_rad):.0f} degrees"
        return None

    def arm(self, station: Station, now_s: float, *, forced: bool = False) -> int:
        """Arm the base; return MAV_RESULT."""
        if not self.take_control(station, now_s):
            return self._refuse("Arming denied: another station is in control", REJECTED)
        if self.armed:
            return ACCEPTED
        obstacle = self.obstacle_to_arming(forced=forced)
        if obstacle is not None:
            return self._refuse(f"Arming denied: {obstacle}", FAILED)
        self.armed = True
        self._base.stand()
        self.send_text(_SEVERITY_NEWS, "Armed")
        return ACCEPTED

    def disarm(self, station: Station, now_s: float) -> int:
        """Disarm the base and release an emergency stop unless the button is pressed; return MAV_RESULT."""
        if not self.take_control(station, now_s):
            return self._refuse("Disarming denied: another station is in control", REJECTED)
        if self.button:
            return self._refuse("Emergency stop button pressed", FAILED)
        if self.estop:
            self.estop = False
            self._base.release_estop()
            self.send_text(_SEVERITY_NEWS, "Emergency stop released")
        self._disarm("Disarmed")
        self.controller = None
        return ACCEPTED

    def emergency_stop(self, why: str) -> int:
        """Brake hard and latch the stop, for a request of any station; return MAV_RESULT."""
        if not self.estop:
            self.estop = True
            self._base.press_estop()
            self.send_text(common.MAV_SEVERITY_EMERGENCY, f"Emergency stop: {why}")
        self.armed = False
        self._leave()
        return ACCEPTED

    def set_mode(self, station: Station, mode: Mode | None, now_s: float) -> int:
        """Set the mode, None for an unknown one; return MAV_RESULT. A station that changes the mode takes control."""
        if not self._is_permitted(station):
            return self._refuse("Mode denied: another station is in control", REJECTED)
        if mode is None:
            return self._refuse("Mode denied: expected MANUAL, HOLD or OFFBOARD", DENIED)
        offered_s = self._offered_s.get(station, _NEVER_S)
        if mode is Mode.OFFBOARD and not self._stays and not self._fresh(offered_s, now_s):
            return self._refuse("Offboard denied: no setpoints", REJECTED)
        if mode is not self.mode:
            if not self.take_control(station, now_s):
                self._hand_over(station, now_s)
                self._setpoint_s = offered_s
            if mode is Mode.OFFBOARD:
                self._sticks = None
            elif self.armed:
                self._base.command(*_STOP)
            self.mode = mode
            self.send_text(_SEVERITY_NEWS, f"Mode {mode.name}")
        self.failsafe = False
        self._next_command_s = now_s
        return ACCEPTED

    def setpoint(self, station: Station, setpoint: Setpoint, now_s: float) -> bool:
        """Apply a setpoint; return whether it came from the station in control."""
        self._offered_s[station] = now_s
        if not self.take_control(station, now_s):
            self.refused_setpoints += 1
            return False
        self._setpoint, self._setpoint_s, self._next_command_s = setpoint, now_s, now_s
        self._drive(now_s)
        return True

    def sticks(self, station: Station, sticks: Sticks | None, now_s: float) -> bool:
        """Apply stick positions, None if released; return whether they came from the station in control."""
        if not self.take_control(station, now_s):
            self.refused_setpoints += 1
            return False
        self._sticks, self._sticks_s, self._next_command_s = sticks or Sticks(), now_s, now_s
        self._drive(now_s)
        return True

    # Failsafes and driving

    def step(self, now_s: float) -> None:
        """Advance to `now_s`: apply button, failsafes and the current command."""
        if self.button and not self.estop:
            self.emergency_stop("button")
        if self.armed:
            self._watch_station(now_s)
        if self.pilot and not self._had_pilot:
            self._base.command(*_STOP)
            self._leave()
            self.mode = Mode.MANUAL
            self.send_text(_SEVERITY_NEWS, "Mode MANUAL by the remote")
        if self._had_pilot and not self.pilot:
            self._hold("Mode HOLD by the remote")
        self._had_pilot = self.pilot
        if self.armed and self.mode is Mode.OFFBOARD and not self._fresh(self._setpoint_s, now_s):
            self._lose_setpoints()
        if self.armed and self._sticks is not None and not self._fresh(self._sticks_s, now_s):
            self._sticks = None
            if self.mode is Mode.MANUAL:
                self._fail_safe("Failsafe: no sticks, holding")
        self._drive(now_s)

    def _lose_setpoints(self) -> None:
        if not self._stays:
            self._fail_safe("Failsafe: no setpoints, holding")
        elif self._setpoint is not None:
            self._setpoint = None
            self._base.command(*_STOP)
            self.send_text(_SEVERITY_REFUSED, "target not received last 3secs, stopping")

    def _watch_station(self, now_s: float) -> None:
        silent_s = now_s - self._controller_s
        loss_s = self._parameters["COM_DL_LOSS_T"]
        if silent_s > loss_s and not self._station_lost:
            self._station_lost = True
            self._fail_safe("Failsafe: ground station lost, holding")
        if silent_s > loss_s + self._parameters["COM_DISARM_GCS"]:
            self._disarm("Failsafe: ground station lost, disarmed", _SEVERITY_STOPPED)
            self.controller = None

    def _fresh(self, at_s: float, now_s: float) -> bool:
        return now_s - at_s <= self._parameters["COM_OF_LOSS_T"]

    def _hold(self, why: str) -> None:
        if self.mode is not Mode.HOLD:
            self.send_text(_SEVERITY_STOPPED, why)
        self._leave()
        self._base.command(*_STOP)

    def _fail_safe(self, why: str) -> None:
        self._hold(why)
        self.failsafe = True

    def _leave(self) -> None:
        self.mode = Mode.HOLD
        self.failsafe = False
        self._setpoint = self._sticks = None
        self._setpoint_s = self._sticks_s = _NEVER_S
        self._offered_s.clear()

    def _disarm(self, why: str, severity: int = _SEVERITY_NEWS) -> None:
        if self.armed:
            self.armed = False
            self._base.rest()
            self.send_text(severity, why)
        self._leave()

    def _drive(self, now_s: float) -> None:
        if not self.armed or now_s < self._next_command_s:
            return
        command = self.wanted()
        if command is not None:
            self._next_command_s = now_s + _COMMAND_S
            self._base.command(command[0], 0.0, command[1])

    def wanted(self) -> tuple[float, float] | None:
        """Return the requested speed (m/s, forward) and yaw rate (rad/s, left) in this mode; None if there is none."""
        if self.mode is Mode.OFFBOARD and self._setpoint is not None:
            return self._limited(*self._setpoint.command(self.health.yaw_rad))
        if self.mode is Mode.MANUAL and self._sticks is not None:
            speed = self._sticks.ahead * self._parameters["RO_MAN_SPEED"]
            return self._limited(speed, -self._sticks.right * radians(self._parameters["RO_MAN_YAW_RATE"]))
        return None

    def _limited(self, v_mps: float, w_radps: float) -> tuple[float, float]:
        v_max, w_max = self._parameters["RO_SPEED_LIM"], radians(self._parameters["RO_YAW_RATE_LIM"])
        return max(-v_max, min(v_max, v_mps)), max(-w_max, min(w_max, w_radps))

    def _refuse(self, why: str, result: int) -> int:
        self.send_text(_SEVERITY_REFUSED, why)
        return int(result)
