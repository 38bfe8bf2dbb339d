"""Accepts the live view's connections: those that have not shown the token take nobody else's place."""

from __future__ import annotations

import asyncio
import errno
import socket
from collections.abc import Callable
from typing import Final

MOST_STRANGERS: Final = 64
"""Most connections without the token; one more ends the oldest of them."""
STRANGER_S: Final = 3.0
"""Time in which a connection has to show the token, s."""
_PAUSE_S: Final = 0.1
_BACKLOG: Final = 128


class AddressError(OSError):
    """Nothing can listen there; one line with what to do."""


class Strangers:
    """Connections that have not shown the token yet, by their protocol."""

    def __init__(self) -> None:
        self._waiting: dict[asyncio.BaseProtocol, asyncio.TimerHandle] = {}

    def add(self, protocol: asyncio.BaseProtocol) -> None:
        """Give a new connection its time; its transport is the attribute `transport`, None before and after it."""
        loop = asyncio.get_running_loop()
        self._waiting[protocol] = loop.call_later(STRANGER_S, self._end, protocol)
        if len(self._waiting) > MOST_STRANGERS:
            self._end(next(iter(self._waiting)))

    def admit(self, protocol: asyncio.BaseProtocol) -> None:
        """Let a connection stay: it has shown the token."""
        if (timer := self._waiting.pop(protocol, None)) is not None:
            timer.cancel()

    def _end(self, protocol: asyncio.BaseProtocol) -> None:
        self.admit(protocol)
        transport: asyncio.Transport | None = getattr(protocol, "transport", None)
        if transport is not None:
            transport.abort()


async def listen(address: str, port: int) -> list[socket.socket]:
    """Listen at every address of a name, all with one port; port 0 takes a free one. Raises AddressError."""
    where = f"{address}:{port}"
    loop = asyncio.get_running_loop()
    try:
        found = await loop.getaddrinfo(address, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except (socket.gaierror, UnicodeError) as error:
        reason = error.strerror if isinstance(error, socket.gaierror) else "not the name of a computer"
        raise AddressError(f"cannot listen at {where} ({reason}); choose another --live-address") from error
    listening: list[socket.socket] = []
    refused: OSError | None = None
    for family, kind, protocol, _, place in dict.fromkeys(found):
        try:
            made = socket.socket(family, kind, protocol)
            listening.append(made)
            made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if family == socket.AF_INET6:
                made.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
            chosen = port or (listening[0].getsockname()[1] if len(listening) > 1 else 0)
            made.bind((place[0], chosen, *place[2:]))
            made.listen(_BACKLOG)
            made.setblocking(False)
        except OSError as error:  # such as ::1 of localhost where IPv6 is off
            refused = error
            if listening:
                listening.pop().close()
    if not listening:
        reason = "no such address" if refused is None else refused.strerror
        absent = refused is None or refused.errno in (errno.EADDRNOTAVAIL, errno.EAFNOSUPPORT, errno.EINVAL)
        advice = "choose another --live-address: expected one of this computer" if absent else "choose another port"
        raise AddressError(f"cannot listen at {where} ({reason}); {advice}") from refused
    return listening


async def accept(listening: socket.socket, make: Callable[[], asyncio.BaseProtocol], strangers: Strangers) -> None:
    """Accept connections for ever, each a stranger first."""
    loop = asyncio.get_running_loop()

    def stranger() -> asyncio.BaseProtocol:
        protocol = make()
        strangers.add(protocol)
        return protocol

    while True:
        try:
            connection, _ = await loop.sock_accept(listening)
        except OSError:  # no file is free for it: some are in a moment
            await asyncio.sleep(_PAUSE_S)
            continue
        connection.setblocking(False)
        try:
            await loop.connect_accepted_socket(stranger, connection)
        except OSError:  # the client is gone already
            connection.close()
