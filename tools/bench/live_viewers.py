"""Viewers of a live view for `tools.bench.live_cost`: `python -m tools.bench.live_viewers URL "five viewers"`.

Pages and Foxglove read everything at once; one client reads nothing, one reads 1 kB/s. Ends at SIGINT.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import socket
import sys
from collections.abc import Callable, Coroutine, Mapping
from typing import Any, Final
from urllib.parse import SplitResult, urlsplit

import aiohttp

SLOW_BYTES_PER_S: Final = 1000
SILENT_S: Final = 15.0
"""Duration of a connection that reads nothing, s: longer than the view's heartbeat of 10 s."""
_STEP_S: Final = 0.1
_NICENESS: Final = 10
Viewer = Callable[[str, str], Coroutine[Any, Any, None]]


async def page(base: str, token: str) -> None:
    """Read as the web page does."""
    async with aiohttp.ClientSession() as session, session.ws_connect(f"{base}/view?token={token}") as channel:
        async for _ in channel:
            pass


async def foxglove(base: str, token: str) -> None:
    """Subscribe every channel and read."""
    address = f"{base}/foxglove?token={token}"
    async with aiohttp.ClientSession() as session, session.ws_connect(address, max_msg_size=0) as channel:
        async for message in channel:
            if message.type is aiohttp.WSMsgType.TEXT and '"advertise"' in message.data:
                channels = [each["id"] for each in json.loads(message.data)["channels"]]
                wanted = [{"id": each, "channelId": each} for each in channels]
                await channel.send_json({"op": "subscribe", "subscriptions": wanted})


async def silent(base: str, token: str) -> None:
    """Connect as a page and read nothing; connect again later, because the view ends such a connection."""
    with _connected(urlsplit(base), token):
        await asyncio.sleep(SILENT_S)


async def slow(base: str, token: str) -> None:
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


async def watch(url: str, viewers: str) -> None:
    """Watch for ever; a viewer that the view disconnects comes back."""
    base, token = url.split("/?token=")

    async def again(viewer: Viewer) -> None:
        while True:
            with contextlib.suppress(aiohttp.ClientError, OSError):
                await viewer(base, token)
            await asyncio.sleep(1.0)

    await asyncio.gather(*(again(viewer) for viewer in VIEWERS[viewers]))


def main(argv: list[str] | None = None) -> int:
    """Watch until SIGINT; returns 0."""
    url, viewers = sys.argv[1:] if argv is None else argv
    os.nice(_NICENESS)
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(watch(url, viewers))
    return 0


if __name__ == "__main__":
    sys.exit(main())
