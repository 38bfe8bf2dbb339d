"""The parent's handle on a camera process: the pose goes there through shared memory, its events come back as lines."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Final

from numpy import float64
from numpy.typing import NDArray

from sim_hil.processes.child_process import ChildProcess, Message, parse_message
from sim_hil.protocols.snapshot import SnapshotWriter

_START_TIMEOUT_S: Final = 60.0
_END_TIMEOUT_S: Final = 3.0
_POLL_S: Final = 0.02


class CameraProcessError(RuntimeError):
    """The camera process did not start, has died, or sent a line that is no event."""


class RenderProcess:
    """A process that renders the newest pose; it ends when this object or the parent process does."""

    def __init__(self, command: Sequence[str], state_length: int, pass_fds: Sequence[int] = ()) -> None:
        """`state_length`: numbers in a render state. Raises OSError when the process cannot be started."""
        self._pose = SnapshotWriter(state_length)
        try:
            pose_fd = self._pose.fd
            self._child = ChildProcess([*command, "--pose-fd", str(pose_fd)], pass_fds=(*pass_fds, pose_fd))
        except OSError:
            self._pose.close()
            raise
        self._closed = False

    @property
    def pid(self) -> int:
        """Process id."""
        return self._child.pid

    def show(self, render_state: NDArray[float64]) -> None:
        """Make this the state that the next picture is rendered from; takes microseconds."""
        self._pose.write(render_state)

    def send(self, line: bytes) -> None:
        """Send a line to the process; `events` notices one that has died."""
        self._child.send(line)

    def wait_ready(self, stop: Sequence[int]) -> bool:
        """Wait until the camera serves pictures; False when `stop` gets an element first. Raises CameraProcessError."""
        deadline_ns = time.monotonic_ns() + int(_START_TIMEOUT_S * 1e9)
        while not any(event["event"] == "ready" for event in self.events()):
            if stop:
                return False
            if time.monotonic_ns() > deadline_ns:
                raise CameraProcessError(f"the camera process was not ready within {_START_TIMEOUT_S:g} s")
            time.sleep(_POLL_S)
        return True

    def events(self) -> list[Message]:
        """Events that the process has reported since the last call. Raises CameraProcessError."""
        lines = self._child.read()
        if self._child.at_end:
            code = self._child.wait(_END_TIMEOUT_S)  # None: it closed its output and lives on; `close` kills it
            fate = "closed its output but still runs" if code is None else f"died (exit status {code})"
            raise CameraProcessError(f"the camera process {fate}; see its output above")
        return [_event(line) for line in lines]

    def close(self) -> None:
        """End the process; killed if it does not end by itself. May be called twice."""
        if self._closed:
            return
        self._closed = True
        self._child.close(_END_TIMEOUT_S)
        self._pose.close()


def _event(line: bytes) -> Message:
    event = parse_message(line)
    if event is None or not isinstance(event.get("event"), str):
        raise CameraProcessError(f"the camera process: expected an event as a line of JSON, found {line[:60]!r}")
    return event
