"""Faults of the robot's services: what is done with requests and pictures, with a server that only remembers."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator

import cv2
import numpy as np
import pytest

from firmware_bridge.unitree.messages import ids
from sim_hil.protocols.render_process import encode_jpeg
from sim_hil.protocols.snapshot import TornSnapshotError
from sim_hil.protocols.unitree.camera_faults import FaultyVideoHub
from sim_hil.protocols.unitree.fault_commands import FaultCommand, parse
from sim_hil.protocols.unitree.fault_injector import SportFaults
from sim_hil.protocols.unitree.services.service import Answer, Received
from sim_hil.protocols.unitree.video_service import VideoHub

MOVE = '{"x": 0.5, "y": 0, "z": 0}'
ZERO = '{"x": 0, "y": 0, "z": 0}'
WIDTH, HEIGHT = 64, 48


class Server:
    """Hands out requests, remembers the answers."""

    def __init__(self) -> None:
        self.waiting: list[Received] = []
        self.answers: list[tuple[int, bytes]] = []  # (API id, picture)
        self.malformed = 0

    def ask(self, api_id: int, parameter: str = "") -> None:
        self.waiting.append(Received(time.monotonic_ns(), "test", api_id, parameter, 1, noreply=False))

    def requests(self) -> Iterator[Received]:
        waiting, self.waiting = self.waiting, []
        yield from waiting

    def answer(self, request: Received, handle: Callable[[int, str], Answer]) -> Answer:
        return handle(request.api_id, request.parameter)

    def reply(self, request: Received, code: int, data: str = "", binary: bytes = b"") -> None:
        self.answers.append((request.api_id, binary))


def command(name: str, on: bool = True, **values: object) -> FaultCommand:
    shown = "".join(f', "{key}": {value}' for key, value in values.items())
    return parse(f'{{"fault": "{name}", "on": {str(on).lower()}{shown}}}'.encode())


class Sport:
    """A sport service with faults, and what its robot was told."""

    def __init__(self) -> None:
        self.faults, self.server = SportFaults(), Server()
        self.obeyed: list[tuple[int, str]] = []

    def handle(self, api_id: int, parameter: str) -> Answer:
        self.obeyed.append((api_id, parameter))
        return 0, ""

    def serve(self, *requests: tuple[int, str]) -> list[Received]:
        for request in requests:
            self.server.ask(*request)
        return self.faults.serve(self.server, self.handle)  # type: ignore[arg-type]


@pytest.fixture
def sport() -> Sport:
    return Sport()


def test_without_a_fault_requests_are_obeyed_and_answered(sport: Sport) -> None:
    arrived = sport.serve((ids.MOVE, MOVE), (ids.STOP_MOVE, ""))
    assert [one.api_id for one in arrived] == [ids.MOVE, ids.STOP_MOVE]
    assert sport.obeyed == [(ids.MOVE, MOVE), (ids.STOP_MOVE, "")] and len(sport.server.answers) == 2


def test_a_deaf_robot_obeys_nothing_though_it_all_arrived(sport: Sport) -> None:
    sport.faults.set(command("deaf"), 0)
    assert len(sport.serve((ids.MOVE, MOVE), (ids.STOP_MOVE, ""))) == 2
    assert sport.obeyed == [] and sport.server.answers == []


def test_an_unanswered_stop_is_obeyed_at_once_and_answered_late(sport: Sport) -> None:
    sport.faults.set(command("stop-unanswered", delay_s=0.05), 0)
    sport.serve((ids.STOP_MOVE, ""), (ids.STAND_UP, ""))
    assert sport.obeyed == [(ids.STOP_MOVE, ""), (ids.STAND_UP, "")]
    assert [api_id for api_id, _ in sport.server.answers] == [ids.STAND_UP]
    time.sleep(0.06)
    sport.serve()
    assert [api_id for api_id, _ in sport.server.answers] == [ids.STAND_UP, ids.STOP_MOVE]


def test_one_move_overtakes_the_stop_that_followed_it(sport: Sport) -> None:
    sport.faults.set(command("late-move", delay_s=0.02), 0)
    sport.serve((ids.MOVE, ZERO), (ids.MOVE, MOVE), (ids.MOVE, MOVE), (ids.STOP_MOVE, ""))
    assert sport.obeyed == [(ids.MOVE, ZERO), (ids.MOVE, MOVE), (ids.STOP_MOVE, "")]
    assert sport.faults.effects() == []
    time.sleep(0.03)
    sport.serve()
    assert sport.obeyed[-1] == (ids.MOVE, MOVE)
    assert [name for name, _ in sport.faults.effects()] == ["late-move"]


class TestVideoHub:
    @pytest.mark.parametrize("readable", [True, False])
    def test_one_render_answers_all_waiting_requests(self, readable: bool) -> None:
        renders = []

        def render() -> bytes:
            renders.append(1)
            if not readable:
                raise TornSnapshotError("no consistent snapshot")
            return b"jpeg"

        server = Server()
        for _ in range(2):
            server.ask(ids.GET_IMAGE_SAMPLE)
        VideoHub(server, render, lambda _event: None).serve()  # type: ignore[arg-type]
        assert server.answers == [(ids.GET_IMAGE_SAMPLE, b"jpeg" if readable else b"")] * 2 and len(renders) == 1

    def test_each_malformed_request_is_reported_once(self) -> None:
        events: list[dict[str, object]] = []
        server = Server()
        server.malformed = 2
        hub = VideoHub(server, lambda: b"", events.append)  # type: ignore[arg-type]
        hub.serve()
        hub.serve()
        assert events == [{"event": "malformed", "count": 2}]


class Camera:
    """A video service with faults, a new picture for every request, and the commands' pipe."""

    def __init__(self) -> None:
        self.server, self.told = Server(), []
        self._rng = np.random.default_rng(0)
        self._write: int | None
        read, self._write = os.pipe()
        self.hub = FaultyVideoHub(
            self.server, self.render, self.told.append, size=(WIDTH, HEIGHT), commands_fd=read  # type: ignore[arg-type]
        )  # fmt: skip

    def render(self) -> bytes:
        return encode_jpeg(self._rng.integers(40, 200, (HEIGHT, WIDTH, 3), dtype=np.uint8))

    def tell(self, line: bytes) -> bool:
        assert self._write is not None
        os.write(self._write, line + b"\n")
        return self.hub.listen()

    def ask(self, times: int = 1) -> list[bytes]:
        """Answers to `times` requests, one after the other."""
        before = len(self.server.answers)
        for _ in range(times):
            self.server.ask(ids.GET_IMAGE_SAMPLE)
            self.hub.serve()
        return [picture for _, picture in self.server.answers[before:]]

    def effects(self) -> list[str]:
        return [str(event["fault"]) for event in self.told if event["event"] == "fault"]

    def close(self) -> None:
        if self._write is not None:
            os.close(self._write)
            self._write = None


@pytest.fixture
def camera() -> Iterator[Camera]:
    camera = Camera()
    yield camera
    camera.close()


def brightness(jpeg: bytes) -> float:
    return float(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR).mean())


def test_a_stopped_camera_answers_nothing_until_it_is_well_again(camera: Camera) -> None:
    camera.tell(command("camera-stop").line())
    assert camera.ask(2) == [] and camera.effects() == ["camera-stop"]
    camera.tell(command("camera-stop", on=False).line())
    assert len(camera.ask()) == 1


def test_a_frozen_camera_repeats_its_first_picture(camera: Camera) -> None:
    before = camera.ask()
    camera.tell(command("camera-freeze").line())
    after = camera.ask(3)
    assert len(set(after)) == 1 and after[0] not in before


@pytest.mark.parametrize("buffers", [2, 5])
def test_stale_buffers_repeat_the_newest_pictures_in_turn(camera: Camera, buffers: int) -> None:
    before = camera.ask(8)
    camera.tell(command("camera-stale-buffers", buffers=buffers).line())
    after = camera.ask(3 * buffers)
    assert len(set(after)) == buffers and after[:buffers] == after[buffers : 2 * buffers] == after[2 * buffers :]
    assert after[: buffers - 1] == before[9 - buffers :]


def moved_share(first: bytes, second: bytes) -> float:
    """Share of the pixels that differ by more than noise and a JPEG make, blurred over 5 pixels."""
    pictures = [cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE) for jpeg in (first, second)]
    blurred = [cv2.blur(picture, (5, 5)).astype(int) for picture in pictures]
    return float(np.mean(np.abs(blurred[0] - blurred[1]) > 4))


def test_a_clock_changes_a_small_part_of_a_frozen_picture(camera: Camera) -> None:
    camera.tell(command("camera-frozen-clock").line())
    (first,) = camera.ask()
    time.sleep(0.11)  # another tenth of a second is drawn
    (last,) = camera.ask()
    assert first != last and moved_share(first, last) < 0.08


def test_noise_changes_the_bytes_of_a_frozen_picture_and_not_its_scene(camera: Camera) -> None:
    camera.tell(command("camera-frozen-noise").line())
    first, *_, last = camera.ask(3)
    assert first != last and moved_share(first, last) < 0.01


def test_a_stale_camera_answers_with_an_old_picture(camera: Camera) -> None:
    old = camera.ask(3)
    camera.tell(command("camera-stale", delay_s=60).line())
    assert camera.ask(2) == [old[0], old[0]]


def test_a_slow_camera_answers_when_its_delay_is_over(camera: Camera) -> None:
    camera.tell(command("camera-slow", delay_s=0.05).line())
    assert camera.ask() == []
    time.sleep(0.06)
    camera.hub.serve()
    assert len(camera.server.answers) == 1


def test_a_camera_at_half_rate_delays_early_requests(camera: Camera) -> None:
    camera.tell(command("camera-half-rate", rate_hz=10).line())
    assert len(camera.ask()) == 1 and camera.ask() == []
    time.sleep(0.11)
    camera.hub.serve()
    assert len(camera.server.answers) == 2


def test_a_covered_and_a_blinded_camera_show_noise_that_is_never_the_same(camera: Camera) -> None:
    camera.tell(command("camera-black").line())
    black = camera.ask(2)
    assert black[0] != black[1] and max(map(brightness, black)) < 6
    camera.tell(parse(b'{"fault": "clear"}').line())
    camera.tell(command("camera-saturated").line())
    assert min(map(brightness, camera.ask(2))) > 249


def test_a_torn_picture_ends_too_early(camera: Camera) -> None:
    whole = camera.ask()[0]
    camera.tell(command("camera-torn", share=0.5).line())
    torn = camera.ask()[0]
    assert torn[:2] == whole[:2] == b"\xff\xd8" and not torn.endswith(b"\xff\xd9")


def test_a_camera_of_another_size_has_another_size(camera: Camera) -> None:
    camera.tell(command("camera-wrong-size", width=100, height=80).line())
    assert cv2.imdecode(np.frombuffer(camera.ask()[0], np.uint8), cv2.IMREAD_COLOR).shape == (80, 100, 3)


def test_clear_makes_everything_well(camera: Camera) -> None:
    camera.tell(command("camera-stop").line())
    camera.tell(parse(b'{"fault": "clear"}').line())
    assert len(camera.ask()) == 1


def test_the_camera_ends_with_its_parent(camera: Camera) -> None:
    assert camera.tell(command("camera-stop").line())
    camera.close()
    assert not camera.hub.listen()
