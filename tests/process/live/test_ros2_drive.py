"""`edge-run` with `ros2.publish = true`: a node of the robot's domain sees the drive, and its end costs nothing."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from edge.live.ros2_messages import KINDS
from firmware_bridge.core.config import DdsConfig
from firmware_bridge.dds.bus import Bus, take_each
from tests.support.processes import GO2_SIM, REPOSITORY, hil_arguments, running, wait_for

pytestmark = [pytest.mark.process, pytest.mark.slow]


@pytest.fixture
def arguments(tmp_path: Path, dds_domain: int, nano_dir: Path) -> Iterator[list[str]]:
    """Arguments of an edge-run whose robot file publishes, with its robot and bridge running."""
    file, socket = tmp_path / "robot.toml", tmp_path / "b.sock"
    file.write_text(f'{GO2_SIM.read_text()}\n[ros2]\npublish = true\npublish_namespace = "/watch"\n')
    where = ("--robot", str(file), "--socket", str(socket), "--domain", str(dds_domain))
    with (
        running("sim_hil.hil.command", *hil_arguments(dds_domain), folder=tmp_path),
        running("firmware_bridge.bridge", *where, folder=tmp_path),
    ):
        yield ["--artifacts", str(nano_dir), "--instruction", "walk down the corridor", *where]


def start(arguments: list[str]) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "edge.run.command", *arguments, "--duration", "12", "--json", "-"]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=REPOSITORY)


def result_of(runner: subprocess.Popen[str]) -> tuple[dict[str, Any], str]:
    out, error = runner.communicate(timeout=90)
    assert runner.returncode == 0, error
    return json.loads(out), error


def test_a_node_of_the_domain_receives_every_topic_while_the_robot_drives(
    arguments: list[str], dds_domain: int
) -> None:
    runner = start(arguments)
    bus = Bus(DdsConfig(dds_domain, "lo", ("127.0.0.1",)))
    try:
        readers = {topic: bus.reader(f"rt/watch/{topic}", kind, depth=8) for topic, kind in KINDS.items()}
        newest: dict[str, Any] = {}

        def all_came() -> bool:
            for topic, reader in readers.items():
                for sample in take_each(reader):
                    newest[topic] = sample
            assert runner.poll() is None, "the run has ended before"
            return newest.keys() == readers.keys()

        wait_for(all_came, 60, f"messages of {', '.join(KINDS)}")
    finally:
        result, error = result_of(runner)
        bus.close()
    assert "edge-run: ROS 2: publishing in /watch, domain" in error
    assert result["faults"] == []
    assert newest["camera/image/compressed"].format == "jpeg" and newest["camera/camera_info"].width > 0
    assert newest["diagnostics"].status[0].hardware_id == "go2"


def test_the_robot_drives_on_when_the_publishing_process_is_killed(arguments: list[str], tmp_path: Path) -> None:
    result = tmp_path / "result.json"
    more = ("--duration", 12, "--json", result)
    with running("edge.run.command", *arguments, *more, folder=tmp_path, ready="driving") as runner:
        children = psutil.Process(runner.pid).children()
        (publisher,) = [each for each in children if "edge.live.ros2_publisher" in each.cmdline()]
        publisher.kill()
        assert runner.process.wait(60) == 0, runner.stderr()
        assert "ROS 2 publishing has ended; the robot drives on without it" in runner.stderr()
    found = json.loads(result.read_text())
    assert found["faults"] == [] and found["control"]["ticks"] >= 100
