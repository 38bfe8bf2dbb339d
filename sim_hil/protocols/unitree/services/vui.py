"""The vui service: volume, lamp and switch of the robot's face, kept and given back. Pure; nothing shines or sounds."""

from __future__ import annotations

import json
from typing import Final

from firmware_bridge.unitree.messages import ids
from sim_hil.protocols.unitree.services.parameters import parse_numbers
from sim_hil.protocols.unitree.services.service import Answer

VUI_SERVICE: Final = "vui"
# Set request -> its key and the highest value; the request after it reads the value back.
_SETTINGS: Final = {1001: ("enable", 1), 1003: ("volume", 10), 1005: ("brightness", 10)}


class Vui:
    """Remembers what was set."""

    def __init__(self) -> None:
        self._values = dict(_SETTINGS.values())

    def handle(self, api_id: int, parameter: str) -> Answer:
        """One request."""
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
