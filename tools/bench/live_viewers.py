"""Viewers of a live view for `tools.bench.live_cost`: `python -m tools.bench.live_viewers URL "five viewers"`.

Pages and Foxglove read everything at once; one client reads nothing, one reads 1 kB/s. Ends at SIGINT. Prints how many
messages pages and Foxglove have received as a line of JSON every 5 s: `{"received": {VIEWER: NUMBER}, "failure": WHY}`.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import json
import os
import signal
import socket
import sys
from collections.abc import Callable, Coroutine, Mapping
from typing import Any, Final
from urllib.parse import SplitResult, urlsplit

import aiohttp

SLOW_BYTES_PER_S: Final = 1000
SILENT_S: Final = 15.0
"""Duration of a connection that reads nothing, s: longer than the view's heartbeat of 10 s."""
REPORT_S: Final = 5.0
"""Time between two lines of what was received, s."""
_STEP_S: Final = 0.1
_NICENESS: Final = 10
Count = Callable[[], None]
"""Called for every message that a page or Foxglove receives."""
Viewer = Callable[[str, str, Count], Coroutine[Any, Any, None]]


async def page(base: str, token: str, count: Count) -> None:
    """Read as the web page does."""
    async with aiohttp.ClientSession() as session, session.ws_connect(f"{base}/view?token={token}") as channel:
        async for _ in channel:
            count()


async def foxglove(base: str, token: str, count: Count) -> None:
    """Subscribe every channel and read."""
    address = f"{base}/foxglove?token={token}"
    async with aiohttp.ClientSession() as session, session.ws_connect(address, max_msg_size=0) as channel:
        async for message in channel:
            if message.type is aiohttp.WSMsgType.BINARY:
                count()
            elif message.type is aiohttp.WSMsgType.TEXT and '"advertise"' in message.data:
                channels = [each["id"] for each in json.loads(message.data)["channels"]]
                wanted = [{"id": each, "channelId": each} for each in channels]
                await channel.send_json({"op": "subscribe", "subscriptions": wanted})


async def silent(base: str, token: str, count: Count) -> None:
    """Connect as a page and read nothing; connect again later, because the view ends such a connection."""
    with _connected(urlsplit(base), token):
        await asyncio.sleep(SILENT_S)


async def slow(base: str, token: str, count: Count) -> None:
    """Connect as a page and read 1 kB/s."""
    loop = asyncio.get_running_loop()
    with _connected(urlsplit(base), token) as raw:
        while await loop.sock_recv(raw, round(SLOW_BYTES_PER_S * _STEP_S)):
            await asyncio.sleep(_STEP_S)


def _connected(host: SplitResult, token: str) -> socket.socket:
    raw = socket.socket()
    raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)  # so that what is not read waits at the view
    raw.connect((host.hostname, host.port))
    raw.sendall(
        f"GET /view?token={token} HTTP/1.1\r\nHost: {host.netloc}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
    )
    raw.setblocking(False)
    return raw


VIEWERS: Final[Mapping[str, tuple[Viewer, ...]]] = {
    "one viewer": (page,),
    "five viewers": (page, page, foxglove, silent, slow),
}


async def watch(url: str, viewers: str, report: Callable[[str], None] = print, period_s: float = REPORT_S) -> None:
    """Watch for ever; a viewer that the view disconnects comes back. `report` takes a line every `period_s`."""
    base, token = url.split("/?token=")
    named = {f"{viewer.__name__} {number}": viewer for number, viewer in enumerate(VIEWERS[viewers], 1)}
    received = {name: 0 for name, viewer in named.items() if viewer in (page, foxglove)}
    failure: str | None = None  # the newest, such as a refused connection

    async def again(name: str, viewer: Viewer) -> None:
        nonlocal failure

        def count() -> None:
            received[name] += 1

        while True:
            try:
                await viewer(base, token, count)
            except (aiohttp.ClientError, OSError) as error:
                failure = f"{name}: {error}"
            await asyncio.sleep(1.0)

    async def report_all() -> None:
        while True:
            await asyncio.sleep(period_s)
            report(json.dumps({"received": received, "failure": failure}))

    await asyncio.gather(report_all(), *(again(name, viewer) for name, viewer in named.items()))


def main(argv: list[str] | None = None) -> int:
    """Watch until SIGINT; returns 0."""
    url, viewers = sys.argv[1:] if argv is None else argv
    os.nice(_NICENESS)
    # A shell's background job, and what it starts, ignores SIGINT.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(watch(url, viewers, functools.partial(print, flush=True)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
