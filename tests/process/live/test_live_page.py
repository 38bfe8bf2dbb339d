"""The live view's page in headless Chromium, at the sizes of a desktop and a phone; skipped without Chromium."""

from __future__ import annotations

import asyncio
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from edge.live.feed import LiveFeed
from edge.live.options import LiveOptions
from tests.support.chromium import DESKTOP, EXECUTABLE, PHONE, Chromium, Page, Size

pytestmark = [
    pytest.mark.process,
    pytest.mark.slow,
    pytest.mark.skipif(EXECUTABLE is None, reason="no Chromium on this machine"),
]

MOUNT = {"hfov_deg": 100.0, "height_m": 0.4, "pitch_deg": 2.0, "forward_m": 0.3}
PATH_PX = 40
"""Pixels of the map's dark colours that a drawn robot and path have at least."""
COUNT = """((id, wanted) => {
  const seen = document.getElementById(id), copy = document.createElement("canvas");
  [copy.width, copy.height] = [seen.width, seen.height];
  const g = copy.getContext("2d", { willReadFrequently: true });
  g.drawImage(seen, 0, 0);
  const d = g.getImageData(0, 0, copy.width, copy.height).data;
  let n = 0;
  for (let i = 0; i < d.length; i += 4) if (d[i + 3] > 0 && wanted(d[i], d[i + 1], d[i + 2])) n++;
  return n;
})"""
"""Number of a canvas's drawn pixels of a colour."""
COLOURED = "(r, g, b) => r !== g || g !== b"
ORANGE = "(r, g, b) => r > 200 && g > 110 && g < 170 && b < 60"


class Drive:
    """A run's records, put 20 times a second until it is closed."""

    def __init__(self, folder: Path, port: int = 0, stops: bool = True) -> None:
        options = LiveOptions(port=port, token_file=folder / "token")
        self.stopped: list[bool] = []
        bridge = folder / "no-bridge.sock" if stops else None
        self.feed = LiveFeed(options, bridge, lambda: self.stopped.append(True) or True, lambda line: None)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def close(self) -> None:
        if self._thread.is_alive():
            self._ended.set()
            self._thread.join()
            self.feed.close()

    def _run(self) -> None:
        picture = cv2.imencode(".jpg", np.full((180, 320, 3), (60, 140, 90), np.uint8))[1].tobytes()
        begin = time.monotonic_ns()
        self.feed.put("/run", begin, {"robot": "go2", "instruction": "walk to the lift", "mount": MOUNT})
        number = 0
        while not self._ended.wait(0.05):
            now, x = time.monotonic_ns(), 0.02 * number
            pose = (x, float(np.sin(x)), 0.5 * float(np.cos(x)))
            self.feed.put("/camera", now, picture)
            self.feed.put("/tick", now, self._tick(number, now, pose))
            if number % 20 == 3:
                text = "Scene: a corridor.\nPlan: go on to the lift."
                semantic = {"text": text, "waypoints": [[3.0, 0.4], [6.0, 1.2]], "anchor_pose": pose, "new_tokens": 9}
                self.feed.put("/semantic", now, {**semantic, "started_ns": begin, "finished_ns": now})
            if number == 3:
                fault = {"name": "camera-stale", "action": "LIMIT", "change": "raised", "detail": "0.4 s"}
                self.feed.put("/fault", now, fault)
            self.feed.poll()
            number += 1

    @staticmethod
    def _tick(number: int, now: int, pose: tuple[float, float, float]) -> dict[str, object]:
        return {
            "tick": number, "now_ns": now, "late_ms": 0.4, "duration_ms": 12.0, "delay_s": 0.5 + number % 20 / 10,
            "frame_age_ms": 50.0, "pose": pose, "trajectory": [(0.8, 0.1, 0.1), (1.6, 0.3, 0.2), (2.4, 0.5, 0.2)],
            "command": (0.6, 0.0, 0.1), "state": (0.55, 0.0, 0.1), "active": ["camera-stale"], "reason": "",
            "supervisor": "DEGRADED", "offset": (0.5, 0.0, 0.1), "offset_sd": (0.25, 0.15, 0.01),
        }  # fmt: skip


@pytest.fixture
def drive(tmp_path: Path) -> Iterator[Drive]:
    found = Drive(tmp_path)
    yield found
    found.close()


@pytest.fixture
def chromium(tmp_path: Path) -> Iterator[Chromium]:
    with Chromium(tmp_path) as browser:
        yield browser


async def drawn(page: Page) -> None:
    await page.until('document.getElementById("link").textContent === "live"')
    await page.until(f'{COUNT}("picture", {COLOURED}) > 50000')
    await page.until(f'{COUNT}("picture", {ORANGE}) > 50')
    await page.until(f'{COUNT}("map", {COLOURED}) > {PATH_PX}')
    await page.until(f'{COUNT}("plots", {COLOURED}) > 200')


@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_picture_map_text_and_advice_are_drawn_without_an_error(
    drive: Drive, chromium: Chromium, tmp_path: Path, size: Size
) -> None:
    async def watch(page: Page) -> tuple[str, str, list[int], list[str]]:
        await page.open(drive.feed.url, size)
        await drawn(page)
        await page.until('document.getElementById("faults").textContent.includes("camera-stale")')
        await asyncio.sleep(2)
        text = await page.value('document.getElementById("text").textContent')
        faults = await page.value('document.getElementById("faults").textContent')
        box = "(() => { const r = document.getElementById('stop').getBoundingClientRect();"
        box += " return [r.left, r.right, r.top, r.bottom, document.documentElement.scrollWidth].map(Math.round); })()"
        where = await page.value(box)
        folder = Path(os.environ.get("LIVE_SCREENSHOTS", tmp_path))
        await page.screenshot(folder / f"live-{'phone' if size.phone else 'desktop'}.png")
        return text, faults, where, page.problems

    text, faults, (left, right, top, bottom, scroll_width), problems = chromium.run(watch)
    assert problems == []
    assert "go on to the lift" in text and "camera-stale raised" in faults and "newest" not in text
    assert left >= 0 and right <= size.width and top >= 0 and bottom <= size.height, "STOP is on the screen"
    assert right - left >= 200 and bottom - top >= 48 and scroll_width <= size.width


def test_an_open_page_finds_the_next_run_at_the_same_port_with_the_same_token(
    drive: Drive, chromium: Chromium, tmp_path: Path
) -> None:
    async def watch(page: Page) -> str:
        await page.open(drive.feed.url, DESKTOP)
        await drawn(page)
        drive.close()
        await page.until('document.getElementById("link").textContent.includes("connection lost")')
        again = await asyncio.to_thread(Drive, tmp_path, drive.feed.port)
        try:
            await page.until('document.getElementById("link").textContent === "live"')
            await drawn(page)
            return again.feed.url
        finally:
            await asyncio.to_thread(again.close)

    assert chromium.run(watch) == drive.feed.url


def test_the_stop_button_stops_and_says_by_which_way(drive: Drive, chromium: Chromium) -> None:
    async def press(page: Page) -> str:
        await page.open(drive.feed.url, PHONE)
        await drawn(page)
        await page.value('document.getElementById("stop").click()')
        await page.until('document.getElementById("answer").textContent.startsWith("stopped")')
        return str(await page.value('document.getElementById("answer").textContent'))

    assert "by the runner" in chromium.run(press)
    assert drive.stopped == [True]


def test_a_view_that_stops_nothing_has_no_stop_button(chromium: Chromium, tmp_path: Path) -> None:
    simulated = Drive(tmp_path, stops=False)

    async def look(page: Page) -> bool:
        await page.open(simulated.feed.url, DESKTOP)
        await drawn(page)
        return bool(await page.value('document.getElementById("stop").offsetParent !== null'))

    try:
        assert chromium.run(look) is False
    finally:
        simulated.close()
