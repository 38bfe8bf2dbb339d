"""A camera that OpenCV opens, with OpenCV's capture replaced: pictures, failures, and pictures that are none."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import closing
from typing import Any

import cv2
import numpy as np
import pytest

from edge.robot.camera import decode_frame
from edge.robot.cameras import video_capture
from edge.robot.cameras.video_capture import Capture, VideoCaptureCamera, checked, open_capture
from firmware_bridge.core.robot_state import CameraError

LATENCY_NS = 30_000_000


def picture(red: int) -> np.ndarray[Any, np.dtype[np.uint8]]:
    return np.full((48, 64, 3), (0, 0, red), dtype=np.uint8)


class FakeCapture:
    """Gives the pictures of a list, one every 5 ms, then fails."""

    def __init__(self, pictures: list[Any], *, opened: bool = True) -> None:
        self._pictures, self._opened = iter(pictures), opened
        self.released = threading.Event()

    def isOpened(self) -> bool:  # noqa: N802 - OpenCV's name
        return self._opened

    def read(self) -> tuple[bool, Any]:
        time.sleep(0.005)
        pixels = next(self._pictures, None)
        return pixels is not None, pixels

    def release(self) -> None:
        self.released.set()


def camera_with(opener: Callable[[str, str], Capture]) -> VideoCaptureCamera:
    return VideoCaptureCamera("v4l2", "/dev/video0", latency_ns=LATENCY_NS, opener=opener)


def test_the_newest_picture_is_encoded_and_stamped_with_its_age() -> None:
    done = FakeCapture([picture(10), picture(200)])
    captures = iter([done])
    with closing(camera_with(lambda _kind, _address: next(captures, FakeCapture([], opened=False)))) as camera:
        assert done.released.wait(5)
        pixels = decode_frame(camera.request_frame(1.0), 64)
        assert pixels[0, 32, 32].tolist() == pytest.approx([200, 0, 0], abs=4)
        assert camera.captured_ns is not None
        assert LATENCY_NS <= time.monotonic_ns() - camera.captured_ns < LATENCY_NS + 5_000_000_000
        with pytest.raises(CameraError, match=r"camera v4l2:/dev/video0: .* within 50 ms"):
            camera.request_frame(0.05)


def test_a_device_that_fails_is_released_and_opened_again() -> None:
    captures = [FakeCapture([picture(1)]), FakeCapture([picture(2)])]
    remaining = iter(captures)
    with closing(camera_with(lambda _kind, _address: next(remaining, FakeCapture([], opened=False)))) as camera:
        assert captures[1].released.wait(5) and captures[0].released.is_set()
        camera.request_frame(1.0)


def test_a_device_that_cannot_be_opened_is_one_line() -> None:
    capture = FakeCapture([], opened=False)
    with closing(camera_with(lambda _kind, _address: capture)) as camera:
        assert capture.released.wait(5)
        time.sleep(0.05)
        with pytest.raises(CameraError, match="cannot be opened; is it connected"):
            camera.request_frame(0.05)


def test_a_driver_that_hangs_delays_neither_a_request_nor_the_end() -> None:
    hung = threading.Event()

    class Hanging(FakeCapture):
        def read(self) -> tuple[bool, Any]:
            hung.wait(20)
            return False, None

    camera = camera_with(lambda _kind, _address: Hanging([]))
    began = time.monotonic()
    with pytest.raises(CameraError):
        camera.request_frame(0.1)
    camera.close()
    assert time.monotonic() - began < 2.0
    hung.set()


@pytest.mark.parametrize(
    "bad",
    [None, b"jpeg", np.zeros((0, 0, 3), np.uint8), np.zeros((4, 4, 3), np.float32), np.zeros((4, 4, 4), np.uint8),
     np.zeros((5000, 4, 3), np.uint8)],
)  # fmt: skip
def test_a_picture_of_another_kind_or_size_is_refused(bad: object) -> None:
    with pytest.raises(CameraError, match="expected a picture"):
        checked(bad)


def test_an_opencv_without_the_backend_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video_capture.cv2.videoio_registry, "hasBackend", lambda _api: False)
    with pytest.raises(CameraError, match="built without gstreamer"):
        open_capture("gstreamer", "videotestsrc ! appsink")


def test_the_device_queue_holds_one_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[tuple[Any, ...]] = []

    class Recorder:
        def __init__(self, *arguments: object) -> None:
            calls.append(arguments)

        def set(self, *arguments: object) -> None:
            calls.append(arguments)

    monkeypatch.setattr(cv2, "VideoCapture", Recorder)
    monkeypatch.setattr(cv2.videoio_registry, "hasBackend", lambda _api: True)
    open_capture("v4l2", "/dev/video3")
    assert calls == [("/dev/video3", cv2.CAP_V4L2), (cv2.CAP_PROP_BUFFERSIZE, 1)]
