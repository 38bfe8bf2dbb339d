"""Headless Chromium, driven over its DevTools protocol: opens a page, runs scripts, takes screenshots."""

from __future__ import annotations

import asyncio
import base64
import itertools
import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Awaitable, Callable
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, TypeVar

import aiohttp

EXECUTABLE = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
START_S = 30.0
R = TypeVar("R")


class Size(NamedTuple):
    """Size of a screen, CSS px."""

    width: int
    height: int
    phone: bool = False


DESKTOP = Size(1400, 900)
PHONE = Size(390, 844, phone=True)


class Page:
    """One page of a browser."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.problems: list[str] = []
        """Errors and warnings of the console, exceptions of scripts, requests that failed."""
        self._socket = socket
        self._numbers = itertools.count(1)

    async def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of the protocol; notes the events that come before its answer."""
        number = next(self._numbers)
        await self._socket.send_json({"id": number, "method": method, "params": parameters})
        while True:
            message = json.loads((await self._socket.receive(20)).data)
            if message.get("id") == number:
                assert "error" not in message, message
                return dict(message["result"])
            self._note(message)

    async def open(self, address: str, size: Size) -> None:
        """Open an address on a screen of this size."""
        for domain in ("Page", "Runtime", "Log"):
            await self.call(f"{domain}.enable")
        scale = 2 if size.phone else 1
        metrics = {"width": size.width, "height": size.height, "deviceScaleFactor": scale, "mobile": size.phone}
        await self.call("Emulation.setDeviceMetricsOverride", **metrics)
        await self.call("Page.navigate", url=address)
        await self.until('location.protocol === "http:" && document.readyState === "complete"')

    async def value(self, script: str) -> Any:
        """Return the value of an expression."""
        found = await self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    async def until(self, script: str, timeout_s: float = 20.0) -> None:
        """Wait until an expression is true."""
        deadline = asyncio.get_running_loop().time() + timeout_s
        while not await self.value(script):
            assert asyncio.get_running_loop().time() < deadline, f"{script} did not become true; {self.problems}"
            await asyncio.sleep(0.1)

    async def screenshot(self, path: Path) -> None:
        """Write a PNG of the whole page."""
        found = await self.call("Page.captureScreenshot", format="png", captureBeyondViewport=True)
        path.write_bytes(base64.b64decode(found["data"]))

    def _note(self, message: dict[str, Any]) -> None:
        method, content = message.get("method"), message.get("params", {})
        if method == "Runtime.exceptionThrown":
            self.problems.append(str(content["exceptionDetails"]))
        elif method == "Runtime.consoleAPICalled" and content["type"] in ("error", "warning", "assert"):
            self.problems.append(str(content["args"]))
        elif method == "Log.entryAdded" and content["entry"]["level"] in ("error", "warning"):
            self.problems.append(f"{content['entry']['text']} {content['entry'].get('url', '')}")


class Chromium:
    """A browser with a profile of its own; a context manager."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder / "profile"
        assert EXECUTABLE is not None
        arguments = [
            "--headless=new",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-dev-shm-usage",
            "--no-first-run",
            "--hide-scrollbars",
        ]
        arguments += ["--remote-debugging-port=0", f"--user-data-dir={self._folder}", "about:blank"]
        # It leaves its lock there; the path is short, because the lock has a socket.
        self._temporary = tempfile.TemporaryDirectory(prefix="tic-", ignore_cleanup_errors=True)
        self._process = subprocess.Popen(
            [EXECUTABLE, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
            env={**os.environ, "TMPDIR": self._temporary.name},
        )  # fmt: skip

    def __enter__(self) -> Chromium:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.terminate()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._temporary.cleanup()

    def run(self, body: Callable[[Page], Awaitable[R]]) -> R:
        """Run `body` with the browser's page."""

        async def with_page() -> R:
            async with aiohttp.ClientSession() as session:
                address = await self._page_address(session)
                async with session.ws_connect(address, max_msg_size=0) as socket:
                    return await body(Page(socket))

        return asyncio.run(with_page())

    async def _page_address(self, session: aiohttp.ClientSession) -> str:
        deadline = asyncio.get_running_loop().time() + START_S
        port_file = self._folder / "DevToolsActivePort"
        while True:
            try:
                port = int(port_file.read_text().split()[0])
                async with session.get(f"http://127.0.0.1:{port}/json/list") as answer:
                    pages = [each for each in await answer.json() if each["type"] == "page"]
                return str(pages[0]["webSocketDebuggerUrl"])
            except (OSError, ValueError, IndexError, aiohttp.ClientError):
                assert asyncio.get_running_loop().time() < deadline, "Chromium did not start"
                await asyncio.sleep(0.1)
