"""A robot at the wire for one module of tests, and a fresh bridge process for one test."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.processes import GO2_SIM, Running, running
from tests.support.robot.fake_go2 import FakeGo2


@pytest.fixture(scope="module")
def robot(dds_domain: int) -> Iterator[FakeGo2]:
    robot = FakeGo2(dds_domain)
    yield robot
    robot.close()


@pytest.fixture
def socket_path(tmp_path: Path) -> Path:
    return tmp_path / "bridge.sock"


@pytest.fixture
def bridge(robot: FakeGo2, dds_domain: int, socket_path: Path, tmp_path: Path) -> Iterator[Running]:
    """A fresh bridge, and a robot that lies down and has received nothing."""
    arguments = ("--robot", GO2_SIM, "--domain", dds_domain, "--socket", socket_path, "--json", tmp_path / "r.json")
    robot.reset()  # before, so that nobody is at the remote; after, so that nothing was received
    with running("firmware_bridge.bridge", *arguments, folder=tmp_path) as started:
        robot.reset()
        yield started
