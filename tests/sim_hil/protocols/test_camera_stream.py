"""The camera over HTTP: it renders only while a client waits, and ends with its parent."""

from __future__ import annotations

import threading
import time
import urllib.request
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from http.client import HTTPConnection, HTTPResponse

import cv2
import numpy as np
import psutil
import pytest

from sim_hil.protocols.camera_stream import CameraServer, CameraStream, Shutter, listen
from sim_hil.scene.scene import load_scene
from sim_hil.simulation.physics import Simulation
from tests.support.robot.front_end_contract import options

SIZE = (160, 90)


class Studio:
    """A server whose pictures are numbered, stamped and made as fast as they are wanted."""

    def __init__(self) -> None:
        self.shutter = Shutter()
        self.server = CameraServer(listen(0), self.shutter)
        self.port = int(self.server.server_address[1])
        self.captured_ns: list[int] = []
        self.hold = threading.Event()
        self._ending = False
        self._threads = [threading.Thread(target=work) for work in (self.server.serve_forever, self._render)]
        for thread in self._threads:
            thread.start()

    def _render(self) -> None:
        while not self._ending:
            if self.shutter.wanted and not self.hold.is_set():
                self.captured_ns.append(time.monotonic_ns())
                self.shutter.show(self.captured_ns[-1], b"picture %d" % len(self.captured_ns))
            time.sleep(0.001)

    def get(self, path: str) -> HTTPResponse:
        connection = HTTPConnection("127.0.0.1", self.port, timeout=60)
        connection.request("GET", path)
        return connection.getresponse()

    def close(self) -> None:
        self._ending = True
        self.server.shutdown()
        self.server.server_close()
        for thread in self._threads:
            thread.join()


@pytest.fixture
def studio() -> Iterator[Studio]:
    studio = Studio()
    yield studio
    studio.close()


def test_an_image_is_rendered_after_its_request_and_has_a_stamp(studio: Studio) -> None:
    time.sleep(0.05)
    assert not studio.captured_ns, "nobody looks"
    response = studio.get("/frame.jpg")
    number = int(response.read().split()[1])  # a second picture may be finished before the first is sent
    assert response.status == 200 and number >= 1
    assert response.headers["X-Capture-Ns"] == str(studio.captured_ns[number - 1])


def test_an_image_whose_rendering_began_before_the_request_is_not_its_answer(studio: Studio) -> None:
    studio.hold.set()
    began_ns = time.monotonic_ns()
    with ThreadPoolExecutor(1) as client:
        answer = client.submit(lambda: studio.get("/frame.jpg").read())
        deadline = time.monotonic() + 10
        while not studio.shutter.wanted:
            assert time.monotonic() < deadline
            time.sleep(0.001)
        studio.shutter.show(began_ns, b"of an earlier request")
        studio.hold.clear()
        assert answer.result(10).startswith(b"picture")


def test_a_stream_is_one_new_picture_after_another(studio: Studio) -> None:
    stream = studio.get("/stream.mjpg")
    boundary = stream.headers["Content-Type"].split("boundary=")[1].encode()
    numbers = []
    for _ in range(3):
        assert stream.readline().strip() == b"--" + boundary
        headers = dict(line.split(b": ") for line in iter(lambda: stream.readline().strip(), b""))
        numbers.append(int(stream.read(int(headers[b"Content-Length"])).split()[1]))
        assert int(headers[b"X-Capture-Ns"]) == studio.captured_ns[numbers[-1] - 1]
        stream.readline()
    assert numbers == sorted(set(numbers))
    stream.close()


def test_a_disconnected_client_is_removed(studio: Studio) -> None:
    stream = studio.get("/stream.mjpg")
    stream.readline()
    stream.close()
    deadline = time.monotonic() + 10
    while studio.shutter.wanted:
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_another_path_is_refused(studio: Studio) -> None:
    assert studio.get("/etc/passwd").status == 404


def test_it_listens_on_the_loopback_only(studio: Studio) -> None:
    assert studio.server.server_address[0] == "127.0.0.1"


@pytest.fixture(scope="module")
def state() -> np.ndarray:
    simulation = Simulation(load_scene("corridor"), people=0, seed=0, robot="carter")
    state = simulation.render_state()
    simulation.close()
    return state


def _stream(state: np.ndarray, port: int = 0) -> CameraStream:
    return CameraStream(options("carter", camera_size=SIZE), port, len(state))


@pytest.mark.slow
def test_the_process_shows_the_world_at_the_pose_it_was_given(state: np.ndarray) -> None:
    camera = _stream(state)
    try:
        camera.show(state)
        assert camera.wait_ready([])
        url = camera.url.replace("stream.mjpg", "frame.jpg")
        pictures = []
        for turn in (0.0, np.pi):
            turned = state.copy()
            turned[3:7] = (0.0, 0.0, np.sin(turn / 2), np.cos(turn / 2))
            camera.show(turned)
            before_ns = time.monotonic_ns()
            with urllib.request.urlopen(url, timeout=60) as response:
                assert int(response.headers["X-Capture-Ns"]) >= before_ns
                pictures.append(cv2.imdecode(np.frombuffer(response.read(), np.uint8), cv2.IMREAD_COLOR))
        assert pictures[0].shape == (SIZE[1], SIZE[0], 3)
        assert float(np.abs(pictures[0].astype(int) - pictures[1]).mean()) > 5.0, "it looks the other way"
        deadline = time.monotonic() + 10
        while camera.pictures < 2:
            assert time.monotonic() < deadline
            camera.events()
    finally:
        camera.close()
        camera.close()


def test_a_port_that_is_taken_is_refused_in_one_line(state: np.ndarray) -> None:
    with listen(0) as taken, pytest.raises(OSError, match=r"^camera: port \d+: expected a free port, .+$"):
        _stream(state, taken.getsockname()[1])


@pytest.mark.slow
def test_its_address_is_known_before_it_is_ready_and_a_stop_ends_the_wait(state: np.ndarray) -> None:
    before = set(psutil.Process().children())
    camera = _stream(state)
    try:
        assert camera.port > 0 and str(camera.port) in camera.url
        assert not camera.wait_ready([15])
    finally:
        camera.close()
    assert set(psutil.Process().children()) <= before
