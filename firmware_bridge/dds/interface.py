"""Whether a network interface is up, so that DDS can join on it."""

from __future__ import annotations

import fcntl
import socket
import struct
from ipaddress import AddressValueError, IPv4Address
from typing import Final

_SIOCGIFFLAGS: Final = 0x8913  # netdevice(7)
_SIOCGIFADDR: Final = 0x8915
_IFF_UP: Final = 0x1
_MAX_NAME_BYTES: Final = 15  # IFNAMSIZ less its NUL
_IFREQ: Final = struct.Struct("16sH22x")


def missing_interface(interface: str) -> str | None:
    """Return the missing interface in one line; None once it is up with an IPv4 address."""
    if is_interface_up(interface):
        return None
    found = ", ".join(name for _, name in socket.if_nameindex())
    return f"waiting for interface {interface!r} with an IPv4 address (interfaces: {found})"


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
