"""Fault socket of `edge-hil --protocol can --faults PATH`: bus faults and the emergency stop button.

A request is one JSON object per datagram: {"fault": NAME, "on": true|false, "value": NUMBER}. Names are the fields of
`FaultPlan`, which need a value, and "button" (pressed) and "bus_off", which need none. {"fault": "clear"} ends all
faults. The answer is {"fault", "on", "effect_ns"} or {"error"}.
"""

from __future__ import annotations

import time
from dataclasses import fields, replace
from pathlib import Path
from typing import Final

from sim_hil.protocols.can.shim import FaultPlan
from sim_hil.protocols.fault_socket import CLEAR, FaultSocket

SWITCHES: Final = ("button", "bus_off")
_FIELDS: Final = tuple(each.name for each in fields(FaultPlan))
_LARGEST: Final = 1e9


class CanFaults(FaultSocket):
    """Fault socket whose `plan`, `button` and `bus_off` are the active faults; call `poll`. Raises OSError."""

    def __init__(self, path: Path, plan: FaultPlan) -> None:
        """Bind the socket; `plan`: initial faults, restored by "clear" and by "on": false."""
        super().__init__(path)
        self._begin = self.plan = plan
        self.button = self.bus_off = False

    def _switch(self, table: dict[str, object]) -> dict[str, object]:
        name, on, value = table.pop("fault", None), table.pop("on", True), table.pop("value", None)
        if table or not isinstance(on, bool):
            raise ValueError(f"expected fault, on and value, found {', '.join(map(str, table)) or f'on {on!r}'}")
        if name == CLEAR:
            self.plan, self.button, self.bus_off, on = self._begin, False, False, False
        elif name in SWITCHES and value is None:
            setattr(self, name, on)
        elif name in _FIELDS:
            self.plan = replace(self.plan, **{name: self._value(name, on, value)})
        else:
            known = ", ".join((*SWITCHES, *_FIELDS, CLEAR))
            raise ValueError(f"expected one of {known}, found {name!r} with value {value!r}")
        return {"fault": name, "on": on, "effect_ns": time.monotonic_ns()}

    def _value(self, name: str, on: bool, value: object) -> float:
        if not on:
            return float(getattr(self._begin, name))
        # An integer may exceed the range of a float.
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= _LARGEST:
            raise ValueError(f"{name}: expected a number up to {_LARGEST:g} as value, found {str(value)[:60]}")
        return float(value)
