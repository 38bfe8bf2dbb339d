"""`edge-hil --live`: the simulated robot's camera, true pose, velocities and faults, and nothing that stops it."""

from __future__ import annotations

import asyncio
import json
import os
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import aiohttp
import pytest

from sim_hil.protocols.fault_socket import FaultClient
from tests.support.chromium import DESKTOP, EXECUTABLE, Chromium, Page
from tests.support.processes import hil_arguments, running

pytestmark = [pytest.mark.process, pytest.mark.slow]


@pytest.fixture(scope="module", params=["unitree", "mavlink", "ros2"])
def hil(request: pytest.FixtureRequest, dds_domain: int) -> Iterator[tuple[str, Path]]:
    """The address of a view, and the fault socket, of a robot of each kind of camera process."""
    carter = ("--robot", "carter", "--scene", "corridor", "--protocol", request.param)
    arguments = {
        "unitree": hil_arguments(dds_domain),
        "mavlink": (*carter, "--link", "udp:127.0.0.1:14691,camera=0"),
        "ros2": (*carter, "--domain", dds_domain),
    }[request.param]
    # Short, because sockets lie in it.
    with tempfile.TemporaryDirectory(prefix="hil") as name:
        folder = Path(name)
        more = ("--people", 3, "--faults", folder / "faults", "--live", 0)
        with running("sim_hil.hil.command", *arguments, *more, folder=folder) as process:
            found = re.search(r"live view: (http\S+)", process.stderr())
            assert found is not None, process.stderr()
            yield found[1], folder / "faults"


async def _until(address: str, wanted: set[str]) -> dict[str, Any]:
    """Return the newest message of every topic once those of `wanted` have come."""
    base, token = address.split("/?token=")
    found: dict[str, Any] = {}
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(f"{base}/view?token={token}") as channel,
    ):
        while not wanted <= found.keys():
            message = await channel.receive(20)
            if message.type is aiohttp.WSMsgType.BINARY:
                found["picture"] = message.data[8:]
            else:
                content = json.loads(message.data)
                found[content["topic"]] = content["record"]
    return found


def test_it_shows_camera_pose_and_velocities(hil: tuple[str, Path]) -> None:
    found = asyncio.run(_until(hil[0], {"picture", "/truth", "/velocity", "/run"}))
    assert found["picture"].startswith(b"\xff\xd8")
    assert len(found["/truth"]["pose"]) == 3 and found["/truth"]["touching"] == []
    assert found["/velocity"]["commanded_vx_mps"] == 0.0 and abs(found["/velocity"]["measured_vx_mps"]) < 0.5


def test_an_injected_fault_is_in_the_list(hil: tuple[str, Path]) -> None:
    address, faults = hil
    name = "camera-stop" if "unitree" in os.environ.get("PYTEST_CURRENT_TEST", "") else "silent"

    async def watch() -> dict[str, Any]:
        waiting = asyncio.create_task(_until(address, {"/fault"}))
        with FaultClient(faults, faults.parent / "asked") as client:
            client.ask(name)
            return await waiting

    record = asyncio.run(watch())["/fault"]
    assert (record["name"], record["change"]) == (f"injected {name}", "raised")


def test_there_is_no_data_without_the_token_and_no_stop_with_it(hil: tuple[str, Path]) -> None:
    base, token = hil[0].split("/?token=")

    async def ask() -> tuple[int, int, str]:
        async with aiohttp.ClientSession() as session:
            bare = await session.get(f"{base}/view")
            stop = await session.post(f"{base}/stop", headers={"Authorization": f"Bearer {token}"})
            return bare.status, stop.status, await stop.text()

    bare, stop, text = asyncio.run(ask())
    assert (bare, stop) == (403, 409) and "edge-bridge stop" in text


@pytest.mark.skipif(EXECUTABLE is None, reason="no Chromium on this machine")
def test_the_page_draws_it_without_an_error(hil: tuple[str, Path], tmp_path: Path) -> None:
    async def watch(page: Page) -> tuple[str, list[str]]:
        await page.open(hil[0], DESKTOP)
        await page.until('document.getElementById("tiles").textContent.includes("true speed")')
        await page.until("state.picture !== null && state.path.length > 10")
        await page.screenshot(Path(os.environ.get("LIVE_SCREENSHOTS", tmp_path)) / "live-hil.png")
        return str(await page.value('document.getElementById("robot").textContent')), page.problems

    with Chromium(tmp_path) as browser:
        name, problems = browser.run(watch)
    assert problems == [] and name.startswith("simulated ")


def test_a_port_in_use_is_one_line(hil: tuple[str, Path], capfd: pytest.CaptureFixture[str]) -> None:
    from sim_hil.hil.command import main

    port = re.search(r":(\d+)/", hil[0])
    assert port is not None
    arguments = ["--robot", "go2", "--scene", "corridor", "--protocol", "unitree", "--live", port[1]]
    assert main(arguments) == 2
    lines = [line for line in capfd.readouterr().err.splitlines() if line.startswith("edge-hil")]
    assert len(lines) == 1
    assert re.fullmatch(r"edge-hil: --live: cannot listen at \S+ \(Address already in use\); .*", lines[0])
