"""`edge-hil --protocol mavlink --faults PATH`: the base's red button and a dead radio, switched while it runs.

One JSON object a datagram: {"fault": "button"|"mute"|"clear", "on": true|false}. A held button stops the base; with
"mute" nothing is heard or sent. The answer is {"fault", "on", "effect_ns"} or {"error"}.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Final

from sim_hil.protocols.fault_socket import CLEAR, FaultSocket

SWITCHES: Final = ("button", "mute")


class MavlinkFaults(FaultSocket):
    """`button` and `mute` are what is asked for now; `poll` takes in what has come. Raises OSError."""

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
