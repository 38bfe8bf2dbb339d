"""The two ends of a link of each kind: real sockets, pseudo terminals and network interfaces, none of which waits."""

from __future__ import annotations

import contextlib
import os
import socket
import tty
from collections import OrderedDict
from pathlib import Path
from typing import Final, Protocol

from sim_hil.network.config import LinkConfig, NetworkError, parse_address

LEFT: Final = 0
RIGHT: Final = 1
_MAX_DATAGRAM: Final = 65535 + 64
_MAX_CLIENTS: Final = 32  # of one udp link; the one that was silent longest makes room
_BATCH: Final = 64  # packets taken at one look
_SOL_PACKET, _PACKET_VNET_HDR = 263, 15  # <linux/if_packet.h>
_ETH_P_ALL: Final = 3
_CAN_START, _CAN_END = 0xAA, 0xBB  # python-can's serial frame: start, 4 stamp, 1 length, 4 id, data, end
_CAN_FIXED: Final = 11

Packet = tuple[int, bytes, object]  # the side that it came from, its content, and where its answer belongs


class Ends(Protocol):
    """Both ends of one link."""

    def sources(self) -> list[int]:
        """File descriptors that something may arrive at, as of now."""
        ...

    def take(self, descriptor: int) -> list[Packet]:
        """What has arrived there, at most some; never waits."""
        ...

    def give(self, packet: Packet) -> None:
        """Hand a packet out at the other side than it came from; what does not fit is lost."""
        ...

    def close(self) -> None:
        """Let go."""
        ...


class UdpEnds:
    """A socket that clients send to, and one of its own for each of them towards the other address."""

    def __init__(self, left: str, right: str) -> None:
        self._right = parse_address(right)
        self._listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._listener.setblocking(False)
        try:
            self._listener.bind(parse_address(left))
        except OSError as error:
            self._listener.close()
            raise OSError(f"{left}: expected a free local address, {error.strerror}") from error
        self._clients: OrderedDict[object, socket.socket] = OrderedDict()

    @property
    def address(self) -> tuple[str, int]:
        """Where clients send to."""
        host, port = self._listener.getsockname()
        return host, port

    def sources(self) -> list[int]:
        return [self._listener.fileno(), *(out.fileno() for out in self._clients.values())]

    def take(self, descriptor: int) -> list[Packet]:
        owners = {out.fileno(): (client, out) for client, out in self._clients.items()}
        owner, end = owners.get(descriptor, (None, self._listener))
        packets: list[Packet] = []
        # Nobody listens at the other address, or no way leads there: on a network that is silence.
        with contextlib.suppress(OSError):
            for _ in range(_BATCH):
                data, sender = end.recvfrom(_MAX_DATAGRAM)
                packets.append((LEFT, data, sender) if owner is None else (RIGHT, data, owner))
        return packets

    def give(self, packet: Packet) -> None:
        side, data, client = packet
        with contextlib.suppress(OSError):
            if side == RIGHT:
                assert isinstance(client, tuple)
                self._listener.sendto(data, client)
            else:
                self._towards(client).send(data)

    def _towards(self, client: object) -> socket.socket:
        if client not in self._clients:
            if len(self._clients) >= _MAX_CLIENTS:
                self._clients.popitem(last=False)[1].close()
            out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            out.setblocking(False)
            try:
                out.connect(self._right)
            except OSError:
                out.close()
                raise
            self._clients[client] = out
        self._clients.move_to_end(client)
        return self._clients[client]

    def close(self) -> None:
        self._listener.close()
        for out in self._clients.values():
            out.close()
        self._clients.clear()


class SerialEnds:
    """Two pseudo terminals; with `can` the bytes are cut into python-can's serial frames first."""

    def __init__(self, left: str, right: str, *, can: bool) -> None:
        self._can = can
        self._partial = [b"", b""]
        self._links = [Path(left), Path(right)]
        self._made: list[Path] = []
        self._masters: list[int] = []
        self._slaves: list[int] = []
        try:
            for link in self._links:
                master, slave = os.openpty()
                self._masters.append(master)
                self._slaves.append(slave)  # kept open: without a reader the master would only give errors
                tty.setraw(slave)
                os.set_blocking(master, False)
                link.symlink_to(os.ttyname(slave))
                self._made.append(link)
        except OSError as error:
            self.close()
            raise OSError(f"{left}, {right}: expected two paths that do not exist yet, {error.strerror}") from error

    def sources(self) -> list[int]:
        return list(self._masters)

    def take(self, descriptor: int) -> list[Packet]:
        side = self._masters.index(descriptor)
        try:
            data = os.read(descriptor, 4096)
        except BlockingIOError:
            return []
        if not self._can:
            return [(side, data, None)]
        frames, self._partial[side] = can_frames(self._partial[side] + data)
        return [(side, frame, None) for frame in frames]

    def give(self, packet: Packet) -> None:
        side, data, _ = packet
        with contextlib.suppress(BlockingIOError):
            os.write(self._masters[RIGHT if side == LEFT else LEFT], data)

    def close(self) -> None:
        for link in self._made:
            link.unlink(missing_ok=True)
        for descriptor in (*self._masters, *self._slaves):
            os.close(descriptor)
        self._made, self._masters, self._slaves = [], [], []


def can_frames(data: bytes) -> tuple[list[bytes], bytes]:
    """The whole frames of python-can's serial interface in `data`, and what is left; bytes that are none pass alone."""
    frames = []
    while data:
        start = data.find(bytes([_CAN_START]))
        if start != 0:
            noise = data if start < 0 else data[:start]
            frames.append(noise)
            data = data[len(noise) :]
            continue
        if len(data) < 6:
            break
        length = _CAN_FIXED + data[5]
        if data[5] > 8:
            frames.append(data[:1])
            data = data[1:]
        elif len(data) < length:
            break
        else:
            whole = length if data[length - 1] == _CAN_END else 1
            frames.append(data[:whole])
            data = data[whole:]
    return frames, data


class FrameEnds:
    """Two network interfaces as the ends of one cable. Raises OSError without the right to (CAP_NET_RAW).

    Checksums and segments that an interface leaves to its hardware stay described beside the frame (PACKET_VNET_HDR):
    without that the receiver would throw every UDP datagram away.
    """

    def __init__(self, left: str, right: str) -> None:
        self._sockets: list[socket.socket] = []
        try:
            for interface in (left, right):
                end = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, socket.htons(_ETH_P_ALL))
                self._sockets.append(end)
                end.setsockopt(_SOL_PACKET, _PACKET_VNET_HDR, 1)
                end.bind((interface, _ETH_P_ALL))
                end.setblocking(False)
        except OSError as error:
            self.close()
            raise OSError(f"{left}, {right}: expected two interfaces we may use, {error.strerror}") from error

    def sources(self) -> list[int]:
        return [end.fileno() for end in self._sockets]

    def take(self, descriptor: int) -> list[Packet]:
        side = self.sources().index(descriptor)
        packets: list[Packet] = []
        for _ in range(_BATCH):
            try:
                data, origin = self._sockets[side].recvfrom(_MAX_DATAGRAM)
            except OSError:  # nothing more, or the interface is down
                break
            if origin[2] != socket.PACKET_OUTGOING:  # not what we have sent there ourselves
                packets.append((side, data, None))
        return packets

    def give(self, packet: Packet) -> None:
        side, data, _ = packet
        with contextlib.suppress(OSError):  # the interface is down or its queue full: lost, as on a cable
            self._sockets[RIGHT if side == LEFT else LEFT].send(data)

    def close(self) -> None:
        for end in self._sockets:
            end.close()
        self._sockets = []


def open_ends(link: LinkConfig) -> Ends:
    """The ends that a link's configuration asks for. Raises NetworkError or OSError."""
    if link.kind == "udp":
        return UdpEnds(link.left, link.right)
    if link.kind == "frames":
        return FrameEnds(link.left, link.right)
    if link.left == link.right:
        raise NetworkError(f"link {link.name!r}: expected two different paths, found {link.left!r} twice")
    return SerialEnds(link.left, link.right, can=link.kind == "can-serial")
