"""The runner's end of the live view: takes records without waiting, and takes the view's requests to stop.

A process of its own serves the view, so that no client and no library of it can delay a tick. What cannot be sent at
once is dropped: the newest record of a topic replaces an older one.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import socket
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Final

from edge.flightlog.part import Payload, encode
from edge.live.options import LiveError, LiveOptions
from edge.live.wire import (
    CONFIG,
    EVENTS,
    LISTENING,
    MOST_BYTES,
    PICTURE,
    RECORD,
    REFUSED,
    STOP,
    STOPPED,
    Datagram,
    ViewConfig,
    WireError,
    decode,
)

_MOST_EVENTS: Final = 256
_PERIOD_S: Final = 0.05
_START_S: Final = 10.0
_NICENESS: Final = 10


class LiveFeed:
    """Feed of one live view; `put` may be called by any thread, `poll` by one. An `InstructionChannel`."""

    def __init__(
        self, options: LiveOptions, bridge: Path | None, stop: Callable[[], bool], report: Callable[[str], None]
    ) -> None:
        """Start the view's process and wait until it listens.

        `bridge`: socket of the run's bridge; None: a view that cannot stop anything and has no STOP button. `stop`
        stops the robot and returns whether its bridge has confirmed it. `report` takes a line for the operator. Raises
        LiveError.
        """
        self.stopped = False
        """Whether the view has requested a stop."""
        self.dropped = 0
        self._stop, self._report = stop, report
        self._newest: dict[str, tuple[int, Payload]] = {}
        self._events: deque[tuple[str, int, Payload]] = deque(maxlen=_MOST_EVENTS)
        self._closing = threading.Event()
        self._broken = False
        token = options.token()
        config = ViewConfig(options.address, options.port, token, bridge)
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            for end in (self._socket, theirs):
                end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, MOST_BYTES)
            self._process = subprocess.Popen(
                [sys.executable, "-m", "edge.live.server", "--fd", str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
            )
        try:
            self.port = self._started(config)
        except BaseException:
            self._end()
            raise
        self.url = options.url(self.port, token)
        self._socket.setblocking(False)
        self._thread = threading.Thread(target=self._run, name="live", daemon=True)
        self._thread.start()

    def put(self, topic: str, stamp_ns: int, payload: Payload) -> None:
        """Queue one record for the view; never blocks, never raises, encodes nothing."""
        if topic in EVENTS:
            self._events.append((topic, stamp_ns, payload))
        else:
            self._newest[topic] = (stamp_ns, payload)

    @property
    def picture_fd(self) -> int:
        """Descriptor into which a process that inherits it may send pictures of its own, each as one datagram."""
        return self._socket.fileno()

    def poll(self) -> str | None:
        """Carry out the view's request to stop, if there is one; a view gives no instructions."""
        while not self._broken:
            try:
                datagram = decode(self._socket.recv(MOST_BYTES))
            except (OSError, WireError):  # nothing there, or the view has ended, which the sender finds
                break
            if datagram.kind == STOP:
                self.stopped = True
                confirmed = self._stop()
                with contextlib.suppress(OSError):
                    self._socket.send(Datagram(STOPPED, json.dumps({"confirmed": confirmed}).encode()).encode())
        return None

    def close(self) -> None:
        """Send what is left and end the view's process."""
        self._closing.set()
        self._thread.join(2 * _PERIOD_S)
        self._end()

    def _started(self, config: ViewConfig) -> int:
        """Configure the view and return the port at which it listens."""
        self._socket.settimeout(_START_S)
        try:
            self._socket.send(Datagram(CONFIG, config.encode()).encode())
            answer = decode(self._socket.recv(MOST_BYTES))
        except (OSError, WireError) as error:
            why = "no answer" if isinstance(error, TimeoutError) else "its process has ended"
            raise LiveError(f"--live: the live view did not start within {_START_S:g} s: {why}") from error
        text = answer.payload.decode(errors="replace")
        if answer.kind == REFUSED:
            raise LiveError(f"--live: {text}")
        if answer.kind != LISTENING:
            raise LiveError("--live: the live view gave an unexpected answer")
        return int(text)

    def _run(self) -> None:
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)  # per thread on Linux
        while not self._closing.wait(_PERIOD_S) and not self._broken:
            self._send_all()
        self._send_all()

    def _send_all(self) -> None:
        while self._events:
            self._send(*self._events.popleft())
        while self._newest:
            topic, (stamp_ns, payload) = self._newest.popitem()
            self._send(topic, stamp_ns, payload)

    def _send(self, topic: str, stamp_ns: int, payload: Payload) -> None:
        if self._broken:
            return
        try:
            picture = isinstance(payload, bytes)
            data = payload if isinstance(payload, bytes) else encode(payload, stamp_ns)
            self._socket.send(Datagram(PICTURE if picture else RECORD, data, topic, stamp_ns).encode())
        except (TypeError, ValueError, RecursionError, BlockingIOError):
            self.dropped += 1
        except OSError as error:
            if error.errno in (errno.EMSGSIZE, errno.ENOBUFS):  # this datagram only
                self.dropped += 1
                return
            self._broken = True
            if not self._closing.is_set():
                self._report("the live view has ended; the robot drives on without it")

    def _end(self) -> None:
        self._broken = True
        self._socket.close()  # the view ends when its socket ends
        try:
            self._process.wait(1.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
