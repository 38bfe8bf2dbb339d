"""Camera that streams MJPEG over HTTP: a thread keeps the newest picture and connects again after every failure."""

from __future__ import annotations

import ipaddress
import socket
import threading
import time
from typing import Final
from urllib.parse import urlsplit

from edge.core.stamp_lag import StampLag
from edge.robot.cameras.multipart import MjpegParser, StreamError
from edge.robot.cameras.newest import Backoff, NewestPicture, ReceivingThread
from firmware_bridge.core.robot_state import CameraError

STALL_NS: Final = 3_000_000_000
"""Time without a complete picture after which the connection is given up, ns."""
_CONNECT_TIMEOUT_S: Final = 2.0
_POLL_S: Final = 0.2
"""How soon close() is noticed, s."""
_RECEIVE_BYTES: Final = 256 * 1024


class MjpegCamera:
    """One stream at `http://HOST[:PORT]/PATH`; a `CameraSource`."""

    def __init__(self, url: str, *, latency_ns: int, stall_ns: int = STALL_NS) -> None:
        """`latency_ns`: age of a picture when it arrives, where the server does not know its capture stamp.

        `stall_ns`: time without a complete picture after which the connection is given up.
        """
        parts = urlsplit(url)
        self._host, self._port = parts.hostname or "", parts.port or 80
        target = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
        # HTTP/1.0: the answer has no chunks.
        self._request = f"GET {target} HTTP/1.0\r\nHost: {parts.netloc}\r\nAccept: */*\r\n\r\n".encode("ascii")
        self._latency_ns, self._stall_ns = latency_ns, stall_ns
        self._newest: NewestPicture[bytes] = NewestPicture(url)
        self.captured_ns: int | None = None
        self._thread = ReceivingThread(self._stream, self._newest.fail)

    def request_frame(self, timeout_s: float) -> bytes:
        """See `CameraSource`."""
        jpeg, self.captured_ns = self._newest.take(timeout_s)
        return jpeg

    def close(self) -> None:
        """See `CameraSource`."""
        self._thread.close()

    def _stream(self, closing: threading.Event, backoff: Backoff) -> None:
        """Receive one connection's pictures. Raises CameraError when it fails."""
        try:
            with socket.create_connection((self._host, self._port), _CONNECT_TIMEOUT_S) as connection:
                # The stamp is of this machine's monotonic clock only where the server runs on this machine.
                same_clock = ipaddress.ip_address(connection.getpeername()[0]).is_loopback
                connection.sendall(self._request)
                connection.settimeout(_POLL_S)
                self._receive(connection, closing, backoff, same_clock=same_clock)
        except StreamError as error:
            raise CameraError(str(error)) from error
        except OSError as error:
            raise CameraError(f"no connection ({error.strerror or error})") from error

    def _receive(
        self, connection: socket.socket, closing: threading.Event, backoff: Backoff, *, same_clock: bool
    ) -> None:
        parser, picture_ns, lag = MjpegParser(), time.monotonic_ns(), StampLag()
        while not closing.is_set():
            if time.monotonic_ns() - picture_ns > self._stall_ns:
                raise CameraError(f"no complete picture for {self._stall_ns / 1e9:g} s, connecting again")
            try:
                data = connection.recv(_RECEIVE_BYTES)
            except TimeoutError:
                continue
            if not data:
                raise CameraError("the server has closed the connection")
            parts = parser.feed(data)
            if not parts:
                continue
            picture_ns = time.monotonic_ns()
            stamp_ns = parts[-1].capture_ns
            # A stamp from the future is not of this clock.
            if stamp_ns is not None and same_clock and stamp_ns <= picture_ns:
                captured_ns = stamp_ns
            else:
                captured_ns = picture_ns - self._latency_ns - lag.of(picture_ns, stamp_ns or 0)
            self._newest.put(parts[-1].jpeg, captured_ns)
            backoff.reset()
