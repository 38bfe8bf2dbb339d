"""What the view's server gives its clients of the runner's records, without a process or a runner."""

from __future__ import annotations

import asyncio
import json
import socket
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
from aiohttp import WSServerHandshakeError
from aiohttp.test_utils import TestClient, TestServer

from edge.live import stop, wire
from edge.live.server import LiveServer
from tests.edge.live.test_live_view import tick

Client = TestClient[Any, Any]


def serve(datagrams: list[bytes], body: Callable[[Client], Awaitable[Any]], bridge: Path | None = None) -> Any:
    """Give a server its runner's datagrams; return what `body` finds as a client that comes later."""

    async def run() -> Any:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with ours, theirs:
            server = LiveServer(wire.ViewConfig("127.0.0.1", 0, "t", bridge), ours)
            for data in datagrams:
                server.take(data)
            async with TestClient(TestServer(server.app())) as client:
                return await body(client)

    return asyncio.run(run())


def record(topic: str, content: dict[str, Any]) -> bytes:
    return wire.Datagram(wire.RECORD, json.dumps(content).encode(), topic, 5).encode()


def test_a_late_viewer_gets_the_newest_of_every_entity_of_the_scene() -> None:
    anchor = {"text": "Scene: a corridor.", "anchor_pose": [0.0, 0.0, 0.0]}
    seen = {"now_ns": 5, "offset": [0.5, 0.0, 0.1], "offset_sd": [0.2, 0.1, 0.01]}
    datagrams = [
        record("/semantic", {**anchor, "waypoints": [[1.0, 0.0]]}),
        record("/semantic", {**anchor, "waypoints": [[3.0, 0.0], [4.0, 0.0]]}),
        record("/tick", tick(**seen)),
        record("/tick", tick(**seen, tick=5)),
    ]

    async def subscribe(client: Client) -> dict[str, dict[str, Any]]:
        found: dict[str, dict[str, Any]] = {}
        async with client.ws_connect("/foxglove?token=t", protocols=("foxglove.sdk.v1",)) as channel:
            assert (await channel.receive_json(timeout=5))["op"] == "serverInfo"
            offered = (await channel.receive_json(timeout=5))["channels"]
            (scene,) = [each["id"] for each in offered if each["topic"] == "/scene"]
            await channel.send_json({"op": "subscribe", "subscriptions": [{"id": 7, "channelId": scene}]})
            while len(found) < 2:
                message = json.loads((await channel.receive_bytes(timeout=5))[13:])
                for entity in message["entities"]:
                    assert entity["id"] not in found, "the newest of each alone"
                    found[entity["id"]] = entity
        return found

    found = serve(datagrams, subscribe)
    assert set(found) == {"semantic state", "odometry 2 sd"}
    assert len(found["semantic state"]["spheres"]) == 2


def test_the_metrics_count_what_the_runner_dropped_and_what_cannot_be_read() -> None:
    datagrams = [
        b"",
        wire.Datagram(wire.RECORD, b"{", "/tick", 5).encode(),
        wire.Datagram(wire.DROPPED, b"3").encode(),
        wire.Datagram(wire.DROPPED, b"7").encode(),
    ]

    async def read(client: Client) -> str:
        return await (await client.get("/metrics?token=t")).text()

    assert "tic_vla_view_dropped_records 9.0" in serve(datagrams, read).splitlines()


@pytest.mark.parametrize(
    ("path", "origin", "served"),
    [
        ("/foxglove", "https://app.foxglove.dev", True),
        ("/foxglove", "file://", True),
        ("/foxglove", "https://elsewhere.example", False),
        ("/view", "file://", False),
        ("/view", "https://app.foxglove.dev", False),
    ],
)
def test_only_foxglove_is_served_pages_of_another_origin(path: str, origin: str, served: bool) -> None:
    async def status(client: Client) -> int:
        try:
            async with client.ws_connect(f"{path}?token=t", protocols=("foxglove.sdk.v1",), headers={"Origin": origin}):
                return 101
        except WSServerHandshakeError as error:
            return error.status

    assert serve([], status) == (101 if served else 403)


def test_foxglove_without_the_token_is_refused_from_its_own_origin() -> None:
    async def status(client: Client) -> int:
        response = await client.get("/foxglove", headers={"Origin": "file://"})
        return int(response.status)

    assert serve([], status) == 403


@pytest.mark.parametrize(("datagrams", "stamp_ns"), [([record("/run", {})], 5), ([], None)])
def test_an_answer_to_a_stop_names_its_run(
    datagrams: list[bytes], stamp_ns: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A page may show another run by then: the next one answers at the same address."""
    monkeypatch.setattr(stop, "operate", lambda *_, **__: (0, {}))

    async def press(client: Client) -> Any:
        return await (await client.post("/stop", headers={"Authorization": "Bearer t"})).json()

    answer = serve(datagrams, press, Path("b.sock"))
    assert answer["stopped"] is True and answer["run"] == stamp_ns
