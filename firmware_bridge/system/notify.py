"""Notifies systemd (sd_notify(3)): ready, status line, watchdog, stopping. Outside a service it sends nothing.

A message is one datagram, sent without waiting and lost if systemd does not read: it neither delays nor ends a loop.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from typing import Final

MAX_STATUS_CHARS: Final = 200


class Notifier:
    """The service manager's socket from the environment; it never blocks and never raises.

    Every method returns whether its message was sent: an unsent `ready` must be sent again.
    """

    def __init__(self, environment: Mapping[str, str]) -> None:
        """`environment`: os.environ, or a test's; an unusable address counts as none."""
        self._address = _address(environment.get("NOTIFY_SOCKET", ""))
        self._socket: socket.socket | None = None
        if self._address is not None:
            try:
                self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
            except OSError:
                self._address = None
        timeout_us = _watchdog_us(environment) if self.enabled else None
        self.watchdog_period_ns: Final = None if timeout_us is None else timeout_us * 1000 // 2
        """Period of `watchdog`, ns: half of the unit's WatchdogSec (sd_watchdog_enabled(3)); None: no watchdog."""

    @property
    def enabled(self) -> bool:
        """Whether the environment names a service manager."""
        return self._address is not None

    def ready(self, text: str) -> bool:
        """Report that start-up is complete: later units may start, and the watchdog begins to count."""
        return self._send(f"READY=1\n{_status(text)}")

    def status(self, text: str) -> bool:
        """Send one line for `systemctl status`, cut to fit."""
        return self._send(_status(text))

    def watchdog(self) -> bool:
        """Ping the watchdog; call it from the working loop, only while that loop is on time."""
        return self._send("WATCHDOG=1")

    def stopping(self, text: str) -> bool:
        """Report that the service has begun to end."""
        return self._send(f"STOPPING=1\n{_status(text)}")

    def extend(self, seconds: float) -> bool:
        """Extend the time limit of starting or stopping to this long from now."""
        return self._send(f"EXTEND_TIMEOUT_USEC={max(0, round(seconds * 1e6))}")

    def close(self) -> None:
        """Close the socket; later messages are not sent."""
        self._address = None
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, message: str) -> bool:
        if self._socket is None or self._address is None:
            return False
        try:
            # Unconnected: sending to the address each time outlives a restart of the manager.
            self._socket.sendto(message.encode("utf-8", "replace"), self._address)
        except OSError:
            return False
        return True


def _address(name: str) -> str | None:
    """Return the address of NOTIFY_SOCKET: a path, or `@name` in the abstract namespace; None otherwise."""
    if len(name) < 2 or name[0] not in "/@" or "\0" in name:
        return None
    return "\0" + name[1:] if name[0] == "@" else name


def _watchdog_us(environment: Mapping[str, str]) -> int | None:
    """Return WATCHDOG_USEC if it is a duration for this process, else None."""
    text, pid = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", "")
    if pid and pid != str(os.getpid()):
        return None
    return int(text) if text.isascii() and text.isdigit() and len(text) < 19 and int(text) > 1 else None


def _status(text: str) -> str:
    line = " ".join(text.split())
    return f"STATUS={line[:MAX_STATUS_CHARS]}"
