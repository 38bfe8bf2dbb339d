"""A command's end of the live view and of ROS 2 publishing: takes records without waiting, and requests to stop.

A process of its own serves each, so that no client and no library of it can delay a tick. What cannot be sent at
once is dropped: the newest record of a topic replaces an older one. Events and the answer to a stop wait instead.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import socket
import struct
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import ClassVar, Final

from edge.flightlog.part import Payload, encode
from edge.flightlog.recorder import Recorder
from edge.live.options import LiveError, LiveOptions
from edge.live.wire import (
    CONFIG,
    DROPPED,
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
from firmware_bridge.core.config import RobotConfig

_MOST_EVENTS: Final = 256
_PERIOD_S: Final = 0.05
_DROPPED_PERIOD_S: Final = 1.0
"""Time between two messages about dropped records, of the view's or of the flight log's, s."""
_START_S: Final = 10.0
_LAST_S: Final = 0.3
"""Time for what waits while the process takes nothing when the feed closes, s."""
_END_WAIT_S: Final = 1.0
"""Time that `close` waits for the end of the process, s; a thread then waits on."""
_NICENESS: Final = 10
_KERNEL_BYTES: Final = 32
"""Part of a socket's send buffer that a datagram cannot use, bytes (Linux, net/unix/af_unix.c)."""


class RecordFeed:
    """Feed of one process that shows or publishes records; `put` may be called by any thread. A `RecordSink`."""

    _end_s: ClassVar[float] = 0.8
    """Time after which a process that does not end with the feed is killed, s."""

    def __init__(self, module: str, config: bytes, name: str, report: Callable[[str], None]) -> None:
        """Start `module` with a configuration and wait until it is ready.

        `name` names it in messages. `report` takes a line for the operator. Raises LiveError.
        """
        self.dropped = 0
        self._name, self._report = name, report
        self._newest: dict[str, tuple[int, Payload]] = {}
        self._events: deque[tuple[str, int, Payload]] = deque(maxlen=_MOST_EVENTS)
        self._unsent: deque[bytes] = deque()  # datagrams that count; at most one is of an event
        self._dropped_sent, self._dropped_due_s = 0, 0.0
        self._closing = threading.Event()
        self._broken = self._too_large = False
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            for end in (self._socket, theirs):
                end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, MOST_BYTES)
            granted = self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF)  # net.core.wmem_max limits it
            self._most_bytes = min(MOST_BYTES, granted - _KERNEL_BYTES)
            self._process = subprocess.Popen(
                [sys.executable, "-m", module, "--fd", str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
            )
        try:
            self.ready = self._started(config)
        except BaseException:
            self._end(RecordFeed._end_s)
            raise
        self._socket.setblocking(False)
        self._thread = threading.Thread(target=self._run, name="live", daemon=True)
        self._thread.start()

    def put(self, topic: str, stamp_ns: int, payload: Payload) -> None:
        """Queue one record; never blocks, never raises, encodes nothing."""
        if topic in EVENTS:
            if len(self._events) == _MOST_EVENTS:
                self.dropped += 1  # the oldest, which this one replaces
            self._events.append((topic, stamp_ns, payload))
        else:
            self._newest[topic] = (stamp_ns, payload)

    def close(self) -> None:
        """Send what is left and let the process end, which may take longer; may be called twice."""
        if self._closing.is_set():
            return
        self._closing.set()
        self._thread.join(_LAST_S + 2 * _PERIOD_S)
        self._end(self._end_s)

    def _started(self, config: bytes) -> str:
        """Configure the process and return what it answers when it is ready."""
        self._socket.settimeout(_START_S)
        try:
            self._socket.send(Datagram(CONFIG, config).encode())
            answer = decode(self._socket.recv(MOST_BYTES))
        except (OSError, WireError) as error:
            why = "no answer" if isinstance(error, TimeoutError) else "its process has ended"
            raise LiveError(f"{self._name} did not start within {_START_S:g} s: {why}") from error
        text = answer.payload.decode(errors="replace")
        if answer.kind != LISTENING:
            raise LiveError(text if answer.kind == REFUSED else f"{self._name} gave an unexpected answer")
        return text

    def _run(self) -> None:
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)  # for ordinary scheduling
        while not self._closing.wait(_PERIOD_S) and not self._broken:
            self._send_all()
            self._send_dropped()
        end_s = time.monotonic() + _LAST_S
        while not self._send_all() and time.monotonic() < end_s:
            time.sleep(_PERIOD_S / 5)

    def _send_all(self) -> bool:
        """Send what waits; return False where an event or an answer has to wait."""
        sent = self._send_what_counts()
        while self._newest:
            topic, (stamp_ns, payload) = self._newest.popitem()
            data = self._encoded(topic, stamp_ns, payload)
            if data is None or not self._is_sent(data):
                self.dropped += 1
        return sent

    def _send_what_counts(self) -> bool:
        while self._unsent or self._events:
            if not self._unsent:
                data = self._encoded(*self._events.popleft())
                if data is None:
                    self.dropped += 1
                    continue
                self._unsent.append(data)
            if not self._is_sent(self._unsent[0]):
                return False
            self._unsent.popleft()
        return True

    def _send_dropped(self) -> None:
        if self.dropped != self._dropped_sent and time.monotonic() >= self._dropped_due_s:
            count = self.dropped
            if self._is_sent(Datagram(DROPPED, str(count).encode()).encode()):
                self._dropped_sent, self._dropped_due_s = count, time.monotonic() + _DROPPED_PERIOD_S

    def _encoded(self, topic: str, stamp_ns: int, payload: Payload) -> bytes | None:
        """Return the datagram of a record; None for one that cannot be sent."""
        try:
            picture = isinstance(payload, bytes)
            data = payload if isinstance(payload, bytes) else encode(payload, stamp_ns)
            datagram = Datagram(PICTURE if picture else RECORD, data, topic, stamp_ns).encode()
        except (TypeError, ValueError, RecursionError, struct.error):
            return None
        if len(datagram) <= self._most_bytes:
            return datagram
        if not self._too_large:
            self._too_large = True
            kernel = " or raise net.core.wmem_max (sysctl)" if self._most_bytes < MOST_BYTES else ""
            self._report(
                f"{self._name} lacks records that are too large: expected at most {self._most_bytes} bytes, found "
                f"{len(datagram)} in {topic}; lower the size of the camera's JPEG{kernel}"
            )
        return None

    def _is_sent(self, data: bytes) -> bool:
        """Send a datagram; return False where it has to wait. One that never can be sent counts as sent."""
        if self._broken:
            return True
        try:
            self._socket.send(data)
        except BlockingIOError:
            return False
        except OSError as error:
            if error.errno in (errno.EMSGSIZE, errno.ENOBUFS):  # this datagram only
                self.dropped += 1
                return True
            self._broken = True
            if not self._closing.is_set():
                self._report(f"{self._name} has ended; the robot drives on without it")
        return True

    def _end(self, limit_s: float) -> None:
        """Close the socket, upon which the process ends by itself; kill it `limit_s` later."""
        self._broken = True
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)  # also for a process that has inherited it
        self._socket.close()
        reaper = threading.Thread(target=_reap, args=(self._process, limit_s), name="live-end", daemon=True)
        reaper.start()
        reaper.join(_END_WAIT_S)


def _reap(process: subprocess.Popen[bytes], limit_s: float) -> None:
    try:
        process.wait(limit_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


class LiveFeed(RecordFeed):
    """Feed of one live view; `poll` may be called by one thread. An `InstructionChannel`."""

    _end_s: ClassVar[float] = 7.0
    """The same, s: the view answers the stops under way and ends by itself within 6 s."""
    recorder: Recorder | None = None
    """Writer of the run's flight log; the view shows once a second what it has lost."""

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
        self._log_due_s = 0.0
        self._stop = stop
        token = options.token()
        config = ViewConfig(options.address, options.port, token, bridge)
        super().__init__("edge.live.server", config.encode(), "the live view", report)
        self.port = int(self.ready)
        self.url = options.url(self.port, token)
        if (elsewhere := options.url_elsewhere(self.port, token)) is not None:
            report(f"live view for other computers: {elsewhere}")

    def _send_dropped(self) -> None:
        super()._send_dropped()
        if self.recorder is not None and time.monotonic() >= self._log_due_s:
            self._log_due_s = time.monotonic() + _DROPPED_PERIOD_S
            found = {"dropped": sum(self.recorder.dropped.values()), "error": self.recorder.error}
            self.put("/recorder", time.monotonic_ns(), found)

    @property
    def picture_fd(self) -> int:
        """Descriptor into which a process that inherits it may send pictures of its own, each as one datagram."""
        return self._socket.fileno()

    def poll(self) -> str | None:
        """Carry out the view's requests to stop as one, if there are any; a view gives no instructions."""
        requested = False
        while not self._broken:
            try:
                requested |= decode(self._socket.recv(MOST_BYTES)).kind == STOP
            except (OSError, WireError):  # nothing there, or the view has ended, which the sender finds
                break
        if requested:
            self.stopped = True
            answer = Datagram(STOPPED, json.dumps({"confirmed": self._stop()}).encode()).encode()
            try:
                self._socket.send(answer)
            except OSError:
                self._unsent.append(answer)  # the sender tries again
        return None


class Ros2Feed(RecordFeed):
    """Feed of the process that publishes a run as a ROS 2 node."""

    def __init__(self, robot: RobotConfig, report: Callable[[str], None]) -> None:
        """Start the process and wait until it has joined its DDS domain. Raises LiveError."""
        config = json.dumps(
            {
                "robot": robot.name,
                "dds": asdict(robot.ros2_publish.network(robot.dds)),
                "namespace": robot.ros2_publish.publish_namespace,
            }
        )
        super().__init__("edge.live.ros2_publisher", config.encode(), "ROS 2 publishing", report)
