"""Camera that OpenCV opens: a V4L2 device or a GStreamer pipeline. A thread reads it; the newest picture is encoded."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, Final, Protocol

import cv2
import numpy as np
import numpy.typing as npt

from edge.core.jpeg import MAX_PX
from edge.robot.cameras.newest import Backoff, NewestPicture, ReceivingThread
from firmware_bridge.core.robot_state import CameraError

_QUALITY: Final = 92
_API: Final = {"v4l2": cv2.CAP_V4L2, "gstreamer": cv2.CAP_GSTREAMER}


class Capture(Protocol):
    """What is used of `cv2.VideoCapture`."""

    def isOpened(self) -> bool:  # noqa: N802 - OpenCV's name
        """Whether the device or pipeline is open."""

    def read(self) -> tuple[bool, Any]:
        """Wait for a picture: whether there is one, and its pixels."""

    def release(self) -> None:
        """Close it."""


def open_capture(kind: str, address: str) -> Capture:
    """Open a `v4l2` device or a `gstreamer` pipeline. Raises CameraError where this OpenCV cannot."""
    if not cv2.videoio_registry.hasBackend(_API[kind]):
        raise CameraError(f"OpenCV {cv2.__version__} is built without {kind}; install one with it")
    capture = cv2.VideoCapture(address, _API[kind])
    capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # a longer queue makes pictures older
    return capture


class VideoCaptureCamera:
    """One device or pipeline; a `CameraSource`."""

    def __init__(
        self, kind: str, address: str, *, latency_ns: int, opener: Callable[[str, str], Capture] = open_capture
    ) -> None:
        """`kind`: "v4l2" or "gstreamer"; `latency_ns`: age of a picture when OpenCV returns it."""
        self._kind, self._address, self._opener = kind, address, opener
        self._latency_ns = latency_ns
        self._newest: NewestPicture[npt.NDArray[np.uint8]] = NewestPicture(f"{kind}:{address}")
        self.captured_ns: int | None = None
        self._thread = ReceivingThread(self._read, self._newest.fail)

    def request_frame(self, timeout_s: float) -> bytes:
        """See `CameraSource`."""
        pixels, captured_ns = self._newest.take(timeout_s)
        ok, jpeg = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
        if not ok:
            raise CameraError(f"camera {self._kind}:{self._address}: a picture cannot be encoded")
        self.captured_ns = captured_ns
        return bytes(jpeg)

    def close(self) -> None:
        """See `CameraSource`."""
        self._thread.close()

    def _read(self, closing: threading.Event, backoff: Backoff) -> None:
        """Read pictures from one opening of the device. Raises CameraError when it fails."""
        capture = self._opener(self._kind, self._address)
        try:
            if not capture.isOpened():
                raise CameraError("cannot be opened; is it connected, and may this user read it?")
            while not closing.is_set():
                ok, pixels = capture.read()
                if not ok:
                    raise CameraError("the device has stopped, opening it again")
                self._newest.put(checked(pixels), time.monotonic_ns() - self._latency_ns)
                backoff.reset()
        except cv2.error as error:
            raise CameraError(f"OpenCV: {error.err or error.code}") from error
        finally:
            capture.release()


def checked(pixels: Any) -> npt.NDArray[np.uint8]:
    """Return the pixels if they are a BGR or grey picture of a sensible size. Raises CameraError."""
    picture = isinstance(pixels, np.ndarray) and pixels.dtype == np.uint8
    shaped = picture and (pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] == 3))
    if not shaped or not 0 < min(pixels.shape[:2]) <= max(pixels.shape[:2]) <= MAX_PX:
        found = f"{pixels.dtype} {pixels.shape}" if isinstance(pixels, np.ndarray) else type(pixels).__name__
        raise CameraError(f"expected a picture of 8-bit BGR pixels, found {found}")
    return np.asarray(pixels, dtype=np.uint8)
