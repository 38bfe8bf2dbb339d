"""The rover's three modes, with PX4's numbers (px4_custom_mode.h)."""

from __future__ import annotations

from enum import Enum
from typing import Final

from pymavlink.dialects.v20 import common

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
