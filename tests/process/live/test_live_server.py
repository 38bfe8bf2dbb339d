"""The live view's process: who may read it, who may stop the robot, and what slow or hostile clients cost."""

from __future__ import annotations

import asyncio
import json
import re
import socket
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import aiohttp
import psutil
import pytest

from edge.flightlog.recorder import Recorder
from edge.live.connections import STRANGER_S
from edge.live.feed import LiveFeed
from edge.live.options import LiveError, LiveOptions

pytestmark = pytest.mark.process

MALFORMED = 200
PICTURE = bytes.fromhex("ffd8ffc0001108") + (180).to_bytes(2, "big") + (320).to_bytes(2, "big") + bytes(20_000)


class View:
    """A feed with its process, and the stops that it has requested."""

    def __init__(self, folder: Path) -> None:
        self.stops: list[int] = []
        self.lines: list[str] = []
        self.feed = LiveFeed(LiveOptions(port=0), folder / "no-bridge.sock", self._stop, self.lines.append)
        self.base, self.token = self.feed.url.split("/?token=")

    def _stop(self) -> bool:
        self.stops.append(time.monotonic_ns())
        return True

    def put(self, number: int) -> None:
        self.feed.put("/camera", number + 1, PICTURE)
        self.feed.put("/tick", number + 1, {"tick": number})

    @property
    def process(self) -> psutil.Process:
        return next(each for each in psutil.Process().children() if "edge.live.server" in each.cmdline())

    def run(self, body: Callable[[aiohttp.ClientSession], Awaitable[Any]]) -> Any:
        async def all_() -> Any:
            async with aiohttp.ClientSession(timeout=aiohttp.ClientTimeout(total=30)) as session:
                return await body(session)

        return asyncio.run(all_())


@pytest.fixture
def view(tmp_path: Path) -> Iterator[View]:
    found = View(tmp_path)
    try:
        yield found
    finally:
        found.feed.close()


def test_without_the_token_there_is_no_data(view: View) -> None:
    async def ask(session: aiohttp.ClientSession) -> None:
        for path in ("/", "/view", "/foxglove", "/metrics", "/layout.json"):
            for given in ("", "?token=wrong", "?token="):
                response = await session.get(view.base + path + given)
                text = await response.text()
                assert response.status == 403 and "token" in text and len(text) < 100, path + given

    view.run(ask)


def test_without_the_token_in_its_header_there_is_no_stop(view: View) -> None:
    async def ask(session: aiohttp.ClientSession) -> list[int]:
        headers: list[dict[str, str]] = [{}, {"Authorization": "Bearer x"}, {"Authorization": f"Basic {view.token}"}]
        answers = [await session.post(f"{view.base}/stop", headers=each) for each in headers]
        answers.append(await session.post(f"{view.base}/stop?token={view.token}"))
        return [answer.status for answer in answers]

    assert view.run(ask) == [403] * 4
    view.feed.poll()
    assert view.stops == []


def test_another_page_is_refused_although_it_knows_the_token(view: View) -> None:
    async def ask(session: aiohttp.ClientSession) -> list[int]:
        addresses = [f"{view.base}{path}?token={view.token}" for path in ("/", "/view", "/metrics")]
        headers = {"Origin": "http://elsewhere.example"}
        return [(await session.get(address, headers=headers)).status for address in addresses]

    assert view.run(ask) == [403] * 3


def test_a_stop_reaches_the_runner_where_no_operators_stop_is_possible(view: View) -> None:
    async def ask(session: aiohttp.ClientSession) -> Any:
        headers = {"Authorization": f"Bearer {view.token}"}
        request = asyncio.create_task(session.post(f"{view.base}/stop", headers=headers))
        while not request.done():
            view.feed.poll()
            await asyncio.sleep(0.02)
        return await (await request).json()

    answer = view.run(ask)
    assert answer["stopped"] is True and answer["latched"] is False
    assert len(view.stops) == 1 and view.feed.stopped


@pytest.mark.slow
def test_a_stop_that_nobody_confirms_says_so(view: View) -> None:
    async def ask(session: aiohttp.ClientSession) -> Any:
        headers = {"Authorization": f"Bearer {view.token}"}
        return await (await session.post(f"{view.base}/stop", headers=headers)).json()

    answer = view.run(ask)
    assert answer["stopped"] is False and "remote" in answer["text"]


def test_a_page_receives_pictures_and_records(view: View) -> None:
    async def watch(session: aiohttp.ClientSession) -> set[str]:
        found: set[str] = set()
        async with session.ws_connect(f"{view.base}/view?token={view.token}") as channel:
            for number in range(200):
                view.put(number)
                message = await channel.receive(5)
                binary = message.type is aiohttp.WSMsgType.BINARY
                found.add("picture" if binary else json.loads(message.data)["topic"])
                if found == {"picture", "/tick"}:
                    break
        return found

    assert view.run(watch) == {"picture", "/tick"}


@pytest.mark.slow
def test_slow_and_silent_clients_cost_the_others_nothing(view: View) -> None:
    """Four of five clients read nothing; the fifth gets newer and newer ticks, and the memory stays."""
    host = urlsplit(view.base)
    upgrade = (
        f"GET /view?token={view.token} HTTP/1.1\r\nHost: {host.netloc}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n"
    )
    silent = [socket.create_connection((host.hostname, host.port)) for _ in range(4)]
    for each in silent:
        each.sendall(upgrade.encode())

    async def watch(session: aiohttp.ClientSession) -> list[int]:
        ticks: list[int] = []
        async with session.ws_connect(f"{view.base}/view?token={view.token}") as channel:
            for number in range(600):  # 12 MB of pictures for each client
                view.put(number)
                await asyncio.sleep(0.01)
                while True:
                    try:
                        message = await channel.receive(0.001)
                    except asyncio.TimeoutError:
                        break
                    if message.type is aiohttp.WSMsgType.TEXT:
                        ticks.append(json.loads(message.data)["record"]["tick"])
        return ticks

    before = view.process.memory_info().rss
    ticks = view.run(watch)
    grown = view.process.memory_info().rss - before
    for each in silent:
        each.close()
    assert len(ticks) > 20 and ticks == sorted(ticks) and ticks[-1] > 500
    assert grown < 24 * 2**20


def test_connections_without_the_token_do_not_keep_a_stop_away(capfd: pytest.CaptureFixture[str], view: View) -> None:
    """More silent connections than the view may open files, as any computer of the network can make."""
    host = urlsplit(view.base)
    headers = {"Authorization": f"Bearer {view.token}"}

    async def stop(session: aiohttp.ClientSession) -> bool:
        request = asyncio.create_task(session.post(f"{view.base}/stop", headers=headers))
        while not request.done():
            view.feed.poll()
            await asyncio.sleep(0.02)
        return bool((await (await request).json())["stopped"])

    silent = [socket.create_connection((host.hostname, host.port), 5) for _ in range(200)]
    try:
        assert view.run(stop) is True and len(view.stops) == 1
        ended_s = STRANGER_S + 5.0
        for each in silent:
            each.settimeout(ended_s)
            with suppress(ConnectionResetError):
                assert each.recv(1) == b""
    finally:
        for each in silent:
            each.close()
    assert capfd.readouterr().err == ""  # asyncio's own server wrote a traceback for each that it could not accept


def test_a_connection_that_has_shown_the_token_stays(view: View) -> None:
    async def watch(session: aiohttp.ClientSession) -> int:
        async with session.ws_connect(f"{view.base}/view?token={view.token}") as channel:
            await asyncio.sleep(STRANGER_S + 0.5)
            view.put(7)
            while (message := await channel.receive(10)).type is not aiohttp.WSMsgType.TEXT:
                pass
        return int(json.loads(message.data)["record"]["tick"])

    assert view.run(watch) == 7


@pytest.mark.slow
def test_records_for_a_frozen_view_are_dropped_and_nobody_waits(view: View) -> None:
    view.process.suspend()
    deadline = time.monotonic() + 20
    try:
        while view.feed.dropped == 0 and time.monotonic() < deadline:
            view.feed.put("/camera", 1, PICTURE + bytes(200_000))
            time.sleep(0.01)
        assert view.feed.dropped > 0
    finally:
        view.process.resume()


def test_a_view_that_ends_is_reported_once_and_the_run_goes_on(view: View) -> None:
    view.process.kill()
    deadline = time.monotonic() + 10
    number = 0
    while not view.lines and time.monotonic() < deadline:
        number += 1
        view.put(number)
        time.sleep(0.02)
    view.put(number)
    assert view.feed.poll() is None
    assert view.lines == ["the live view has ended; the robot drives on without it"]


@pytest.mark.slow
def test_foxglove_gets_the_frames_that_the_publishers_own_server_sends(view: View) -> None:
    """Advertisement and message of one topic, beside foxglove-sdk's server with the same schema and content."""
    foxglove = pytest.importorskip("foxglove")
    schema = {"title": "tic_vla.Battery", "type": "object"}
    theirs = foxglove.start_server(port=0, name="theirs")
    described = foxglove.Schema(name=schema["title"], encoding="jsonschema", data=json.dumps(schema).encode())
    channel = foxglove.Channel("/battery", schema=described, message_encoding="json")

    async def frames(address: str, put: Callable[[], None], session: aiohttp.ClientSession) -> dict[str, Any]:
        found: dict[str, Any] = {}
        async with session.ws_connect(address, protocols=["foxglove.sdk.v1"]) as peer:
            found["protocol"] = peer.protocol
            while "message" not in found:
                put()
                try:
                    message = await peer.receive(0.3)
                except asyncio.TimeoutError:  # put before the subscription was known
                    continue
                if message.type is aiohttp.WSMsgType.BINARY:
                    opcode, subscription = message.data[0], int.from_bytes(message.data[1:5], "little")
                    found["message"] = (opcode, subscription, message.data[13:])
                elif (content := json.loads(message.data))["op"] == "advertise":
                    for each in content["channels"]:
                        if each["topic"] == "/battery" and "channel" not in found:
                            found["channel"] = {k: each[k] for k in ("topic", "encoding", "schemaEncoding")}
                            wanted = [{"id": 7, "channelId": each["id"]}]
                            await peer.send_json({"op": "subscribe", "subscriptions": wanted})
                elif content["op"] == "serverInfo":
                    found["info"] = set(content) >= {"op", "name", "capabilities", "sessionId"}
        return found

    async def both(session: aiohttp.ClientSession) -> list[dict[str, Any]]:
        record = {"soc_percent": 80.0}
        return [
            await frames(f"ws://127.0.0.1:{theirs.port}", lambda: channel.log(json.dumps(record).encode()), session),
            await frames(
                f"{view.base}/foxglove?token={view.token}", lambda: view.feed.put("/battery", 5, record), session
            ),
        ]

    expected, found = view.run(both)
    theirs.stop()
    assert found == expected


@pytest.mark.slow
def test_malformed_frames_end_their_own_connection_only(view: View) -> None:
    async def flood(session: aiohttp.ClientSession) -> None:
        for number in range(MALFORMED):
            async with session.ws_connect(f"{view.base}/foxglove?token={view.token}") as channel:
                await channel.send_json({"op": "subscribe", "subscriptions": [{"id": -number - 1}]})
                while (message := await channel.receive(5)).type != aiohttp.WSMsgType.CLOSE:
                    assert message.type in (aiohttp.WSMsgType.TEXT, aiohttp.WSMsgType.BINARY)
                assert message.data == aiohttp.WSCloseCode.POLICY_VIOLATION

    async def garbage(_: aiohttp.ClientSession) -> None:
        host = urlsplit(view.base)
        for number in range(MALFORMED):
            with socket.create_connection((host.hostname, host.port), timeout=5) as raw:
                raw.sendall(bytes((number * 37 + k) % 256 for k in range(200)))

    async def healthy(session: aiohttp.ClientSession) -> int:
        return (await session.get(f"{view.base}/metrics?token={view.token}")).status

    async def both(session: aiohttp.ClientSession) -> int:
        await flood(session)
        await garbage(session)
        return await healthy(session)

    view.run(healthy)
    begin = view.process.memory_info().rss
    assert view.run(both) == 200
    assert view.process.memory_info().rss - begin < 24 * 2**20


def test_a_port_in_use_is_one_line(view: View, tmp_path: Path) -> None:
    line = r"^--live: cannot listen at 127\.0\.0\.1:\d+ \(Address already in use\); choose another port$"
    with pytest.raises(LiveError, match=line):
        LiveFeed(LiveOptions(port=view.feed.port), tmp_path / "b.sock", lambda: True, view.lines.append)


@pytest.mark.parametrize(
    ("address", "reason"),
    [
        ("192.0.2.1", "Cannot assign requested address"),
        ("no-such-computer.invalid", "Name or service not known|Temporary failure in name resolution"),
        ("a..b", "not the name of a computer"),
    ],
)
def test_an_address_of_another_computer_is_one_line(tmp_path: Path, address: str, reason: str) -> None:
    line = rf"^--live: cannot listen at {re.escape(address)}:0 \(({reason})\); choose another --live-address"
    with pytest.raises(LiveError, match=line):
        LiveFeed(LiveOptions(address, port=0), tmp_path / "b.sock", lambda: True, lambda _: None)


def test_a_name_of_this_computer_is_served_at_its_loopback(tmp_path: Path) -> None:
    feed = LiveFeed(LiveOptions("localhost", port=0), tmp_path / "b.sock", lambda: True, lambda _: None)
    try:
        socket.create_connection(("127.0.0.1", feed.port), 5).close()
    finally:
        feed.close()


def test_the_process_ends_with_the_runner(view: View) -> None:
    process = view.process
    view.feed.close()
    process.wait(5)
    assert not process.is_running()


def test_nothing_listens_on_another_address_than_the_loopback(view: View) -> None:
    listening = [each for each in view.process.net_connections() if each.status == psutil.CONN_LISTEN]
    assert [each.laddr.ip for each in listening] == ["127.0.0.1"]


def test_a_client_is_told_what_the_flight_log_has_lost(view: View, tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "missing" / "flight.mcap")
    recorder.put("/tick", 1, {"tick": 1})
    view.feed.recorder = recorder

    async def watch(session: aiohttp.ClientSession) -> Any:
        async with session.ws_connect(f"{view.base}/view?token={view.token}") as channel:
            return json.loads((await channel.receive(5)).data)

    message = view.run(watch)
    assert message["topic"] == "/recorder" and message["record"]["dropped"] == 1
    assert "No such file" in message["record"]["error"]
