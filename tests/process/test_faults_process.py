"""A handful of `make faults`' injections into real processes; the sniffer on the robot's side is the judge.

The other rows, and enough samples to speak of a percentile, are `make faults`.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

import pytest

from edge.flightlog.recorder import space_refusal
from sim_hil.realtime.host_stall import HostStall
from sim_hil.realtime.robots import ROBOTS
from sim_hil.realtime.stack import socket_dir
from tools.faults.__main__ import run_row
from tools.faults.rig.processes import Rig
from tools.faults.rows import rows

pytestmark = pytest.mark.process

ROWS = {row.name: row for row in rows()}


@pytest.fixture(scope="module")
def host() -> Iterator[HostStall]:
    with HostStall() as watching:
        yield watching


@pytest.mark.slow
@pytest.mark.timeout(400)
@pytest.mark.parametrize(
    ("robot", "names"),
    [
        (
            "carter-can",
            ("bridge SIGKILL", "bus-off", "every frame corrupted", "second commander", "link dead both ways"),
        ),
        ("carter-mavlink", ("bridge SIGKILL", "link dead both ways")),
        ("carter-ros2", ("bridge SIGKILL", "second commander", "link dead both ways")),
    ],
)
def test_a_wheeled_base_is_stopped_within_the_rows_bound(
    robot: str, names: tuple[str, ...], nano_dir: Path, host: HostStall
) -> None:
    of = {row.name: row for row in rows(ROBOTS[robot])}
    with (
        socket_dir() as folder,
        Rig(folder, nano_dir, None, print, record=False, stack_robot=ROBOTS[robot]) as rig,
    ):
        rig.start()
        for name in names:
            result = run_row(rig, of[name], 1, random.Random(name), host)
            assert not result.problems, (name, result.as_json())


@pytest.fixture(scope="module")
def rig(nano_dir: Path, dds_domain: int, host: HostStall) -> Iterator[Rig]:
    with socket_dir() as folder:
        # None of these rows is about the recording: they need no disk that has room for one.
        record = space_refusal(folder / "flight.mcap") is None
        with Rig(folder, nano_dir, dds_domain, print, record=record) as rig:
            rig.start()
            yield rig


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        # In this order: those that leave the run alive share one runner.
        "camera stops",
        "clock in a frozen picture",
        "plan is NaN",
        "robot's state silent",
        "remote: L2+B",
        "runner SIGSTOP, SIGCONT",
        "bridge SIGKILL",
    ],
)
def test_the_robot_is_stopped_within_the_rows_bound(name: str, rig: Rig, host: HostStall) -> None:
    result = run_row(rig, ROWS[name], 1, random.Random(name), host)
    assert not result.problems, result.as_json()


@pytest.fixture(scope="module")
def rover(nano_dir: Path, host: HostStall) -> Iterator[Rig]:
    with (
        socket_dir() as folder,
        Rig(folder, nano_dir, None, print, record=False, stack_robot=ROBOTS["carter-mavlink"]) as rig,
    ):
        rig.start()
        yield rig


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "unsigned packets",
        "packets with another key",
        "recorded packets again",
        "packets of another system",
        "pilot's mode switch",
        "second commander",
    ],
)
def test_a_rover_on_a_signed_link_keeps_the_rows_bound(name: str, rover: Rig, host: HostStall) -> None:
    (row,) = [row for row in rows(rover.stack_robot) if row.name == name]
    result = run_row(rover, row, 1, random.Random(name), host)
    assert not result.problems, result.as_json()
