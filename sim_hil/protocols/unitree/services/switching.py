"""Services motion_switcher (sport controller or low level), robot_state (switches services) and vui (settings). Pure.

Error codes: the maker's motion_switcher_error.hpp (7001 parameter, 7002 busy, 7004 name) and robot_state_error.hpp. The
client turns status 5 of a ServiceSwitch into 5202, service is protected.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Final

from firmware_bridge.unitree.messages import ids
from sim_hil.protocols.unitree.services.avoidance import Pilot
from sim_hil.protocols.unitree.services.behaviour import Go2Behaviour
from sim_hil.protocols.unitree.services.service import Answer, parse_flag, parse_numbers, parse_text

ERROR_SWITCH_PARAMETER: Final = 7001
ERROR_SWITCH_BUSY: Final = 7002
ERROR_SWITCH_NAME: Final = 7004
BUSY_S: Final = 2.0  # our choice: time during which the switcher is busy after a release
# The maker's modes: "normal" is the controller before firmware 1.1.6, "mcf" its name since; the others add tricks.
MODES: Final = ("normal", "mcf", "ai", "advanced")
PROTECTED: Final = 5
SPORT_MODE: Final = "sport_mode"
OBSTACLES_AVOID: Final = "obstacles_avoid"
_CHECK, _SELECT, _RELEASE, _SET_SILENT, _GET_SILENT = 1001, 1002, 1003, 1004, 1005
_SERVICE_SWITCH, _REPORT_FREQ, _SERVICE_LIST = 1001, 1002, 1003


class MotionSwitcher:
    """Service that assigns the joints to one of MODES, or to none, which enables low commands."""

    def __init__(self, behaviour: Go2Behaviour, mover: Pilot) -> None:
        """Create the service; `mover` is stopped on release."""
        self._behaviour = behaviour
        self._mover = mover
        self._name = MODES[0]
        self._silent = False
        self._released_s = -math.inf

    @property
    def engaged(self) -> bool:
        """Whether the sport controller has the joints."""
        return self._name != ""

    def handle(self, api_id: int, parameter: str) -> Answer:
        """Handle one request."""
        if api_id == _CHECK:
            return ids.OK, json.dumps({"form": "0", "name": self._name})
        if api_id == _SELECT:
            return self.select(parse_text(parameter, "name")), ""
        if api_id == _RELEASE:
            self.release()
            return ids.OK, ""
        if api_id == _SET_SILENT:
            silent = parse_flag(parameter, "silent")
            if silent is None:
                return ERROR_SWITCH_PARAMETER, ""
            self._silent = silent
            return ids.OK, ""
        if api_id == _GET_SILENT:
            return ids.OK, json.dumps({"silent": self._silent})
        return ids.ERROR_NOT_IMPLEMENTED, ""

    def select(self, name: str | None) -> int:
        """Assign the joints to the controller `name`; return 7002 within BUSY_S after a release."""
        if name is None:
            return ERROR_SWITCH_PARAMETER
        if name not in MODES:
            return ERROR_SWITCH_NAME
        if self._behaviour.time_s - self._released_s < BUSY_S:
            return ERROR_SWITCH_BUSY
        if not self.engaged:
            self._behaviour.engage()
        self._name = name
        return ids.OK

    def release(self) -> None:
        """Release the joints from their controller."""
        if self.engaged:
            self._mover.stop()
            self._behaviour.release()
            self._name, self._released_s = "", self._behaviour.time_s


class RobotState:
    """Service robot_state: lists services and switches sport controller and avoidance; the others are protected.

    SetReportFreq is accepted without effect: its report topic is not published by the maker.
    """

    def __init__(self, switcher: MotionSwitcher, avoidance: Callable[[bool | None], bool]) -> None:
        """Create the service; `avoidance` switches obstacles_avoid (None: no change) and returns its state."""
        self._switcher = switcher
        self._avoidance = avoidance

    def handle(self, api_id: int, parameter: str) -> Answer:
        """Handle one request."""
        if api_id == _SERVICE_LIST:
            return ids.OK, json.dumps(self._services())
        if api_id == _SERVICE_SWITCH:
            return self._switch(parse_text(parameter, "name"), parse_flag(parameter, "switch"))
        if api_id == _REPORT_FREQ:
            times = parse_numbers(parameter, "interval", "duration")
            if times is None or min(times) < 0:
                return ids.ERROR_PARAMETER, ""
            return ids.OK, ""
        return ids.ERROR_NOT_IMPLEMENTED, ""

    def _services(self) -> list[dict[str, object]]:
        on = {SPORT_MODE: self._switcher.engaged, OBSTACLES_AVOID: self._avoidance(None)}
        switched = [{"name": name, "status": int(is_on), "protect": 0} for name, is_on in on.items()]
        protected = ("video_hub", "robot_state", "motion_switcher")
        return switched + [{"name": name, "status": 1, "protect": 1} for name in protected]

    def _switch(self, name: str | None, on: bool | None) -> Answer:
        known = [service["name"] for service in self._services()]
        if name is None or on is None or name not in known:
            return ids.ERROR_PARAMETER, ""
        if name == OBSTACLES_AVOID:
            return ids.OK, json.dumps({"name": name, "status": int(self._avoidance(on))})
        if name != SPORT_MODE:
            return ids.OK, json.dumps({"name": name, "status": PROTECTED})
        if not on:
            self._switcher.release()
        elif not self._switcher.engaged and self._switcher.select(MODES[0]) != ids.OK:
            return ids.OK, json.dumps({"name": name, "status": 0})
        return ids.OK, json.dumps({"name": name, "status": int(self._switcher.engaged)})


VUI_SERVICE: Final = "vui"
# Set request -> key and highest value; the request with the next id reads the value back.
_SETTINGS: Final = {1001: ("enable", 1), 1003: ("volume", 10), 1005: ("brightness", 10)}


class Vui:
    """Service that stores settings."""

    def __init__(self) -> None:
        self._values = dict(_SETTINGS.values())

    def handle(self, api_id: int, parameter: str) -> Answer:
        """Handle one request."""
        if api_id in _SETTINGS:
            key, top = _SETTINGS[api_id]
            value = parse_numbers(parameter, key)
            if value is None or value[0] not in range(top + 1):
                return ids.ERROR_PARAMETER, ""
            self._values[key] = int(value[0])
            return ids.OK, ""
        if api_id - 1 in _SETTINGS:
            key, _ = _SETTINGS[api_id - 1]
            return ids.OK, json.dumps({key: self._values[key]})
        return ids.ERROR_NOT_IMPLEMENTED, ""
