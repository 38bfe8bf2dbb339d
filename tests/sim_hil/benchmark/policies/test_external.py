"""A policy server elsewhere: a documented conversation, and nothing it says is trusted."""

from __future__ import annotations

import itertools
import json
import socket
import struct
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge.core.geometry import SE2
from sim_hil.benchmark import external_example
from sim_hil.benchmark.conditions.latency import LatencyProfile
from sim_hil.benchmark.env.observation import Observation
from sim_hil.benchmark.policies.external import ExternalPolicy
from sim_hil.benchmark.policies.external_protocol import (
    MAX_HEADER_BYTES,
    Address,
    Channel,
    Decoder,
    ExternalError,
    Message,
    decode_image,
    encode,
    encode_image,
)
from sim_hil.benchmark.policies.select import robot_config
from tests.support.benchmark import dynanav_fakes as fakes

LIMITS = robot_config().limits
WELCOME = {"type": "welcome", "protocol": "edge-bench-policy", "version": 1, "name": "theirs", "image": None}
Answer = Mapping[str, Any] | None

_values = st.none() | st.booleans() | st.integers(-(10**9), 10**9) | st.text(max_size=20) | st.floats(-1e6, 1e6)
_headers = st.dictionaries(st.text(max_size=8), _values, max_size=5).map(
    lambda h: {**{k: v for k, v in h.items() if k != "payload_bytes"}, "type": "x"}
)


def observation(time_s: float, image: np.ndarray | None = None) -> Observation:
    return Observation(time_s, image, (0.1, 0.0, 0.2), SE2(1.0, 2.0, 0.3), False, False)


@contextmanager
def serving(folder: Path, answer: Callable[[Message, Channel], Answer]) -> Iterator[Address]:
    """A server whose every message is answered by the test; None: no answer."""
    path = folder / "s"
    listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    listening.bind(str(path))
    listening.listen(1)

    def serve() -> None:
        connection, _ = listening.accept()
        with connection:
            channel = Channel(connection, "test")
            try:
                while (message := channel.receive("hello", "reset", "observe", "bye")).kind != "bye":
                    said = answer(message, channel)
                    if said is not None:
                        channel.send(said)
            except ExternalError:
                return

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        yield Address(path=str(path))
    finally:
        listening.close()


def polite(act: Callable[[Message], Answer]) -> Callable[[Message, Channel], Answer]:
    """Welcome and ready as they should be; `act` answers observations."""
    return lambda m, _: {"hello": WELCOME, "reset": {"type": "ready"}}.get(m.kind) or act(m)


def driving(velocity: list[float]) -> Callable[[Message, Channel], Answer]:
    return polite(lambda m: {"type": "act", "step": m.header["step"], "velocity": velocity})


def connect(address: Address, *, timeout_s: float = 5.0, latency: LatencyProfile | None = None) -> ExternalPolicy:
    return ExternalPolicy(address, LIMITS, timeout_s=timeout_s, latency=latency)


@pytest.mark.slow
@given(header=_headers, payload=st.binary(max_size=300), cuts=st.lists(st.integers(0, 400), max_size=5))
def test_a_message_survives_any_fragmentation(header: dict[str, Any], payload: bytes, cuts: list[int]) -> None:
    data, decoder, found = encode(Message(header, payload)), Decoder(), []
    edges = [0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]
    for start, end in itertools.pairwise(edges):
        found += decoder.feed(data[start:end])
    assert found == [Message(header, payload)]


@given(st.binary(max_size=200))
def test_any_bytes_are_messages_or_one_kind_of_error(data: bytes) -> None:
    try:
        Decoder().feed(data)
    except ExternalError as error:
        assert "\n" not in str(error)


def test_a_huge_header_is_refused_before_it_is_read() -> None:
    with pytest.raises(ExternalError, match="header of"):
        Decoder().feed(struct.pack(">I", MAX_HEADER_BYTES + 1))


def test_numbers_that_json_has_not_are_refused() -> None:
    data = b'{"type": "act", "velocity": [NaN, 0, 0]}'
    with pytest.raises(ExternalError, match="not JSON"):
        Decoder().feed(struct.pack(">I", len(data)) + data)


@pytest.mark.parametrize("encoding", ["jpeg", "png", "raw"])
def test_a_picture_survives(encoding: str) -> None:
    picture = np.full((48, 64, 3), (200, 100, 50), dtype=np.uint8)
    read = decode_image(encode_image(picture, encoding), encoding, 64, 48)
    assert np.abs(read.astype(int) - picture).max() <= (3 if encoding == "jpeg" else 0)


@pytest.mark.parametrize("text", ["", "7001", ":7001", "host:", "host:0", "host:99999", "unix:", "host:port"])
def test_an_address_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(ExternalError, match=r"expected HOST:PORT or unix:PATH"):
        Address.parse(text)


def test_its_request_has_the_robots_inputs_and_not_the_goal(tmp_path: Path) -> None:
    requests: list[Message] = []

    def act(message: Message) -> Answer:
        requests.append(message)
        return {"type": "act", "step": message.header["step"], "velocity": [0.5, 0.0, 0.1], "text": "ahead"}

    def answer(message: Message, channel: Channel) -> Answer:
        if message.kind == "reset":
            requests.append(message)
        return polite(act)(message, channel)

    with serving(tmp_path, answer) as address:
        policy = connect(address)
        policy.reset(fakes.episode("a"), "go on", None, 7)
        assert policy.act(observation(0.0)) == (0.5, 0.0, 0.1)
        assert policy.notes() == {"text": "ahead", "waypoints": None, "delay_s": 0.0, "clipped": 0}
        policy.close()
    reset, observe = requests
    assert set(reset.header) == {
        "type", "episode", "robot", "instruction", "seed", "control_period_s", "limits",
    } and reset.header["instruction"] == "go on"  # fmt: skip
    assert observe.header["state"] == [0.1, 0.0, 0.2] and observe.header["pose"] == [1.0, 2.0, 0.3]
    assert "goal" not in json.dumps([message.header for message in requests])


def test_its_request_does_not_identify_the_episode(tmp_path: Path) -> None:
    requests: list[Mapping[str, Any]] = []

    def answer(message: Message, channel: Channel) -> Answer:
        if message.kind == "reset":
            requests.append(message.header)
        return driving([0.0, 0.0, 0.0])(message, channel)

    with serving(tmp_path, answer) as address:
        policy = connect(address)
        for name, seed in (("hospital-reception-20-go2", 10022), ("office-desk-0-go2", 10022)) * 2:
            policy.reset(fakes.episode(name, seed=seed), "go on", None, seed)
        policy.close()
    first, second, again, _ = requests
    assert first == again and first["episode"] != second["episode"] and first["seed"] != second["seed"]
    said = json.dumps(requests)
    assert "reception" not in said and "desk" not in said and "10022" not in said


def test_velocities_are_cut_to_the_robots_limits(tmp_path: Path) -> None:
    with serving(tmp_path, driving([99.0, -9.0, -9.0])) as address:
        policy = connect(address)
        policy.reset(fakes.episode("a"), "go", None, 1)
        assert policy.act(observation(0.0)) == (LIMITS.vx_max_mps, -LIMITS.vy_max_mps, -LIMITS.wz_max_radps)
        assert policy.clipped == 1
        policy.close()


def test_an_answer_takes_effect_after_its_latency_and_one_request_is_open_at_a_time(tmp_path: Path) -> None:
    asked: list[float] = []

    def act(message: Message) -> Answer:
        asked.append(message.header["time_s"])
        return {"type": "act", "step": message.header["step"], "velocity": [0.1 * len(asked), 0.0, 0.0]}

    with serving(tmp_path, polite(act)) as address:
        policy = connect(address, latency=LatencyProfile.constant(0.3))
        policy.reset(fakes.episode("a"), "go", None, 1)
        speeds = [round(policy.act(observation(tick / 10))[0], 3) for tick in range(8)]
        assert policy.notes()["delay_s"] == pytest.approx(0.4)  # at 0.7 s the answer to 0.3 s is in force
        policy.close()
    assert speeds == [0.0, 0.0, 0.0, 0.1, 0.1, 0.1, 0.2, 0.2]
    assert asked == pytest.approx([0.0, 0.3, 0.6])


@pytest.mark.parametrize(
    ("said", "why"),
    [
        ({"type": "act", "step": 0, "velocity": [1.0, 0.0]}, "velocity to be 3 numbers"),
        ({"type": "act", "step": 0, "velocity": [1.0, 0.0, "fast"]}, "3 finite numbers"),
        ({"type": "act", "step": 0, "velocity": [True, 0.0, 0.0]}, "3 finite numbers"),
        ({"type": "act", "step": 1, "velocity": [0.0, 0.0, 0.0]}, "answer to step 0"),
        ({"type": "act", "velocity": [0.0, 0.0, 0.0]}, "lacks 'step'"),
        ({"type": "act", "step": 0, "velocity": [0.0, 0.0, 0.0], "reboot": 1}, "unknown key 'reboot'"),
        ({"type": "act", "step": 0, "velocity": [0.0, 0.0, 0.0], "text": "x" * 5000}, "at most 4096 characters"),
        ({"type": "act", "step": 0, "velocity": [0.0, 0.0, 0.0], "waypoints": [[1]]}, "waypoints to be 2 numbers"),
        ({"type": "welcome"}, "expected act, found 'welcome'"),
        ({"type": "error", "message": "out of memory"}, "reports: out of memory"),
    ],
)
def test_an_answer_that_is_wrong_is_one_clear_line(tmp_path: Path, said: dict[str, Any], why: str) -> None:
    with serving(tmp_path, polite(lambda _: said)) as address:
        policy = connect(address)
        policy.reset(fakes.episode("a"), "go", None, 1)
        with pytest.raises(ExternalError, match=why) as caught:
            policy.act(observation(0.0))
        assert "\n" not in str(caught.value)
        policy.close()


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"version": 2}, "expected edge-bench-policy version 1"),
        ({"image": {"width": 1, "height": 9, "encoding": "jpeg"}}, "32 to 1280 pixels"),
        ({"image": {"width": 64, "height": 64, "encoding": "bmp"}}, "encoding of jpeg, png, raw"),
        ({"image": "yes"}, "null or an object"),
        ({"name": 3}, "name to be a text"),
    ],
)
def test_a_wrong_greeting_is_refused(tmp_path: Path, change: dict[str, Any], why: str) -> None:
    with serving(tmp_path, lambda _m, _c: {**WELCOME, **change}) as address, pytest.raises(ExternalError, match=why):
        connect(address)


def test_a_silent_server_is_given_up(tmp_path: Path) -> None:
    with serving(tmp_path, polite(lambda _: None)) as address:
        policy = connect(address, timeout_s=0.2)
        policy.reset(fakes.episode("a"), "go", None, 1)
        with pytest.raises(ExternalError, match="no act within the time allowed"):
            policy.act(observation(0.0))
        policy.close()


def test_a_server_that_trickles_bytes_is_given_up_too(tmp_path: Path) -> None:
    stop = threading.Event()

    def trickle(message: Message, channel: Channel) -> Answer:
        if message.kind != "observe":
            return polite(lambda _: None)(message, channel)
        for _ in range(40):
            channel.connection.sendall(b"\0")  # the beginning of a length, for ever
            if stop.wait(0.05):
                break
        return None

    with serving(tmp_path, trickle) as address:
        policy = connect(address, timeout_s=0.3)
        policy.reset(fakes.episode("a"), "go", None, 1)
        with pytest.raises(ExternalError):
            policy.act(observation(0.0))
        stop.set()
        policy.close()


def test_a_missing_server_is_one_line_with_advice(tmp_path: Path) -> None:
    with pytest.raises(ExternalError, match=r"cannot be reached .*; start it first"):
        connect(Address(path=str(tmp_path / "nobody")))


def test_the_example_server_drives(tmp_path: Path) -> None:
    address = Address(path=str(tmp_path / "s"))
    listening = external_example.server(address)
    threading.Thread(target=listening.serve_forever, args=(0.02,), daemon=True).start()
    try:
        policy = connect(address)
        policy.reset(fakes.episode("a"), "go", None, 1)
        width, height = policy.camera or (0, 0)
        picture = np.zeros((height, width, 3), dtype=np.uint8)
        picture[:, : width // 2] = 200
        vx, _, wz = policy.act(observation(0.0, picture))
        assert vx > 0 and wz > 0 and "left is brighter" in policy.notes()["text"]
        policy.close()
    finally:
        listening.shutdown()
        listening.server_close()
