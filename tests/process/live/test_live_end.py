"""The end of a run that is watched, and a view that takes nothing: what is still answered, sent and counted."""

from __future__ import annotations

import asyncio
import json
import select
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import aiohttp
import pytest

from edge.live.feed import LiveFeed
from edge.live.options import LiveOptions
from edge.live.wire import MOST_BYTES
from firmware_bridge.client_link import ClientLink
from firmware_bridge.core.config import OPERATOR_SUFFIX
from firmware_bridge.core.link import BridgeStatus, Stop
from tests.process.live.test_live_server import PICTURE, View
from tests.support.processes import wait_for

pytestmark = pytest.mark.process

STANDS_S = 1.5
"""Time after which the robot of `Bridge` stands, s: longer than a runner waits for its view."""


class Bridge:
    """A bridge's operator socket: latches the first stop, and reports standstill STANDS_S later."""

    def __init__(self, path: Path) -> None:
        self.stopped_s: float | None = None
        self._link = ClientLink(Path(f"{path}{OPERATOR_SUFFIX}"), places=4)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._closing.set()
        self._thread.join()
        self._link.close()

    def _serve(self) -> None:
        while not self._closing.wait(0.005):
            if Stop() in self._link.receive() and self.stopped_s is None:
                self.stopped_s = time.monotonic()
            stands = self.stopped_s is not None and time.monotonic() - self.stopped_s > STANDS_S
            cause = "none" if self.stopped_s is None else "estop"
            motion, speed_mps = ("still", 0.0) if stands else ("moving", 0.5)
            zero = (0.0, 0.0, 0.0)
            self._link.send_status(
                BridgeStatus(
                    time.monotonic_ns(), "stopped", "as commanded", 0, 0, 0, zero, True, cause, cause,
                    motion=motion, speed_mps=speed_mps,
                )
            )  # fmt: skip


@pytest.fixture
def view(tmp_path: Path) -> Iterator[View]:
    found = View(tmp_path)
    try:
        yield found
    finally:
        found.feed.close()


def press(session: aiohttp.ClientSession, base: str, token: str) -> asyncio.Task[aiohttp.ClientResponse]:
    return asyncio.create_task(session.post(f"{base}/stop", headers={"Authorization": f"Bearer {token}"}))


async def requested(view: View) -> None:
    """Wait until the runner could read a request to stop."""
    while not select.select([view.feed.picture_fd], [], [], 0)[0]:
        await asyncio.sleep(0.01)


def fill(view: View) -> None:
    """Put pictures until the view, which is suspended, takes no more."""
    before, deadline_s = view.feed.dropped, time.monotonic() + 20
    while view.feed.dropped == before and time.monotonic() < deadline_s:
        view.feed.put("/camera", 1, PICTURE + bytes(150_000))
        time.sleep(0.01)
    assert view.feed.dropped > before


def test_a_stop_by_the_runner_is_answered_although_its_run_ends_at_once(view: View) -> None:
    async def ask(session: aiohttp.ClientSession) -> Any:
        request = press(session, view.base, view.token)
        while not view.stops:
            view.feed.poll()
            await asyncio.sleep(0.01)
        await asyncio.to_thread(view.feed.close)
        return await (await request).json()

    answer = view.run(ask)
    assert answer["stopped"] and not answer["latched"]


def test_an_operators_stop_is_answered_although_its_run_ends_before_the_robot_stands(tmp_path: Path) -> None:
    bridge = Bridge(tmp_path / "bridge.sock")
    feed = LiveFeed(LiveOptions(port=0), tmp_path / "bridge.sock", lambda: False, print)
    base, token = feed.url.split("/?token=")

    async def ask() -> tuple[Any, float]:
        async with aiohttp.ClientSession() as session:
            request = press(session, base, token)
            while bridge.stopped_s is None:
                await asyncio.sleep(0.01)
            await asyncio.sleep(0.2)  # the runner finds its bridge stopped and ends
            began_s = time.monotonic()
            await asyncio.to_thread(feed.close)
            took_s = time.monotonic() - began_s
            return await (await request).json(), took_s

    try:
        answer, took_s = asyncio.run(ask())
    finally:
        feed.close()
        bridge.close()
    assert answer["stopped"] and answer["latched"]
    assert took_s < STANDS_S, "the runner does not wait for the answer"


def test_a_request_that_the_run_no_longer_reads_is_answered(view: View) -> None:
    async def ask(session: aiohttp.ClientSession) -> Any:
        request = press(session, view.base, view.token)
        await requested(view)
        await asyncio.to_thread(view.feed.close)
        return await (await request).json()

    answer = view.run(ask)
    assert not answer["stopped"] and "remote" in answer["text"]


def test_a_page_gets_the_result_of_the_run(view: View) -> None:
    async def watch(session: aiohttp.ClientSession) -> list[str]:
        async with session.ws_connect(f"{view.base}/view?token={view.token}") as channel:
            view.feed.put("/tick", 1, {"tick": 1})
            topics = [json.loads((await channel.receive(5)).data)["topic"]]
            view.feed.put("/result", 2, {"faults": []})
            await asyncio.to_thread(view.feed.close)
            async for message in channel:
                topics.append(json.loads(message.data)["topic"])
        return topics

    assert view.run(watch) == ["/tick", "/result"]


@pytest.mark.slow
def test_the_next_run_may_listen_at_once_although_a_stop_is_still_under_way(tmp_path: Path) -> None:
    bridge = Bridge(tmp_path / "bridge.sock")
    feed = LiveFeed(LiveOptions(port=0), tmp_path / "bridge.sock", lambda: False, print)
    base, token = feed.url.split("/?token=")

    async def ask() -> Any:
        async with aiohttp.ClientSession() as session:
            request = press(session, base, token)
            while bridge.stopped_s is None:
                await asyncio.sleep(0.01)
            await asyncio.to_thread(feed.close)
            after = await asyncio.to_thread(LiveFeed, LiveOptions(port=feed.port), None, lambda: False, print)
            await asyncio.to_thread(after.close)
            return await (await request).json()

    try:
        assert asyncio.run(ask())["stopped"]
    finally:
        feed.close()
        bridge.close()


@pytest.mark.slow
def test_a_view_that_hangs_is_killed_and_nobody_waits_for_it(view: View) -> None:
    process = view.process
    process.suspend()
    began_s = time.monotonic()
    view.feed.close()
    assert time.monotonic() - began_s < 3.0
    process.wait(15)


@pytest.mark.slow
def test_no_event_is_lost_while_the_view_takes_nothing(view: View) -> None:
    process = view.process
    process.suspend()
    try:
        fill(view)
        for number in range(20):
            view.feed.put("/fault", 2 + number, {"name": f"fault {number}", "change": "raised", "action": "LIMIT"})
        time.sleep(0.3)
    finally:
        process.resume()

    async def watch(session: aiohttp.ClientSession) -> list[str]:
        found: list[str] = []
        async with session.ws_connect(f"{view.base}/view?token={view.token}") as channel:
            while len(found) < 20:
                message = await channel.receive(5)
                if message.type is aiohttp.WSMsgType.TEXT and json.loads(message.data)["topic"] == "/fault":
                    found.append(json.loads(message.data)["record"]["name"])
        return found

    assert view.run(watch) == [f"fault {number}" for number in range(20)]


@pytest.mark.slow
def test_the_answer_to_a_stop_waits_until_the_view_takes_it(view: View) -> None:
    process = view.process

    async def ask(session: aiohttp.ClientSession) -> Any:
        request = press(session, view.base, view.token)
        await requested(view)
        process.suspend()
        try:
            await asyncio.to_thread(fill, view)
            view.feed.poll()
        finally:
            process.resume()
        return await (await request).json()

    assert view.run(ask)["stopped"]


def test_a_picture_that_is_too_large_is_reported_once_and_counted_in_the_metrics(view: View) -> None:
    for number in (1, 2):
        view.feed.put("/camera", number, bytes(MOST_BYTES))
        wait_for(lambda number=number: view.feed.dropped == number, 5, "the drop")  # type: ignore[misc]
    (line,) = view.lines
    assert line.startswith("the live view lacks records that are too large: expected at most ")
    assert "in /camera; lower the size of the camera's JPEG" in line

    async def read(session: aiohttp.ClientSession) -> str:
        deadline_s = time.monotonic() + 5
        while True:
            text = await (await session.get(f"{view.base}/metrics?token={view.token}")).text()
            if "dropped_records 2.0" in text or time.monotonic() > deadline_s:
                return text
            await asyncio.sleep(0.1)

    assert "tic_vla_view_dropped_records 2.0" in view.run(read).splitlines()
