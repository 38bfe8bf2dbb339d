"""Flight modes as PX4 numbers them (its px4_custom_mode.h), of which a rover without a mission has three."""

from __future__ import annotations

from enum import Enum
from typing import Final

from pymavlink.dialects.v20 import common

_MAIN_SHIFT: Final = 16
_SUB_SHIFT: Final = 24


class Mode(Enum):
    """(main mode, sub mode) of PX4."""

    MANUAL = (1, 0)
    HOLD = (4, 3)  # AUTO, LOITER
    OFFBOARD = (6, 0)

    @property
    def custom_mode(self) -> int:
        """As a heartbeat carries it."""
        main, sub = self.value
        return int(main) << _MAIN_SHIFT | int(sub) << _SUB_SHIFT

    @property
    def base_flags(self) -> int:
        """The bits of a heartbeat's base_mode that go with it."""
        flags = {
            Mode.MANUAL: common.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED,
            Mode.HOLD: common.MAV_MODE_FLAG_AUTO_ENABLED | common.MAV_MODE_FLAG_GUIDED_ENABLED,
            Mode.OFFBOARD: common.MAV_MODE_FLAG_GUIDED_ENABLED,
        }
        return int(common.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | flags[self])


def find_mode(main: int, sub: int) -> Mode | None:
    """The mode of a main and a sub mode; a sub mode of 0 takes the main mode's only one."""
    for mode in Mode:
        if mode.value[0] == main and sub in (0, mode.value[1]):
            return mode
    return None


def custom_mode_of(value: int) -> Mode | None:
    """The mode of a whole custom_mode word."""
    return find_mode(value >> _MAIN_SHIFT & 0xFF, value >> _SUB_SHIFT & 0xFF)
