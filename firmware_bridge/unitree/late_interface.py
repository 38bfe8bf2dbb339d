"""Waits for a network interface that appears after the bridge has started: a late cable, a late address.

Until then the bridge runs with an `AbsentRobot` in place of its `RobotLink`: it keeps its sockets, its rules, its
watchdog and every emergency stop of an operator.
"""

from __future__ import annotations

import fcntl
import socket
import struct
from ipaddress import AddressValueError, IPv4Address
from typing import Final

from firmware_bridge.core.step_types import Call, Move, Report

_SIOCGIFFLAGS: Final = 0x8913  # netdevice(7)
_SIOCGIFADDR: Final = 0x8915
_IFF_UP: Final = 0x1
_MAX_NAME_BYTES: Final = 15  # IFNAMSIZ less its NUL
_IFREQ: Final = struct.Struct("16sH22x")


class AbsentRobot:
    """Stands in for a `RobotLink` while there is no network: reports that the robot cannot be commanded."""

    def __init__(self, interface: str) -> None:
        self.interface = interface

    @property
    def reason(self) -> str:
        """The missing interface, in one line."""
        found = ", ".join(name for _, name in socket.if_nameindex())
        return f"waiting for interface {self.interface!r} with an IPv4 address (interfaces: {found})"

    def read(self, now_ns: int) -> Report:
        """Return a report with failing writes and no state, so that the core refuses to arm with `link_down`."""
        return Report(writes_fail=True)

    def write(self, request: Move | Call) -> None:
        """Drop the request: there is nowhere to send it."""

    def dropped(self) -> tuple[int, int, int]:
        """Return the counts of impossible messages, states out of order and failed writes: all 0."""
        return 0, 0, 0


def is_interface_up(interface: str) -> bool:
    """Return whether DDS can join on this interface: up, with an IPv4 address. An address names its interface."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((str(IPv4Address(interface)), 0))
            return True
        except AddressValueError:
            pass
        except OSError:
            return False
        name = interface.encode()
        if len(name) > _MAX_NAME_BYTES:
            return False
        try:
            answer = fcntl.ioctl(probe, _SIOCGIFFLAGS, _IFREQ.pack(name, 0))
            fcntl.ioctl(probe, _SIOCGIFADDR, _IFREQ.pack(name, 0))
        except OSError:
            return False
        flags: int = _IFREQ.unpack(answer)[1]
        return flags & _IFF_UP != 0
