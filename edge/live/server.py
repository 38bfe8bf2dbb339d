"""The process of the live view: a web page, Foxglove's protocol and metrics, for clients that know the run's token.

`edge-run --live` starts it; it ends soon after the runner, once it has answered the stops under way. Every client has a
queue of its own in which newer messages replace older ones, so a slow client costs itself pictures and nobody else
anything.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import hmac
import json
import os
import resource
import secrets
import select
import signal
import socket
import sys
import threading
from collections import deque
from collections.abc import AsyncIterator, Sequence
from importlib.resources import files
from typing import Final

from aiohttp import WSCloseCode, WSMsgType, web

from edge.core.heap import freeze_garbage, keep_large_blocks_apart
from edge.flightlog.part import encode
from edge.flightlog.schemas import ANY_OBJECT, SCHEMAS
from edge.flightlog.standard_messages import StandardMessages
from edge.flightlog.standard_schemas import COMPRESSED_IMAGE, STANDARD_SCHEMAS, Schema
from edge.live import wire
from edge.live.connections import AddressError, Strangers, accept, listen
from edge.live.foxglove import MOST_REQUEST_BYTES, SUBPROTOCOLS, Channels, ProtocolError, Subscriptions, server_info
from edge.live.metrics import CONTENT_TYPE, Metrics
from edge.live.stop import RobotStop
from edge.live.view import LiveState, Message

FOXGLOVE_ORIGINS: Final = ("https://app.foxglove.dev", "file://")
"""Origins of Foxglove in a browser and as a program, whose page is a file; the token is needed too."""
MOST_CLIENTS: Final = 16
END_S: Final = 6
"""Time by which this process outlives its runner at most, s: 4 s for stops, 1.5 s for what clients have not read."""
EACH_COUNTS: Final = frozenset({*wire.EVENTS, "/log", "/scene"})
"""Topics of which a client gets every message, up to _MOST_WAITING; of all others only the newest."""

_SCHEMA_OF: Final = {**STANDARD_SCHEMAS, **SCHEMAS}
_LAST_MESSAGES_S: Final = 0.5
"""Time to send what waits when the runner has ended, s; the connections have as much again to end."""
_MOST_WAITING: Final = 64
_MOST_FILES: Final = 128
"""Most open files, and so connections: a flood fills them, not the memory; strangers have half of them at most."""
_NICENESS: Final = 10
_HEARTBEAT_S: Final = 10.0
_PAGE_HEADERS: Final = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}


class Client:
    """One connected client and what waits to be sent to it."""

    def __init__(self, socket_: web.WebSocketResponse) -> None:
        self.socket = socket_
        self.subscriptions = Subscriptions()
        self._newest: dict[str, str | bytes] = {}
        self._each: deque[str | bytes] = deque(maxlen=_MOST_WAITING)
        self._ready = asyncio.Event()

    def offer(self, topic: str, data: str | bytes) -> None:
        """Queue a message; it replaces an older one of its topic."""
        if topic in EACH_COUNTS:
            self._each.append(data)
        else:
            self._newest[topic] = data
        self._ready.set()

    async def finish(self) -> None:
        """Wait until everything is sent, then close the connection."""
        while self._ready.is_set():
            await asyncio.sleep(0.01)
        await self.socket.close(code=WSCloseCode.GOING_AWAY)

    async def send_all(self) -> None:
        """Send what waits, for ever."""
        while True:
            await self._ready.wait()
            while self._each or self._newest:
                data = self._each.popleft() if self._each else self._newest.pop(next(iter(self._newest)))
                if isinstance(data, bytes):
                    await self.socket.send_bytes(data)
                else:
                    await self.socket.send_str(data)
            self._ready.clear()  # after the last message is sent: `finish` waits for it


class LiveServer:
    """Serves one run. `runner`: the socket to it."""

    def __init__(self, config: wire.ViewConfig, runner: socket.socket) -> None:
        self._config = config
        self._stop = None if config.bridge is None else RobotStop(config.bridge, runner)
        self._state, self._metrics, self._standard = LiveState(), Metrics(), StandardMessages()
        self._channels = Channels()
        # The newest of every Foxglove channel; of a scene the newest of every entity, whose few names are our own.
        self._latest: dict[tuple[str, str], tuple[int, bytes]] = {}
        self._pages: set[Client] = set()
        self._viewers: set[Client] = set()
        self._session = secrets.token_hex(4)
        self._run_ns: int | None = None
        """Stamp of the `/run` record: the page finds in it which run an answer to STOP belongs to."""
        self._malformed = 0
        self._dropped = 0  # by the runner
        self.strangers = Strangers()
        """Connections that have not shown the token."""

    def app(self) -> web.Application:
        """Return the web application."""
        app = web.Application(client_max_size=1024)
        app.add_routes(
            [
                web.get("/", self._root),
                web.get("/view", self._view),
                web.get("/foxglove", self._foxglove),
                web.get("/layout.json", self._layout),
                web.get("/metrics", self._show_metrics),
                web.post("/stop", self._stop_robot),
            ]
        )
        return app

    # From the runner

    def take(self, data: bytes) -> None:
        """Pass one datagram of the runner on to the clients; one that cannot be read is counted."""
        try:
            datagram = wire.decode(data)
            topic, stamp_ns = datagram.topic, datagram.stamp_ns
            if datagram.kind == wire.PICTURE:
                self._show(self._state.picture(topic, stamp_ns, datagram.payload))
                self._offer_standard(topic, stamp_ns, datagram.payload)
                if self._viewers:  # a picture in JSON is large
                    self._offer(topic, stamp_ns, encode(datagram.payload, stamp_ns), COMPRESSED_IMAGE)
            elif datagram.kind == wire.RECORD:
                record = json.loads(datagram.payload)
                self._run_ns = stamp_ns if topic == "/run" else self._run_ns
                self._metrics.take(topic, record)
                self._show(self._state.record(topic, stamp_ns, record))
                self._offer(topic, stamp_ns, datagram.payload, _SCHEMA_OF.get(topic, ANY_OBJECT))
                self._offer_standard(topic, stamp_ns, record)
            elif datagram.kind == wire.STOPPED and self._stop is not None:
                self._stop.answered(json.loads(datagram.payload).get("confirmed") is True)
            elif datagram.kind == wire.DROPPED:
                self._dropped = int(datagram.payload)
        except (ValueError, TypeError, KeyError, AttributeError):
            self._malformed += 1

    async def finish(self) -> None:
        """Answer the stops under way and send what waits, each within its limit; the runner has ended."""
        if self._stop is not None:
            await self._stop.finish()
        ending = [asyncio.create_task(client.finish()) for client in (*self._pages, *self._viewers)]
        if ending:
            await asyncio.wait(ending, timeout=_LAST_MESSAGES_S)

    def _show(self, messages: Sequence[Message]) -> None:
        for message in messages:
            for client in self._pages:
                client.offer(message.topic, _page_data(message))

    def _offer_standard(self, topic: str, stamp_ns: int, record: object) -> None:
        assert isinstance(record, (dict, bytes))
        for message in self._standard.of(topic, stamp_ns, record):
            data = encode(message.payload, message.stamp_ns)
            entity = "".join(each["id"] for each in message.payload.get("entities", ()))
            self._offer(message.topic, message.stamp_ns, data, STANDARD_SCHEMAS[message.topic], entity)

    def _offer(self, topic: str, stamp_ns: int, data: bytes, schema: Schema, entity: str = "") -> None:
        channel = self._channels.id_of(topic)
        if channel is None:
            advertisement = self._channels.add(topic, schema)
            channel = self._channels.id_of(topic)
            for client in self._viewers:
                client.offer(f"advertise {topic}", advertisement)
        assert channel is not None
        self._latest[topic, entity] = (stamp_ns, data)
        for client in self._viewers:
            frame = client.subscriptions.frame(channel, stamp_ns, data)
            if frame is not None:
                client.offer(topic, frame)

    # From clients

    def _check(self, request: web.Request, *origins: str) -> None:
        """Refuse a request without the token, or of another page. Raises HTTPForbidden."""
        kind, _, given = request.headers.get("Authorization", "").partition(" ")
        if kind != "Bearer":
            given = request.query.get("token", "")
        if not hmac.compare_digest(given.encode(errors="replace"), self._config.token.encode()):
            raise web.HTTPForbidden(text="the token is missing or wrong: use the address that the command printed\n")
        if request.protocol is not None:
            self.strangers.admit(request.protocol)
        origin = request.headers.get("Origin")
        own = f"{request.scheme}://{request.host}"
        if origin is not None and origin not in (own, *origins):
            raise web.HTTPForbidden(text=f"expected the origin {own}, found another\n")

    async def _root(self, request: web.Request) -> web.StreamResponse:
        if request.headers.get("Upgrade", "").lower() == "websocket":
            return await self._foxglove(request)
        self._check(request)
        nonce = secrets.token_urlsafe(12)
        page = files("edge.live").joinpath("page.html").read_text(encoding="utf-8").replace("@NONCE@", nonce)
        page = page.replace("@STOP@", "hidden" if self._config.bridge is None else "")
        policy = (
            f"default-src 'none'; script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'; img-src blob: data:; "
            "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )
        headers = {**_PAGE_HEADERS, "Content-Security-Policy": policy}
        return web.Response(text=page, content_type="text/html", headers=headers)

    async def _layout(self, request: web.Request) -> web.Response:
        self._check(request)
        layout = files("edge.live").joinpath("foxglove_layout.json").read_text(encoding="utf-8")
        headers = {"Content-Disposition": 'attachment; filename="tic-vla-edge.json"', **_PAGE_HEADERS}
        return web.Response(text=layout, content_type="application/json", headers=headers)

    async def _show_metrics(self, request: web.Request) -> web.Response:
        self._check(request)
        return web.Response(
            body=self._metrics.text(self._malformed + self._dropped), headers={"Content-Type": CONTENT_TYPE}
        )

    async def _view(self, request: web.Request) -> web.WebSocketResponse:
        self._check(request)
        channel = web.WebSocketResponse(heartbeat=_HEARTBEAT_S, max_msg_size=1024, compress=False)
        client = Client(channel)
        async with self._connected(request, client, self._pages):
            for message in self._state.snapshot():  # now, so that no message between it and the next one is lost
                client.offer(message.topic, _page_data(message))
            async for received in channel:
                if received.type in (WSMsgType.TEXT, WSMsgType.BINARY):
                    await channel.close(code=WSCloseCode.POLICY_VIOLATION)  # the page sends nothing
        return channel

    async def _foxglove(self, request: web.Request) -> web.WebSocketResponse:
        self._check(request, *FOXGLOVE_ORIGINS)
        channel = web.WebSocketResponse(
            protocols=SUBPROTOCOLS, heartbeat=_HEARTBEAT_S, max_msg_size=MOST_REQUEST_BYTES, compress=False
        )
        client = Client(channel)
        client.offer("/log", server_info("tic-vla-edge", self._session))
        client.offer("/log", self._channels.advertisement())
        async with self._connected(request, client, self._viewers):
            async for message in channel:
                try:
                    if message.type is not WSMsgType.TEXT:
                        raise ProtocolError("a viewer sends text")
                    self._send_latest(client, client.subscriptions.take(message.data))
                except ProtocolError as error:
                    await channel.close(code=WSCloseCode.POLICY_VIOLATION, message=str(error).encode())
        return channel

    def _send_latest(self, client: Client, channels: Sequence[int]) -> None:
        """A new subscriber gets the newest message of each channel, also of those that come once."""
        for (topic, _), (stamp_ns, data) in self._latest.items():
            channel = self._channels.id_of(topic)
            frame = None if channel is None else client.subscriptions.frame(channel, stamp_ns, data)
            if channel in channels and frame is not None:
                client.offer(topic, frame)

    @contextlib.asynccontextmanager
    async def _connected(self, request: web.Request, client: Client, group: set[Client]) -> AsyncIterator[None]:
        if len(self._pages) + len(self._viewers) >= MOST_CLIENTS:
            raise web.HTTPServiceUnavailable(text=f"expected at most {MOST_CLIENTS} clients; close one\n")
        await client.socket.prepare(request)
        group.add(client)
        sending = asyncio.create_task(client.send_all())
        try:
            yield
        finally:
            group.discard(client)
            sending.cancel()
            with contextlib.suppress(asyncio.CancelledError, ConnectionError, RuntimeError):
                await sending

    async def _stop_robot(self, request: web.Request) -> web.Response:
        self._check(request)
        if not request.headers.get("Authorization"):
            raise web.HTTPForbidden(text="a stop needs the token in the header Authorization\n")
        if self._stop is None:
            raise web.HTTPConflict(text="this view stops nothing: use the runner's view, or edge-bridge stop\n")
        return web.json_response({**await self._stop.stop(), "run": self._run_ns})


def _page_data(message: Message) -> str | bytes:
    """A picture goes to the page as its stamp and the JPEG, everything else as text."""
    if isinstance(message.data, bytes):
        return message.stamp_ns.to_bytes(8, "little") + message.data
    return message.data


async def serve(runner: socket.socket) -> None:
    """Listen as the runner configures, until the runner's end closes the socket; then finish what is under way."""
    loop = asyncio.get_running_loop()
    runner.setblocking(False)
    config = wire.ViewConfig.parse(wire.decode(await loop.sock_recv(runner, wire.MOST_BYTES)).payload)
    server = LiveServer(config, runner)
    serving = web.AppRunner(server.app(), access_log=None, keepalive_timeout=15.0, shutdown_timeout=_LAST_MESSAGES_S)
    await serving.setup()
    try:
        listening = await listen(config.address, config.port)
    except AddressError as error:
        runner.send(wire.Datagram(wire.REFUSED, f"--live: {error}".encode()).encode())
        await serving.cleanup()
        return
    assert serving.server is not None
    accepting = [asyncio.create_task(accept(each, serving.server, server.strangers)) for each in listening]
    freeze_garbage()
    port = listening[0].getsockname()[1]
    runner.send(wire.Datagram(wire.LISTENING, str(port).encode()).encode())
    while data := await _received(runner):
        server.take(data)
    for task in accepting:
        task.cancel()
    await asyncio.wait(accepting)
    for each in listening:  # now: the next run may listen at this port
        each.close()
    await server.finish()
    await serving.cleanup()


async def _received(runner: socket.socket) -> bytes:
    """Return the next datagram; empty after the runner's end."""
    while True:
        try:
            return await asyncio.get_running_loop().sock_recv(runner, wire.MOST_BYTES)
        except ConnectionResetError:
            continue  # comes once, from a runner that has ended with a request unread: what it sent is still there


def _limit_life(runner: socket.socket) -> None:
    """End this process END_S after the runner, whatever hangs in it."""
    ended = select.poll()
    ended.register(runner, 0)  # for POLLHUP, which needs no asking
    ended.poll()
    signal.alarm(END_S)


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point of the process that a runner starts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fd", type=int, required=True, help="the socket to the runner")
    args = parser.parse_args(argv)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the runner, whose end ends this process
    os.nice(_NICENESS)
    keep_large_blocks_apart()
    resource.setrlimit(resource.RLIMIT_NOFILE, (_MOST_FILES, _MOST_FILES))
    with contextlib.suppress(OSError), socket.socket(fileno=args.fd) as runner:
        threading.Thread(target=_limit_life, args=(runner,), name="end", daemon=True).start()
        asyncio.run(serve(runner))
    return 0


if __name__ == "__main__":
    sys.exit(main())
