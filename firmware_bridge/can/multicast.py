"""CAN frames between processes of one machine over UDP multicast, on its loopback interface only.

python-can's own bus listens on every interface and ends at the first datagram that is not a frame.
"""

from __future__ import annotations

import ipaddress
import select
import socket
import struct
from typing import Final

import can
import msgpack
from can.interfaces.udp_multicast.utils import pack_message

PORT: Final = 43113  # default of python-can
_LOOPBACK: Final = b"lo"
_MAX_DATAGRAM: Final = 4096
_FLAGS: Final = ("is_extended_id", "is_remote_frame", "is_error_frame")


class LoopbackMulticastBus(can.BusABC):
    """CAN bus between processes of one machine that join the same multicast address on its loopback interface."""

    def __init__(self, channel: str) -> None:
        """Join `channel`, an address in 224.0.0.0/4 (loopback has no IPv6 multicast). Raises ValueError or OSError."""
        try:
            group = ipaddress.IPv4Address(channel)
        except ValueError:
            group = None
        if group is None or not group.is_multicast:
            raise ValueError(f"expected an IPv4 multicast address such as 239.74.163.2, found {channel!r}")
        self.line_errors = 0
        """Number of datagrams without a valid frame."""
        self._group = (str(group), PORT)
        self._socket = _joined(group)
        self.channel_info = f"udp_multicast:{group}"
        super().__init__(channel)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        return self.receive_from(timeout)[0], False

    def receive_from(self, timeout: float | None) -> tuple[can.Message | None, int]:
        """Return one frame and the UDP port of its sender; None after `timeout` s or for another datagram."""
        if not select.select([self._socket], [], [], timeout)[0]:
            return None, 0
        datagram, (_, port) = self._socket.recvfrom(_MAX_DATAGRAM)
        message = unpacked(datagram)
        self.line_errors += message is None
        return message, port

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send one frame to all members. Raises OSError, also when it would block."""
        self._socket.sendto(pack_message(msg), self._group)

    def shutdown(self) -> None:
        """Close the socket."""
        super().shutdown()
        self._socket.close()


def unpacked(datagram: bytes) -> can.Message | None:
    """Decode a datagram into a classical CAN frame; None if it is not one."""
    try:
        # python-can's own unpacking accepts a number as data and allocates that many bytes.
        content = msgpack.unpackb(datagram, raw=False)
        identifier, data = content["arbitration_id"], content["data"]
        flags = {flag: content[flag] for flag in _FLAGS}
        if type(identifier) is not int or type(data) is not bytes or not all(type(v) is bool for v in flags.values()):
            return None
        return can.Message(arbitration_id=identifier, data=data, check=True, **flags)
    except (ValueError, TypeError, KeyError):  # not msgpack, not a table, missing key, or invalid frame
        return None


def _joined(group: ipaddress.IPv4Address) -> socket.socket:
    """Open a multicast socket bound to the loopback interface."""
    index = socket.if_nametoindex(_LOOPBACK.decode())
    found = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        found.setblocking(False)
        found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        # Before bind(), so that no packet from outside is ever queued. Needs no privileges since Linux 5.7.
        found.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, _LOOPBACK)
        found.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        # struct ip_mreqn: group, local address, interface
        found.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, struct.pack("@4s4si", bytes(4), bytes(4), index))
        member = struct.pack("@4s4si", group.packed, bytes(4), index)
        found.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
        found.bind((str(group), PORT))
    except OSError:
        found.close()
        raise
    return found
