"""A command's end of the live view and of ROS 2 publishing: takes records without waiting, and requests to stop.

A process of its own serves each, so that no client and no library of it can delay a tick. What cannot be sent at
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
from dataclasses import asdict
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
from firmware_bridge.core.config import RobotConfig

_MOST_EVENTS: Final = 256
_PERIOD_S: Final = 0.05
_START_S: Final = 10.0
_NICENESS: Final = 10


class RecordFeed:
    """Feed of one process that shows or publishes records; `put` may be called by any thread. A `RecordSink`."""

    def __init__(self, module: str, config: bytes, name: str, report: Callable[[str], None]) -> None:
        """Start `module` with a configuration and wait until it is ready.

        `name` names it in messages. `report` takes a line for the operator. Raises LiveError.
        """
        self.dropped = 0
        self._name, self._report = name, report
        self._newest: dict[str, tuple[int, Payload]] = {}
        self._events: deque[tuple[str, int, Payload]] = deque(maxlen=_MOST_EVENTS)
        self._closing = threading.Event()
        self._broken = False
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            for end in (self._socket, theirs):
                end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, MOST_BYTES)
            self._process = subprocess.Popen(
                [sys.executable, "-m", module, "--fd", str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
            )
        try:
            self.ready = self._started(config)
        except BaseException:
            self._end()
            raise
        self._socket.setblocking(False)
        self._thread = threading.Thread(target=self._run, name="live", daemon=True)
        self._thread.start()

    def put(self, topic: str, stamp_ns: int, payload: Payload) -> None:
        """Queue one record; never blocks, never raises, encodes nothing."""
        if topic in EVENTS:
            self._events.append((topic, stamp_ns, payload))
        else:
            self._newest[topic] = (stamp_ns, payload)

    def close(self) -> None:
        """Send what is left and end the process; may be called twice."""
        self._closing.set()
        self._thread.join(2 * _PERIOD_S)
        self._end()

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
                self._report(f"{self._name} has ended; the robot drives on without it")

    def _end(self) -> None:
        self._broken = True
        self._socket.close()  # the process ends when its socket ends
        try:
            self._process.wait(1.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


class LiveFeed(RecordFeed):
    """Feed of one live view; `poll` may be called by one thread. An `InstructionChannel`."""

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
        self._stop = stop
        token = options.token()
        config = ViewConfig(options.address, options.port, token, bridge)
        super().__init__("edge.live.server", config.encode(), "the live view", report)
        self.port = int(self.ready)
        self.url = options.url(self.port, token)

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
