"""The runner's connection to the bridge; it never waits once it is connected."""

from __future__ import annotations

import contextlib
import select
from pathlib import Path
from typing import Final

from firmware_bridge.core.link import (
    MAX_DATAGRAM_BYTES,
    Arm,
    BridgeStatus,
    LinkError,
    Message,
    Release,
    Stop,
    Velocity,
    decode,
    encode,
)
from firmware_bridge.peer import CONNECT_TIMEOUT_S, BridgeUnavailable, connect

__all__ = ["BridgeClient", "BridgeStatus", "BridgeUnavailable"]

_HELLO_TIMEOUT_MS: Final = round(CONNECT_TIMEOUT_S * 1e3)


class BridgeClient:
    """The one client of an `edge-bridge`.

    Order of use: `arm()`, then `send_velocity` at the control rate from that moment on, zero velocity included, while
    `poll()` reports "arming" and later "armed". The bridge stops the robot when no good command arrives within its
    deadman time (250 ms), when `stop()` is called, and when this process or its connection ends; it then needs a new
    `arm()`. Commands sent while arming satisfy the deadman but do not move the robot.
    """

    def __init__(self, socket_path: Path | str, first: Message | None = None) -> None:
        """Connect, send `first`, and wait up to 1 s for the bridge's greeting. Raises BridgeUnavailable."""
        self._status: BridgeStatus | None = None
        self._socket = connect(Path(socket_path))
        if first is not None:
            self._send(first)
        poller = select.poll()
        poller.register(self._socket, select.POLLIN)
        status = None
        if poller.poll(_HELLO_TIMEOUT_MS):
            with contextlib.suppress(BridgeUnavailable):  # closed without a greeting
                status = self.poll()
        if status is None:
            self.close()
            raise BridgeUnavailable(f"the bridge at {socket_path} has another client or does not answer")

    def arm(self) -> bool:
        """Request arming: the bridge stands the robot up and takes commands. False when it was not sent."""
        return self._send(Arm())

    def send_velocity(self, seq: int, stamp_ns: int, vx_mps: float, vy_mps: float, wz_radps: float) -> bool:
        """Send one command in the body frame; False when it could not be sent.

        `seq` must increase with every command of this connection; `stamp_ns` is time.monotonic_ns() when the command
        was computed: the bridge refuses commands older than its deadman, and commands from the future.
        """
        return self._send(Velocity(seq, stamp_ns, vx_mps, vy_mps, wz_radps))

    def stop(self) -> bool:
        """Stop the robot now; the bridge stays stopped until the next `arm()`. False when it could not be sent."""
        return self._send(Stop())

    def release(self) -> bool:
        """Operator's socket only: let the bridge send no command until the next arming. False when it was not sent."""
        return self._send(Release())

    def poll(self) -> BridgeStatus | None:
        """Return the newest status, None before the first; raises BridgeUnavailable when the connection has closed."""
        while True:
            try:
                data = self._socket.recv(MAX_DATAGRAM_BYTES)
            except BlockingIOError:
                return self._status
            except OSError as error:
                raise BridgeUnavailable(f"the connection to the bridge broke: {error.strerror}") from error
            if not data:
                raise BridgeUnavailable("the bridge has closed the connection")
            with contextlib.suppress(LinkError):
                message = decode(data)
                if isinstance(message, BridgeStatus):
                    self._status = message

    def close(self) -> None:
        """Disconnect; the bridge stops the robot if it was armed."""
        self._socket.close()

    def _send(self, message: Message) -> bool:
        try:
            self._socket.send(encode(message))
        except OSError:  # full queue (a hung bridge) or a closed connection: poll() distinguishes them
            return False
        return True
