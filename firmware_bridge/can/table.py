"""States of a CAN base and the requests that arm it; needs no CAN library."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Final

from firmware_bridge.core.config import RobotConfig
from firmware_bridge.core.robot_table import RobotTable

STEP_ARM: Final = 1
STEP_RESET: Final = 2
MODE_WITHOUT_STATE: Final = 1
"""Mode of a base that reports no state: it may always drive."""
_IFF_UP: Final = 0x1  # linux/if.h
_NETWORK: Final = Path("/sys/class/net")


def missing_link(config: RobotConfig) -> str | None:
    """Return in one line that the CAN interface or the serial line is missing; None once it is there."""
    can = config.can
    if can is None:
        return None
    if can.interface == "serial" and not Path(can.channel).exists():
        return f"waiting for the serial line {can.channel}"
    if can.interface == "socketcan" and not _is_up(can.channel):
        found = ", ".join(name for _, name in socket.if_nameindex())
        return f"waiting for CAN interface {can.channel!r} to be up (interfaces: {found})"
    return None


def _is_up(interface: str) -> bool:
    try:
        return int((_NETWORK / interface / "flags").read_text(), 16) & _IFF_UP != 0
    except (OSError, ValueError):
        return False


def robot_table(config: RobotConfig) -> RobotTable:
    """Return the table of the base; its emergency stop is reset by an arming that an operator has permitted."""
    can = config.can
    steps = {STEP_ARM: "arm request", STEP_RESET: "reset of the base's emergency stop"}
    armed, names = MODE_WITHOUT_STATE, {MODE_WITHOUT_STATE: "1 (always on)"}
    next_step: dict[int, int] = {}
    if can is not None and can.state is not None:
        state, estop = can.state, can.estop
        armed = state.armed
        names = {state.armed: f"{state.armed} (armed)", state.idle: f"{state.idle} (idle)"}
        if state.estop >= 0:
            names[state.estop] = f"{state.estop} (emergency stop)"
            if estop is not None and estop.request:
                next_step[state.estop] = STEP_RESET
    return RobotTable(
        identity="the base's DBC version",
        version=None if can is None or can.version is None else str(can.version.value),
        ready_modes=frozenset({armed}),
        armed_modes=frozenset({armed}),
        moving_modes=frozenset(),
        next_step=next_step,
        recovery_step=STEP_ARM,
        step_names=steps,
        mode_names=names,
        repeat_ns=1_000_000_000,
    )
