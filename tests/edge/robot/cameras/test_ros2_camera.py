"""A camera that is a ROS 2 topic: the newest picture, raw ones encoded, and what is none refused."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.robot.camera import decode_frame
from edge.robot.cameras import ros2 as module
from edge.robot.cameras.ros2 import Ros2Camera
from edge.robot.cameras.ros2_pictures import compressed_picture, raw_picture
from firmware_bridge.core.config import ConfigError, DdsConfig
from firmware_bridge.core.robot_state import CameraError
from firmware_bridge.dds import bus as bus_module
from firmware_bridge.dds.bus import Bus
from firmware_bridge.dds.shared_bus import SharedBus
from firmware_bridge.ros2.messages.common import Header_, Time_
from firmware_bridge.ros2.messages.sensors import CompressedImage_, Image_
from tests.support.processes import wait_for

HEADER = Header_(Time_(3, 500_000_000), "camera")
COLOUR = np.full((48, 64, 3), (200, 100, 30), dtype=np.uint8)  # RGB
LATENCY_NS = 30_000_000


def jpeg(red: int = 200) -> bytes:
    picture = np.full((48, 64, 3), (30, 100, red), dtype=np.uint8)
    return cv2.imencode(".jpg", picture)[1].tobytes()


def compressed(data: bytes, format: str = "jpeg") -> CompressedImage_:
    return CompressedImage_(HEADER, format, data)


def raw(encoding: str, pixels: np.ndarray, *, padding: int = 0, **changes: int) -> Image_:
    height, width = pixels.shape[:2]
    rows = pixels.reshape(height, -1)
    rows = np.pad(rows, ((0, 0), (0, padding)))
    values = {"height": height, "width": width, "step": rows.shape[1], **changes}
    return Image_(HEADER, values["height"], values["width"], encoding, 0, values["step"], rows.tobytes())


def yuy2(pixels: np.ndarray) -> np.ndarray:
    """RGB to Y0 U Y1 V as video has it (BT.601, Y of 16 to 235)."""
    to_yuv = np.array([[0.257, -0.148, 0.439], [0.504, -0.291, -0.368], [0.098, 0.439, -0.071]])
    y, u, v = np.moveaxis(np.rint(pixels @ to_yuv + (16, 128, 128)).astype(np.uint8), -1, 0)
    packed = np.empty((*pixels.shape[:2], 2), dtype=np.uint8)
    packed[..., 0] = y
    packed[:, 0::2, 1], packed[:, 1::2, 1] = u[:, 0::2], v[:, 1::2]
    return packed


@pytest.mark.parametrize(
    ("encoding", "pixels"),
    [
        ("rgb8", COLOUR),
        ("bgr8", COLOUR[..., ::-1]),
        ("8UC3", COLOUR[..., ::-1]),
        ("rgba8", np.dstack((COLOUR, np.full((48, 64), 255, np.uint8)))),
        ("bgra8", np.dstack((COLOUR[..., ::-1], np.full((48, 64), 255, np.uint8)))),
        ("yuv422_yuy2", yuy2(COLOUR)),
        ("uyvy", yuy2(COLOUR)[..., ::-1]),
    ],
)
@pytest.mark.parametrize("padding", [0, 5])
def test_a_raw_picture_keeps_its_colours(encoding: str, pixels: np.ndarray, padding: int) -> None:
    found, stamp_ns = raw_picture(raw(encoding, pixels, padding=padding).serialize())
    middle = decode_frame(found, 64)[0, 32, 32].tolist()
    assert middle == pytest.approx([200, 100, 30], abs=4)
    assert stamp_ns == 3_500_000_000


def test_a_grey_picture_is_encoded() -> None:
    found, _ = raw_picture(raw("mono8", np.full((48, 64, 1), 90, np.uint8)).serialize())
    assert decode_frame(found, 64)[0, 32, 32].tolist() == pytest.approx([90, 90, 90], abs=4)


@pytest.mark.parametrize(
    ("message", "complaint"),
    [
        (raw("16UC1", COLOUR), "expected an encoding of rgb8"),
        (raw("rgb8", COLOUR, width=0), "a picture of 0x48 pixels"),
        (raw("rgb8", COLOUR, height=5000), "a picture of 64x5000 pixels"),
        (raw("rgb8", COLOUR, width=65), "do not fit"),
        (raw("rgb8", COLOUR, step=2**32 - 1), "do not fit"),
        (raw("yuyv", COLOUR, width=63), "a picture of 63x48 pixels in yuyv"),
    ],
)
def test_a_raw_picture_that_is_none_is_refused(message: Image_, complaint: str) -> None:
    with pytest.raises(CameraError, match=complaint):
        raw_picture(message.serialize())


def test_a_compressed_picture_of_another_kind_is_refused() -> None:
    png = cv2.imencode(".png", COLOUR)[1].tobytes()
    with pytest.raises(CameraError, match="expected a JPEG, found format 'png'"):
        compressed_picture(compressed(png, "png").serialize())


@pytest.mark.parametrize("convert", [compressed_picture, raw_picture])
@pytest.mark.parametrize("good", [compressed(jpeg()).serialize(), raw("rgb8", COLOUR[:2, :2]).serialize()])
def test_any_bytes_are_a_picture_or_a_camera_error(convert: Callable[[bytes], object], good: bytes) -> None:
    @settings(max_examples=100)
    @given(st.one_of(st.binary(max_size=100), st.binary(max_size=60).map(lambda head: head + good[len(head) :])))
    def holds(data: bytes) -> None:
        try:
            convert(data)
        except CameraError as error:
            assert "\n" not in str(error)

    holds()


@pytest.fixture
def shared(dds_domain: int) -> Iterator[SharedBus]:
    shared = SharedBus(DdsConfig(dds_domain, "lo", ("127.0.0.1",)))
    yield shared
    shared.close()


def frames_of(camera: Ros2Camera, publish: Callable[[], object]) -> bytes:
    """The first picture that arrives while `publish` is repeated."""
    found: list[bytes] = []

    def arrived() -> bool:
        publish()
        try:
            found.append(camera.request_frame(0.05))
        except CameraError:
            return False
        return True

    wait_for(arrived, 5, "a picture")
    return found[0]


def test_a_picture_arrives_as_it_was_sent_with_its_stamps(shared: SharedBus) -> None:
    with closing(Ros2Camera(shared, "/camera/image/compressed", raw=False, latency_ns=LATENCY_NS)) as camera:
        writer = shared.open().writer("rt/camera/image/compressed", CompressedImage_)
        sent = jpeg()
        assert frames_of(camera, lambda: writer.write(compressed(sent))) == sent
        assert camera.header_stamp_ns == 3_500_000_000 and camera.captured_ns is not None
        assert LATENCY_NS <= time.monotonic_ns() - camera.captured_ns < LATENCY_NS + 5_000_000_000


@pytest.mark.parametrize(
    ("stamps_s", "older_s"), [((3, 4), 0.0), ((3, 3.1), 0.9), ((3, 3), 0.0)], ids=["in time", "held back", "constant"]
)
def test_a_picture_that_the_network_holds_back_is_older_by_its_stamp(
    stamps_s: tuple[float, float], older_s: float, monkeypatch: pytest.MonkeyPatch, shared: SharedBus
) -> None:
    arrivals = iter((100_000_000_000, 101_000_000_000))
    with closing(Ros2Camera(shared, "/image", raw=False)) as camera:
        monkeypatch.setattr(camera._newest, "take", lambda _timeout_s: (b"", next(arrivals)))
        stamps = iter(stamps_s)
        monkeypatch.setattr(module, "compressed_picture", lambda _data: (b"", round(next(stamps) * 1e9)))
        for _ in stamps_s:
            camera.request_frame(0.0)
        assert camera.captured_ns is not None
        assert 101.0 - camera.captured_ns / 1e9 == pytest.approx(older_s, abs=0.001)


def test_only_the_newest_picture_is_returned_and_once(shared: SharedBus) -> None:
    with closing(Ros2Camera(shared, "/image", raw=False)) as camera:
        writer = shared.open().writer("rt/image", CompressedImage_)
        frames_of(camera, lambda: writer.write(compressed(jpeg())))
        time.sleep(0.1)
        for red in (20, 60, 120, 250):
            writer.write(compressed(jpeg(red)))
            time.sleep(0.02)
        time.sleep(0.2)
        assert int(decode_frame(camera.request_frame(1.0), 64)[0, 32, 32, 0]) == pytest.approx(250, abs=6)
        with pytest.raises(CameraError, match=r"camera ros2:/image: no new picture within 50 ms"):
            camera.request_frame(0.05)


def test_two_threads_that_come_for_one_topic_at_once_share_it(
    shared: SharedBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []

    def slow_topic(_participant: object, name: str, _kind: object) -> str:
        time.sleep(0.05)
        made.append(name)
        return name

    monkeypatch.setattr(bus_module, "Topic", slow_topic)
    bus = shared.open()
    with ThreadPoolExecutor(4) as threads:
        topics = list(threads.map(lambda _: bus._topic("rt/image_raw", Image_), range(4)))
    assert topics == ["rt/image_raw"] * 4 and made == ["rt/image_raw"]


def test_a_raw_topic_gives_jpegs(shared: SharedBus) -> None:
    with closing(Ros2Camera(shared, "/image_raw", raw=True, reliable=True)) as camera:
        writer = shared.open().writer("rt/image_raw", Image_)
        found = frames_of(camera, lambda: writer.write(raw("rgb8", COLOUR)))
        assert decode_frame(found, 64)[0, 32, 32].tolist() == pytest.approx([200, 100, 30], abs=4)


def test_a_topic_without_a_publisher_says_so(shared: SharedBus) -> None:
    with closing(Ros2Camera(shared, "/nothing", raw=True)) as camera:
        time.sleep(0.3)
        with pytest.raises(CameraError, match=r"camera ros2raw:/nothing: no node publishes rt/nothing as Image within"):
            camera.request_frame(0.05)


def test_a_picture_that_is_none_is_one_error_and_the_next_one_arrives(shared: SharedBus) -> None:
    with closing(Ros2Camera(shared, "/image", raw=False)) as camera:
        writer = shared.open().writer("rt/image", CompressedImage_)
        frames_of(camera, lambda: writer.write(compressed(jpeg())))
        writer.write(compressed(b"no picture"))
        with pytest.raises(CameraError, match=r"camera ros2:/image: expected a JPEG, found format 'jpeg'"):
            camera.request_frame(2.0)
        assert frames_of(camera, lambda: writer.write(compressed(jpeg())))


def test_a_camera_with_a_bus_of_its_own_leaves_the_domain_and_waits_for_one_in_use(dds_domain: int) -> None:
    network = DdsConfig(dds_domain, "lo", ("127.0.0.1",))
    Ros2Camera(network, "/image", raw=False).close()
    bus = Bus(network)
    with closing(Ros2Camera(network, "/image", raw=False)) as camera:
        time.sleep(0.1)
        with pytest.raises(CameraError, match="this process has already opened it"):
            camera.request_frame(0.05)
        bus.close()
        wait_for(lambda: "no node publishes" in error_of(camera), 5, "the domain")


def error_of(camera: Ros2Camera) -> str:
    try:
        camera.request_frame(0.01)
    except CameraError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("topic", ["image//raw", "~/image", ""])
def test_an_illegal_topic_is_refused(topic: str) -> None:
    with pytest.raises(ConfigError, match=r"camera\.source: expected a ROS 2 topic name"):
        Ros2Camera(DdsConfig(0, "lo"), topic, raw=False)
