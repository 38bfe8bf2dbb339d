"""The camera poller: steady requests, honest capture stamps, and bad pictures that hurt nobody."""

from __future__ import annotations

import time

import cv2
import numpy as np
import pytest

from edge.odometry.visual_odometry import grey_frame
from edge.robot.camera import CameraPoller, decode_frame
from edge.state.frame import fit_frame
from firmware_bridge.core.robot_state import CameraError

MS = 1_000_000


def jpeg(colour_rgb: tuple[int, int, int] = (200, 30, 30), shape: tuple[int, int] = (180, 320)) -> bytes:
    picture = np.full((*shape, 3), colour_rgb[::-1], dtype=np.uint8)
    return bytes(cv2.imencode(".jpg", picture)[1])


def poll(request, seconds: float, latency_ms: int = 0, period_ms: int = 50) -> CameraPoller:
    poller = CameraPoller(request, image_px=64, period_ns=period_ms * MS, timeout_s=0.2, latency_ns=latency_ms * MS)
    poller.start()
    time.sleep(seconds)
    poller.close()
    return poller


def test_a_frame_is_rgb_and_of_the_encoders_size() -> None:
    frame = decode_frame(jpeg((200, 30, 30)), 64)
    assert frame.shape == (1, 64, 64, 3)
    assert frame[0, 32, 32].tolist() == pytest.approx([200, 30, 30], abs=4)


@pytest.mark.parametrize("bad", [b"\x00", b"\xff\xd8 not really", jpeg()[:60]])
def test_bytes_that_are_no_picture_are_refused(bad: bytes) -> None:
    with pytest.raises(CameraError):
        decode_frame(bad, 64)


def huge(width: int, height: int) -> bytes:
    """A JPEG whose header says that it is larger than it is."""
    picture = bytearray(jpeg())
    at = picture.index(b"\xff\xc0") + 5
    picture[at : at + 4] = height.to_bytes(2, "big") + width.to_bytes(2, "big")
    return bytes(picture)


@pytest.mark.parametrize("size", [(65500, 65500), (30000, 30000), (4097, 16), (0, 16)])
def test_a_picture_of_an_implausible_size_is_refused_before_it_is_decoded(
    size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    with pytest.raises(CameraError, match="pixels"):
        decode_frame(huge(*size), 64)
    assert grey_frame(huge(*size)) is None


def test_a_picture_of_too_many_bytes_is_refused() -> None:
    with pytest.raises(CameraError, match="bytes, at most"):
        decode_frame(jpeg() + bytes(8 * 1024 * 1024), 64)


def test_a_decoder_that_fails_costs_a_frame_and_not_the_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_arguments: object) -> None:
        raise cv2.error("out of memory")

    monkeypatch.setattr(cv2, "imdecode", fail)
    with pytest.raises(CameraError, match="cannot be decoded"):
        decode_frame(jpeg(), 64)
    assert grey_frame(jpeg()) is None


def test_a_thread_that_dies_is_reported_once() -> None:
    deaths: list[str] = []

    def request(_timeout_s: float) -> bytes:
        raise RuntimeError("the bus is gone")

    poller = CameraPoller(request, image_px=64, period_ns=10 * MS, timeout_s=0.2, latency_ns=0, on_death=deaths.append)
    poller.start()
    deadline = time.monotonic() + 5
    while not deaths and time.monotonic() < deadline:
        time.sleep(0.01)
    poller.close()
    assert deaths == ["camera thread died: RuntimeError: the bus is gone"]


def test_an_image_of_another_kind_is_refused() -> None:
    with pytest.raises(ValueError, match="uint8"):
        fit_frame(np.zeros((4, 4), dtype=np.uint8), 64)


def test_a_frame_is_stamped_with_its_arrival_less_the_cameras_latency() -> None:
    arrivals: list[int] = []

    def request(_timeout_s: float) -> bytes:
        time.sleep(0.03)
        picture = jpeg()
        arrivals.append(time.monotonic_ns())
        return picture

    poller = poll(request, 0.2, latency_ms=10)
    assert poller.newest is not None
    assert poller.newest.stamp_ns - (arrivals[poller.frames - 1] - 10 * MS) == pytest.approx(0, abs=5 * MS)


def test_a_stamp_is_never_before_the_request() -> None:
    requests: list[int] = []

    def request(_timeout_s: float) -> bytes:
        requests.append(time.monotonic_ns())
        return jpeg()

    poller = poll(request, 0.2, latency_ms=1000)
    assert poller.newest is not None
    assert poller.newest.stamp_ns >= requests[poller.frames - 1] - 5 * MS


def test_failures_are_counted_and_the_next_frame_is_requested() -> None:
    answers = iter([b"garbage", None, jpeg()])

    def request(_timeout_s: float) -> bytes:
        answer = next(answers, jpeg())
        if answer is None:
            raise CameraError("camera: no answer")
        return answer

    poller = poll(request, 0.4)
    assert poller.failures == 2
    assert poller.frames >= 1
    assert poller.last_error == "camera: no answer"


@pytest.mark.parametrize("known", [True, False])
def test_a_capture_stamp_of_the_source_replaces_the_estimate(known: bool) -> None:
    stamp_ns = time.monotonic_ns() - 500 * MS
    poller = CameraPoller(
        lambda _timeout_s: jpeg(), image_px=64, period_ns=20 * MS, timeout_s=0.2, latency_ns=0,
        captured_ns=lambda: stamp_ns if known else None,
    )  # fmt: skip
    poller.start()
    time.sleep(0.1)
    poller.close()
    assert poller.newest is not None and (poller.newest.stamp_ns == stamp_ns) is known
