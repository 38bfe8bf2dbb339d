"""Fault socket of `edge-hil --protocol mavlink --faults PATH`: emergency stop button and dead radio.

A request is one JSON object per datagram: {"fault": "button"|"mute"|"clear", "on": true|false}. A pressed button stops
the base; with "mute" nothing is received or sent. The answer is {"fault", "on", "effect_ns"} or {"error"}.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Final

from sim_hil.protocols.fault_socket import CLEAR, FaultSocket

SWITCHES: Final = ("button", "mute")


class MavlinkFaults(FaultSocket):
    """Fault socket whose `button` and `mute` are the active faults; call `poll`. Raises OSError."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.button = self.mute = False

    def _switch(self, table: dict[str, object]) -> dict[str, object]:
        if set(table) - {"fault", "on"} or not isinstance(table.get("on", True), bool):
            raise ValueError(f"expected a JSON object with fault and on (true or false), found {table}")
        name, on = table.get("fault"), table.get("on", True)
        if name == CLEAR:
            self.button = self.mute = on = False
        elif name in SWITCHES:
            setattr(self, name, on)
        else:
            raise ValueError(f"expected one of {', '.join((*SWITCHES, CLEAR))}, found {name!r}")
        return {"fault": name, "on": on, "effect_ns": time.monotonic_ns()}
