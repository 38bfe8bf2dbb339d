"""A CAN frame, and the state of the bus that the kernel's error frames report. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

# Error classes and controller states of the kernel's error frames (linux/can/error.h).
ERROR_CONTROLLER: Final = 0x004
ERROR_BUS_OFF: Final = 0x040
ERROR_RESTARTED: Final = 0x100
_CONTROLLER_BYTE: Final = 1
_WARNING_BITS: Final = 0x04 | 0x08
_PASSIVE_BITS: Final = 0x10 | 0x20
_ACTIVE_BIT: Final = 0x40


@dataclass(frozen=True)
class Frame:
    """A CAN 2.0A data frame; `error`: an error frame instead, with the kernel's error class in `identifier`."""

    identifier: int
    data: bytes
    error: bool = False

    def __post_init__(self) -> None:
        if len(self.data) > 8:
            raise ValueError(f"CAN frame 0x{self.identifier:x}: expected up to 8 bytes, found {len(self.data)}")


class BusHealth:
    """State of our controller on the bus by its error frames: python-can's `.state` does not report it."""

    def __init__(self) -> None:
        self.state = "active"  # or "error-passive", "bus-off"

    def note(self, frame: Frame) -> None:
        """Take one error frame."""
        controller = frame.data[_CONTROLLER_BYTE] if len(frame.data) > _CONTROLLER_BYTE else 0
        if frame.identifier & ERROR_BUS_OFF:
            self.state = "bus-off"
        elif frame.identifier & ERROR_RESTARTED:
            self.state = "active"
        elif frame.identifier & ERROR_CONTROLLER and self.state != "bus-off":
            if controller & _PASSIVE_BITS:
                self.state = "error-passive"
            elif controller & (_WARNING_BITS | _ACTIVE_BIT):
                self.state = "active"

    def forget(self) -> None:
        """Reset after the bus was opened anew."""
        self.state = "active"
