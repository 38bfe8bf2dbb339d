"""Camera poller: a thread that asks the robot for frames at a steady rate and keeps the newest one."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import cast

import cv2
import numpy as np
import numpy.typing as npt

from edge.core.jpeg import jpeg_refusal
from edge.state.frame import Frame, fit_frame
from firmware_bridge.core.robot_state import CameraError


def decode_frame(jpeg: bytes, image_px: int) -> npt.NDArray[np.uint8]:
    """JPEG → encoder input [1, px, px, 3] RGB; raises CameraError when it is not a picture of a sensible size."""
    refusal = jpeg_refusal(jpeg)
    if refusal is not None:
        raise CameraError(f"camera: {refusal}")
    try:
        bgr = cv2.imdecode(np.frombuffer(jpeg, dtype=np.uint8), cv2.IMREAD_COLOR)
    except cv2.error as error:
        raise CameraError(f"camera: {len(jpeg)} bytes cannot be decoded ({error.err or error.code})") from error
    if bgr is None:
        raise CameraError(f"camera: {len(jpeg)} bytes are not a JPEG picture")
    return fit_frame(cast(npt.NDArray[np.uint8], cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)), image_px)


class CameraPoller:
    """Asks `request(timeout_s)` for a JPEG every period, on absolute deadlines."""

    def __init__(
        self,
        request: Callable[[float], bytes],
        *,
        image_px: int,
        period_ns: int,
        timeout_s: float,
        latency_ns: int,
        captured_ns: Callable[[], int | None] = lambda: None,
        on_frame: Callable[[Frame], None] | None = None,
        on_death: Callable[[str], None] = lambda why: None,
    ) -> None:
        """`captured_ns` returns the capture stamp of the picture requested last, None where its source has none.

        `on_frame` is given every frame in the camera thread, after the control thread may see it.

        `on_death` takes, once and in that thread, why it has ended although it was not closed.
        """
        self._request = request
        self._captured_ns = captured_ns
        self._on_frame = on_frame
        self._on_death = on_death
        self._image_px = image_px
        self._period_ns = period_ns
        self._timeout_s = timeout_s
        self._latency_ns = latency_ns
        self._stop = threading.Event()
        self._epoch_ns = time.monotonic_ns()
        self._thread = threading.Thread(target=self._run, name="camera", daemon=True)
        self.newest: Frame | None = None
        self.frames = 0
        self.failures = 0
        self.last_error = ""

    def start(self) -> None:
        """Begin asking."""
        self._thread.start()

    def align(self, epoch_ns: int) -> None:
        """Ask at `epoch_ns` plus whole periods from now on, so that a frame is fresh when the tick needs it."""
        self._epoch_ns = epoch_ns

    def close(self) -> None:
        """Stop asking; waits for a request under way."""
        self._stop.set()
        self._thread.join(self._timeout_s + 1.0)

    def _run(self) -> None:
        try:
            self._poll()
        except Exception as error:  # noqa: BLE001 - a dead thread must end the run, whatever killed it
            self._on_death(f"camera thread died: {type(error).__name__}: {error}")

    def _poll(self) -> None:
        while not self._stop.is_set():
            wait_ns = self._period_ns - (time.monotonic_ns() - self._epoch_ns) % self._period_ns
            if self._stop.wait(wait_ns / 1e9):
                return
            requested_ns = time.monotonic_ns()
            try:
                jpeg = self._request(self._timeout_s)
                arrived_ns = time.monotonic_ns()
                pixels = decode_frame(jpeg, self._image_px)
            except CameraError as error:
                self.failures += 1
                self.last_error = str(error)
                continue
            stamp_ns = self._captured_ns()
            if stamp_ns is None:
                stamp_ns = self._estimate_stamp(requested_ns, arrived_ns)
            self.newest = frame = Frame(stamp_ns, pixels, jpeg)
            self.frames += 1
            if self._on_frame is not None:
                self._on_frame(frame)

    def _estimate_stamp(self, requested_ns: int, arrived_ns: int) -> int:
        """Return the capture stamp of a picture whose source carries none: a robot that samples when asked."""
        # The answer's arrival less the camera's latency, and never before the request. When an answer took much longer,
        # its capture is unknown: as long ago as it can have been.
        slow = arrived_ns - requested_ns > self._latency_ns + self._period_ns
        return requested_ns if slow else max(requested_ns, arrived_ns - self._latency_ns)
