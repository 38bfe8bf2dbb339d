"""A camera that streams over HTTP: the newest picture, its age, and servers that stall, close or send garbage."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress

import pytest

from edge.robot.cameras import mjpeg
from edge.robot.cameras.mjpeg import MjpegCamera
from firmware_bridge.core.robot_state import CameraError
from sim_hil.protocols.camera_stream import CameraServer, Shutter, listen
from tests.edge.robot.cameras.test_multipart import HEAD, JPEG_A, JPEG_B, part

LATENCY_NS = 40_000_000
pytestmark = pytest.mark.process


class Server:
    """A TCP server on loopback that answers every connection as `answer` does."""

    def __init__(self, answer: Callable[[socket.socket], None]) -> None:
        self._answer = answer
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listening.getsockname()[1]}/stream"
        self.connections = 0
        self.closing = threading.Event()
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        while not self.closing.is_set():
            try:
                connection, _ = self._listening.accept()
            except OSError:
                return
            self.connections += 1
            with connection, suppress(OSError):
                assert connection.recv(4096).startswith(b"GET /stream HTTP/1.0\r\n")
                self._answer(connection)

    def close(self) -> None:
        self.closing.set()
        self._listening.close()


def camera_of(server: Server, stall_s: float = 3.0) -> MjpegCamera:
    return MjpegCamera(server.url, latency_ns=LATENCY_NS, stall_ns=round(stall_s * 1e9))


def served(data: bytes, hold_s: float = 5.0) -> Server:
    """A server that sends these bytes and then nothing."""
    server: Server

    def answer(connection: socket.socket) -> None:
        connection.sendall(data)
        server.closing.wait(hold_s)

    server = Server(answer)
    return server


def error_of(camera: MjpegCamera, timeout_s: float) -> str:
    began = time.monotonic()
    with pytest.raises(CameraError) as raised:
        camera.request_frame(timeout_s)
    assert time.monotonic() - began < timeout_s + 0.3
    return str(raised.value)


def until_error(camera: MjpegCamera, text: str, limit_s: float = 5.0) -> None:
    deadline = time.monotonic() + limit_s
    while text not in (found := error_of(camera, 0.05)):
        assert time.monotonic() < deadline, found


class TestSimulatedCamera:
    """The camera process of `edge-hil`, with pictures of the test."""

    @pytest.fixture
    def shutter(self) -> Shutter:
        return Shutter()

    @pytest.fixture
    def camera(self, shutter: Shutter) -> Iterator[MjpegCamera]:
        server = CameraServer(listen(0), shutter)
        thread = threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True)
        thread.start()
        url = f"http://127.0.0.1:{server.socket.getsockname()[1]}/stream.mjpg"
        with closing(MjpegCamera(url, latency_ns=LATENCY_NS)) as camera:
            deadline = time.monotonic() + 5
            while not shutter.wanted:
                assert time.monotonic() < deadline
                time.sleep(0.01)
            yield camera
        server.shutdown()
        server.server_close()

    def test_a_picture_arrives_with_the_stamp_of_its_capture(self, shutter: Shutter, camera: MjpegCamera) -> None:
        captured_ns = time.monotonic_ns() - 7_000_000
        shutter.show(captured_ns, JPEG_A)
        assert camera.request_frame(5.0) == JPEG_A and camera.captured_ns == captured_ns

    def test_a_stamp_from_the_future_is_not_believed(self, shutter: Shutter, camera: MjpegCamera) -> None:
        shutter.show(time.monotonic_ns() + 3_600_000_000_000, JPEG_A)
        camera.request_frame(5.0)
        assert camera.captured_ns is not None and camera.captured_ns <= time.monotonic_ns() - LATENCY_NS

    def test_the_newest_picture_wins_and_none_is_returned_twice(self, shutter: Shutter, camera: MjpegCamera) -> None:
        for number in range(5):
            shutter.show(time.monotonic_ns(), JPEG_B + bytes([number]))
            time.sleep(0.02)
        time.sleep(0.3)
        assert camera.request_frame(1.0) == JPEG_B + b"\x04"
        assert "no new picture" in error_of(camera, 0.1)


class Elsewhere:
    """The address of another machine."""

    is_loopback = False


def test_a_picture_of_another_machine_that_came_late_is_older(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mjpeg.ipaddress, "ip_address", lambda _address: Elsewhere)
    server: Server

    def answer(connection: socket.socket) -> None:
        connection.sendall(HEAD + part(JPEG_A, more="X-Capture-Ns: 10000000000\r\n"))
        time.sleep(0.5)
        connection.sendall(part(JPEG_B, more="X-Capture-Ns: 10050000000\r\n"))  # 450 ms in a queue
        server.closing.wait(5.0)

    server = Server(answer)
    with closing(server), closing(camera_of(server)) as camera:
        assert camera.request_frame(5.0) == JPEG_A and camera.request_frame(5.0) == JPEG_B
        assert camera.captured_ns is not None
        assert camera.captured_ns <= time.monotonic_ns() - LATENCY_NS - 400_000_000


def test_the_stamp_of_another_machine_is_not_of_this_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mjpeg.ipaddress, "ip_address", lambda _address: Elsewhere)
    with (
        closing(served(HEAD + part(JPEG_A, more="X-Capture-Ns: 5\r\n"))) as server,
        closing(camera_of(server)) as camera,
    ):
        before_ns = time.monotonic_ns()
        camera.request_frame(5.0)
        assert camera.captured_ns is not None and camera.captured_ns >= before_ns - LATENCY_NS - 1_000_000_000


def test_a_request_waits_no_longer_than_its_timeout() -> None:
    with closing(served(b"")) as server, closing(camera_of(server)) as camera:
        assert "within 100 ms" in error_of(camera, 0.1)


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (b"\x00\xff garbage\r\n\r\n", "expected an HTTP answer"),
        (b"HTTP/1.0 200 OK\r\n" + b"X-Long: " + b"a" * 20_000, "header of at most"),
        (HEAD.replace(b"; boundary=frame", b""), "expected a boundary"),
        (HEAD + part(b"GIF89a"), "expected a JPEG picture"),
    ],
)
def test_garbage_is_one_line_and_another_attempt(answer: bytes, text: str) -> None:
    with closing(served(answer, hold_s=0.0)) as server, closing(camera_of(server)) as camera:
        until_error(camera, text)
        deadline = time.monotonic() + 5
        while server.connections < 2:
            assert time.monotonic() < deadline
            time.sleep(0.02)


def test_a_server_that_closes_is_connected_again() -> None:
    with closing(served(HEAD + part(JPEG_A), hold_s=0.0)) as server, closing(camera_of(server)) as camera:
        assert [camera.request_frame(5.0) for _ in range(3)] == [JPEG_A] * 3
        assert server.connections >= 3


def test_a_server_that_dribbles_is_given_up() -> None:
    def dribble(connection: socket.socket) -> None:
        connection.sendall(HEAD)
        while True:
            connection.sendall(b"x")
            time.sleep(0.02)

    with closing(Server(dribble)) as server, closing(camera_of(server, stall_s=0.3)) as camera:
        until_error(camera, "no complete picture for 0.3 s")
        deadline = time.monotonic() + 5
        while server.connections < 2:
            assert time.monotonic() < deadline
            time.sleep(0.02)


def test_a_server_that_is_not_there_is_one_line_and_found_when_it_comes() -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as free:
        port = free.getsockname()[1]
    with closing(MjpegCamera(f"http://127.0.0.1:{port}/stream.mjpg", latency_ns=0)) as camera:
        until_error(camera, "no connection (Connection refused)")
        shutter = Shutter()
        server = CameraServer(listen(port), shutter)
        threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
        deadline = time.monotonic() + 10
        while not shutter.wanted:
            assert time.monotonic() < deadline
            time.sleep(0.02)
        shutter.show(time.monotonic_ns(), JPEG_A)
        assert camera.request_frame(5.0) == JPEG_A
        server.shutdown()
        server.server_close()


def test_closing_does_not_wait_for_the_server() -> None:
    with closing(served(HEAD)) as server:
        camera = camera_of(server)
        error_of(camera, 0.1)
        began = time.monotonic()
        camera.close()
        assert time.monotonic() - began < 1.0
