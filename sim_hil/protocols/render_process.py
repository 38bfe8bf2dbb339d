"""Parent's side of a camera process: it gets the pose through shared memory and sends events as lines."""

from __future__ import annotations

import contextlib
import socket
import sys
import time
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.live.wire import PICTURE, Datagram
from sim_hil.processes.child_process import ChildProcess, Message, parse_message
from sim_hil.protocols.front_end import FrontEndOptions
from sim_hil.protocols.snapshot import SnapshotWriter

_START_TIMEOUT_S: Final = 60.0
_END_TIMEOUT_S: Final = 3.0
_POLL_S: Final = 0.02
_IDLE_PICTURE_NS: Final = 500_000_000
JPEG_QUALITY: Final = 85


class CameraProcessError(RuntimeError):
    """The camera process did not start, died, or sent an invalid event."""


class RenderProcess:
    """Process that renders the newest pose; it ends with this object and with the parent process."""

    def __init__(
        self,
        module: str,
        options: FrontEndOptions,
        more: Sequence[str],
        state_length: int,
        pass_fds: Sequence[int] = (),
    ) -> None:
        """Start `module` with the options' scene, people, seed and camera size, and the arguments `more`.

        `state_length`: length of a render state. Raises OSError if the process cannot be started.
        """
        width, height = options.camera_size or (0, 0)
        command = [sys.executable, "-m", module, "--scene", options.scene_source, "--people", str(options.people)]
        command += ["--seed", str(options.seed), "--width", str(width), "--height", str(height), *more]
        if options.view_fd is not None:
            command += ["--view-fd", str(options.view_fd)]
            pass_fds = (*pass_fds, options.view_fd)
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

    def show(self, render_state: NDArray[np.float64]) -> None:
        """Set the state for the next image; takes microseconds."""
        self._pose.write(render_state)

    def send(self, line: bytes) -> None:
        """Send a line to the process; `events` detects a dead process."""
        self._child.send(line)

    def wait_ready(self, stop: Sequence[int]) -> bool:
        """Wait until the camera is ready; False if `stop` gets an element first. Raises CameraProcessError."""
        deadline_ns = time.monotonic_ns() + int(_START_TIMEOUT_S * 1e9)
        while not any(event["event"] == "ready" for event in self.events()):
            if stop:
                return False
            if time.monotonic_ns() > deadline_ns:
                raise CameraProcessError(f"the camera process was not ready within {_START_TIMEOUT_S:g} s")
            time.sleep(_POLL_S)
        return True

    def events(self) -> list[Message]:
        """Return the events since the last call. Raises CameraProcessError."""
        lines = self._child.read()
        if self._child.at_end:
            code = self._child.wait(_END_TIMEOUT_S)  # None: it closed its output and lives on; `close` kills it
            fate = "closed its output but still runs" if code is None else f"died (exit status {code})"
            raise CameraProcessError(f"the camera process {fate}; see its output above")
        return [_event(line) for line in lines]

    def close(self) -> None:
        """End the process, by SIGKILL after a timeout; may be called twice."""
        if self._closed:
            return
        self._closed = True
        self._child.close(_END_TIMEOUT_S)
        self._pose.close()


class PictureView:
    """The camera process's end of a live view: shows what the camera sends, and little where nobody asks for it."""

    def __init__(self, fd: int | None) -> None:
        """`fd`: descriptor of `FrontEndOptions.view_fd`; None: no view."""
        self._socket = None if fd is None else socket.socket(fileno=fd)
        self._shown_ns = 0

    @property
    def is_due(self) -> bool:
        """Whether the view has had no picture for a while and wants one that nobody asked for."""
        return self._socket is not None and time.monotonic_ns() - self._shown_ns > _IDLE_PICTURE_NS

    def show(self, jpeg: bytes) -> None:
        """Show a picture; dropped when the view is busy or has ended. Never waits."""
        if self._socket is None:
            return
        self._shown_ns = time.monotonic_ns()
        with contextlib.suppress(OSError):
            self._socket.send(Datagram(PICTURE, jpeg, "/camera", self._shown_ns).encode(), socket.MSG_DONTWAIT)


def encode_jpeg(rgb: NDArray[np.uint8]) -> bytes:
    """Encode an RGB image [h, w, 3] as JPEG. Raises RuntimeError."""
    done, data = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise RuntimeError("OpenCV could not encode a camera frame as JPEG")
    return data.tobytes()


def _event(line: bytes) -> Message:
    event = parse_message(line)
    if event is None or not isinstance(event.get("event"), str):
        raise CameraProcessError(f"the camera process: expected an event as a line of JSON, found {line[:60]!r}")
    return event
