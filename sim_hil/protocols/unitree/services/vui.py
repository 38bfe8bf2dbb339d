"""Service vui: stores volume, brightness and switch of the robot's face, without any effect. Pure."""

from __future__ import annotations

import json
from typing import Final

from firmware_bridge.unitree.messages import ids
from sim_hil.protocols.unitree.services.parameters import parse_numbers
from sim_hil.protocols.unitree.services.service import Answer

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
