"""A bridge whose network interface appears late: it waits, answers operators, keeps a stop, then serves."""

from __future__ import annotations

import functools
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from firmware_bridge.absent_robot import AbsentRobot
from firmware_bridge.client import BridgeClient
from firmware_bridge.core.config import OPERATOR_SUFFIX, load_robot_config
from firmware_bridge.core.link import Arm, BridgeStatus, Stop
from firmware_bridge.core.rules import BridgeCore
from firmware_bridge.core.step_types import Inputs
from firmware_bridge.dds.interface import is_interface_up
from firmware_bridge.operate import operate
from firmware_bridge.unitree.table import robot_table
from tests.support.notify_socket import NotifySocket, notify_socket
from tests.support.processes import GO2_SIM, REPOSITORY, wait_for

CABLE = "cable0"
NAMESPACE = ("unshare", "--map-root-user", "--net")


@functools.cache
def can_make_a_network() -> bool:
    """Whether this user may make a network namespace with a pair of interfaces."""
    if not all(shutil.which(tool) for tool in ("unshare", "nsenter", "ip")):
        return False
    command = [*NAMESPACE, "ip", "link", "add", "a0", "type", "veth", "peer", "name", "b0"]
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


pytestmark = pytest.mark.process
needs_network_namespace = pytest.mark.skipif(not can_make_a_network(), reason="no network namespaces for this user")


@pytest.mark.parametrize(
    ("interface", "up"),
    [("lo", True), ("127.0.0.1", True), ("cable99", False), ("192.0.2.1", False), ("x" * 40, False)],
)
def test_an_interface_is_up_once_it_has_an_address(interface: str, up: bool) -> None:
    assert is_interface_up(interface) is up


def waiting_core() -> BridgeCore:
    config = load_robot_config(GO2_SIM)
    return BridgeCore(config.bridge, config.limits, config.safety, robot_table(config), 0)


def test_without_the_interface_no_runner_is_armed() -> None:
    core, robot = waiting_core(), AbsentRobot(CABLE)
    for now_ns in range(0, 2_000_000_000, 20_000_000):
        outputs = core.step(Inputs((Arm(),), True, robot.read(now_ns)), now_ns)
        assert (outputs.status.blocked_by, outputs.requests) == ("link_down", ())
        assert outputs.status.state != "armed"


def test_a_stop_before_the_interface_is_there_latches() -> None:
    core, robot = waiting_core(), AbsentRobot(CABLE)
    core.step(Inputs((), False, robot.read(0), operator=(Stop(),)), 0)
    assert core.step(Inputs((), False, robot.read(1)), 1).status.blocked_by == "estop"


class WaitingBridge:
    """An `edge-bridge` in a network namespace of its own, without its interface at first."""

    def __init__(self, process: subprocess.Popen[bytes], socket: Path, stderr: Path, manager: NotifySocket) -> None:
        self.process, self.socket, self._stderr, self._manager = process, socket, stderr, manager
        self.notified: list[dict[str, str]] = []

    def stderr(self) -> str:
        return self._stderr.read_text()

    def notifications(self) -> list[dict[str, str]]:
        self.notified += self._manager.messages()
        return self.notified

    def is_ready(self) -> bool:
        return any("READY" in message for message in self.notifications())

    def plug_in(self) -> None:
        """Create the interface, its far end and an address."""
        for line in (
            f"link add {CABLE} type veth peer name far0",
            f"addr add 192.168.123.99/24 dev {CABLE}",
            "link set far0 up",
            f"link set {CABLE} up",
        ):
            enter = ["nsenter", "--preserve-credentials", "--user", "--net", "--target", str(self.process.pid)]
            subprocess.run([*enter, "ip", *line.split()], check=True, timeout=10)

    def status(self) -> BridgeStatus:
        with closing(BridgeClient(f"{self.socket}{OPERATOR_SUFFIX}")) as client:
            status = client.poll()
        assert status is not None
        return status


@pytest.fixture
def bridge(tmp_path: Path, dds_domain: int) -> Iterator[WaitingBridge]:
    robot = tmp_path / "late.toml"
    text = GO2_SIM.read_text().replace('interface = "lo"', f'interface = "{CABLE}"')
    robot.write_text(text.replace('peers = ["127.0.0.1"]', "peers = []"))
    socket, stderr = tmp_path / "bridge.sock", tmp_path / "stderr"
    command = [*NAMESPACE, sys.executable, "-m", "firmware_bridge.bridge", "--robot", str(robot)]
    command += ["--socket", str(socket), "--domain", str(dds_domain)]
    with notify_socket(tmp_path / "notify") as manager:
        environment = {**os.environ, **manager.environment(watchdog_us=1_000_000)}
        with stderr.open("wb") as file:
            process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stderr=file, cwd=REPOSITORY, env=environment)
        waiting = WaitingBridge(process, socket, stderr, manager)
        try:
            wait_for(lambda: "waiting for interface" in waiting.stderr() or process.poll() is not None, 20, "waiting")
            assert process.poll() is None, waiting.stderr()
            yield waiting
        finally:
            process.kill()
            process.wait()


@needs_network_namespace
class TestProcess:
    def test_it_serves_once_the_interface_appears(self, bridge: WaitingBridge) -> None:
        time.sleep(1.0)
        assert bridge.process.poll() is None and not bridge.is_ready()
        assert (bridge.status().blocked_by, bridge.status().commands) == ("link_down", 0)
        assert f"waiting for interface '{CABLE}'" in bridge.status().reason
        bridge.plug_in()
        wait_for(bridge.is_ready, 10, "READY=1")
        wait_for(lambda: bridge.status().blocked_by == "state_silent", 5, "it listens to the robot's network")
        assert "waiting" not in bridge.status().reason.replace("waiting for a client", "")

    def test_the_service_manager_receives_the_reason_for_waiting_and_keep_alives(self, bridge: WaitingBridge) -> None:
        wait_for(lambda: sum("WATCHDOG" in message for message in bridge.notifications()) >= 3, 10, "watchdog pings")
        lines = [message.get("STATUS", "") for message in bridge.notifications()]
        assert any(f"waiting for interface '{CABLE}'" in line for line in lines)
        # The start timeout moves on, so that the service manager does not end a bridge that waits.
        assert any(int(message.get("EXTEND_TIMEOUT_USEC", 0)) >= 10_000_000 for message in bridge.notifications())

    def test_a_stop_given_while_it_waits_still_holds_when_it_serves(self, bridge: WaitingBridge) -> None:
        operate("stop", bridge.socket)
        assert bridge.status().blocked_by == "estop"
        bridge.plug_in()
        wait_for(bridge.is_ready, 10, "READY=1")
        time.sleep(0.2)
        assert bridge.status().blocked_by == "estop"

    def test_it_ends_at_once_on_a_signal_while_it_waits(self, bridge: WaitingBridge) -> None:
        bridge.process.terminate()
        assert bridge.process.wait(5) == 0
        assert not bridge.socket.exists()
