"""Viewers of a live view: what they have received is known, and a refusal is not taken for silence."""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import subprocess
import sys
from typing import Any

from aiohttp import web
from aiohttp.test_utils import TestServer

from tools.bench.live_viewers import watch


def first_line(*, admits: bool) -> dict[str, Any]:
    """Return the first line about a page at a view that admits it or not."""

    async def view(request: web.Request) -> web.StreamResponse:
        if not admits:
            raise web.HTTPForbidden
        channel = web.WebSocketResponse()
        await channel.prepare(request)
        for _ in range(50):
            await channel.send_str("{}")
        async for _ in channel:  # until the page closes
            pass
        return channel

    async def run() -> str:
        app = web.Application()
        app.add_routes([web.get("/view", view)])
        lines: asyncio.Queue[str] = asyncio.Queue()
        async with TestServer(app) as server:
            url = f"http://127.0.0.1:{server.port}/?token=t"
            watching = asyncio.create_task(watch(url, "one viewer", lines.put_nowait, 0.5))
            try:
                return await asyncio.wait_for(lines.get(), 20)
            finally:
                watching.cancel()
                with contextlib.suppress(asyncio.CancelledError):
                    await watching

    found: dict[str, Any] = json.loads(asyncio.run(run()))
    return found


def test_the_messages_of_every_viewer_are_counted() -> None:
    found = first_line(admits=True)
    assert found == {"received": {"page 1": 50}, "failure": None}


def test_a_refused_viewer_has_received_nothing_and_says_why() -> None:
    found = first_line(admits=False)
    assert found["received"] == {"page 1": 0}
    assert found["failure"].startswith("page 1: 403")


def test_sigint_ends_the_viewers_of_a_benchmark_in_the_background() -> None:
    command = [sys.executable, "-m", "tools.bench.live_viewers", "http://127.0.0.1:9/?token=t", "one viewer"]
    # What a shell starts in the background ignores SIGINT.
    viewers = subprocess.Popen(["sh", "-c", 'trap "" INT; exec "$@"', "sh", *command], stdout=subprocess.PIPE)
    try:
        assert viewers.stdout is not None and viewers.stdout.readline(), "its first line"
        viewers.send_signal(signal.SIGINT)
        assert viewers.wait(10) == 0
    finally:
        viewers.kill()
        viewers.communicate()
