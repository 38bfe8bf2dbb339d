"""The real `edge-bridge` process between a client that fails and a robot that listens; times are the robot's."""

from __future__ import annotations

import ctypes
import json
import os
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from cyclonedds.internal import DDS
from cyclonedds.qos import Policy, Qos, _CQos

from firmware_bridge.bridge import main as bridge_main
from firmware_bridge.client import BridgeClient, BridgeUnavailable
from firmware_bridge.operate import operate
from firmware_bridge.unitree.messages import ids
from firmware_bridge.unitree.messages.idl import WirelessController_
from firmware_bridge.unitree.rpc import RpcClient, move_parameter
from tests.process.bridge.stop_rig import Peer
from tests.support.notify_socket import notify_socket
from tests.support.processes import GO2_SIM, REPOSITORY, HostStall, Running, check_stop_latency, running, wait_for
from tests.support.robot.fake_go2 import FakeGo2

pytestmark = pytest.mark.process

STOP_BOUND_NS = 300_000_000
ZERO = (0.0, 0.0, 0.0)


def check_lasting_zero(robot: FakeGo2, since_ns: int, bound_ns: int, host: HostStall, wait_s: float = 0.6) -> None:
    """Check that the robot received zero within the bound of `since_ns`, and nothing but zeros after it."""
    time.sleep(wait_s)
    moves = robot.moves()
    last_moving = max(i for i, command in enumerate(moves) if command.velocity != ZERO)
    assert last_moving + 1 < len(moves), "no zero velocity was ever received"
    check_stop_latency(moves[last_moving + 1].received_ns - since_ns, bound_ns, since_ns, host)


def wait_for_request(robot: FakeGo2, api_id: int) -> int:
    """When the robot received the first such request that it still remembers, ns."""
    wait_for(lambda: any(command.api_id == api_id for command in list(robot.received)), 10, f"request {api_id}")
    return next(command.received_ns for command in list(robot.received) if command.api_id == api_id)


Drive = Callable[[], AbstractContextManager[Running]]


def driver(socket_path: Path, folder: Path) -> AbstractContextManager[Running]:
    return running("tests.support.robot.bridge_driver", socket_path, 0.5, folder=folder)


@pytest.fixture
def drive(robot: FakeGo2, bridge: Running, socket_path: Path, tmp_path: Path) -> Drive:
    """Start a runner at the bridge and enter the block once the robot is driven."""

    @contextmanager
    def start() -> Iterator[Running]:
        with driver(socket_path, tmp_path) as runner:
            wait_for(robot.is_driven, 20, "the robot is driven")
            yield runner

    return start


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_dead_or_frozen_runner_leaves_zero_on_the_wire(robot: FakeGo2, drive: Drive, number: signal.Signals) -> None:
    with HostStall() as host, drive() as runner:
        time.sleep(0.25)
        since_ns = time.monotonic_ns()
        os.kill(runner.pid, number)
        check_lasting_zero(robot, since_ns, STOP_BOUND_NS, host)
        assert ids.STOP_MOVE in [command.api_id for command in robot.received if command.received_ns > since_ns]
        runner.process.kill()


@pytest.mark.slow
@pytest.mark.parametrize("frozen", ["runner", "bridge"])
def test_a_process_that_was_frozen_does_not_drive_on(
    robot: FakeGo2, bridge: Running, drive: Drive, frozen: str
) -> None:
    with drive() as runner:
        pid = runner.pid if frozen == "runner" else bridge.pid
        os.kill(pid, signal.SIGSTOP)
        time.sleep(0.6)
        robot.received.clear()
        os.kill(pid, signal.SIGCONT)
        time.sleep(0.5)
        assert robot.moves() and all(command.velocity == ZERO for command in robot.moves())


def test_ending_the_bridge_while_driving_leaves_zero_and_a_stop_move(
    robot: FakeGo2, bridge: Running, drive: Drive, socket_path: Path, tmp_path: Path
) -> None:
    with drive():
        robot.received.clear()
        assert bridge.end() == 0
    wait_for(lambda: robot.moves() and robot.moves()[-1].velocity == ZERO, 20, "zero as the last command")
    assert ids.STOP_MOVE in [command.api_id for command in robot.received]
    result = json.loads((tmp_path / "r.json").read_text())
    assert result["zero_after_stop"] and result["last_command"] == [0.0, 0.0, 0.0]
    assert not socket_path.exists()


def test_a_robot_that_falls_silent_is_stopped(robot: FakeGo2, bridge: Running, drive: Drive) -> None:
    with drive():
        robot.reporting = False
        try:
            wait_for(lambda: not robot.is_driven(), 20, "zero velocity")
        finally:
            robot.reporting = True
    assert "silent" in bridge.stderr()


def test_nothing_is_sent_before_arm(robot: FakeGo2, bridge: Running, socket_path: Path) -> None:
    client = BridgeClient(socket_path)
    for seq in range(5):
        client.send_velocity(seq + 1, time.monotonic_ns(), 0.5, 0.0, 0.0)
        time.sleep(0.05)
    client.stop()
    client.close()
    time.sleep(0.2)
    assert robot.received == []


@pytest.mark.slow
def test_a_second_client_is_turned_away_and_the_first_drives_on(
    robot: FakeGo2, drive: Drive, socket_path: Path
) -> None:
    with drive():
        with pytest.raises(BridgeUnavailable, match="another client"):
            BridgeClient(socket_path)
        time.sleep(0.3)
        assert robot.is_driven()


@pytest.mark.slow
def test_a_new_client_may_arm_again_after_the_first_has_died(robot: FakeGo2, drive: Drive) -> None:
    for _ in range(2):
        with drive() as runner:
            runner.process.kill()
        wait_for(lambda: not robot.is_driven(), 20, "zero velocity")


def test_the_socket_is_the_users_alone(bridge: Running, socket_path: Path) -> None:
    assert stat.S_IMODE(socket_path.stat().st_mode) == 0o600


@pytest.mark.slow
def test_a_second_bridge_on_the_socket_is_refused_and_a_file_is_left_alone(
    bridge: Running, dds_domain: int, socket_path: Path, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("precious")
    for path, code, message in ((socket_path, 3, "another bridge listens"), (tmp_path / "file", 2, "found a file")):
        command = [sys.executable, "-m", "firmware_bridge.bridge", "--robot", str(GO2_SIM), "--socket", str(path)]
        command += ["--domain", str(dds_domain)]
        done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=20, check=False)
        assert (done.returncode, message in done.stderr, done.stderr.count("\n")) == (code, True, 1)
    assert (tmp_path / "file").read_text() == "precious"


def test_a_socket_file_left_behind_is_replaced(
    robot: FakeGo2, bridge: Running, dds_domain: int, socket_path: Path, tmp_path: Path
) -> None:
    bridge.process.kill()
    bridge.process.wait()
    assert socket_path.exists()
    (tmp_path / "again").mkdir()
    arguments = ("--robot", GO2_SIM, "--domain", dds_domain, "--socket", socket_path)
    with running("firmware_bridge.bridge", *arguments, folder=tmp_path / "again"):
        BridgeClient(socket_path).close()


def test_a_second_commander_gets_the_robot_zeroed_and_the_bridge_latched(
    robot: FakeGo2, bridge: Running, drive: Drive
) -> None:
    rogue = RpcClient(robot.bus, ids.SPORT_SERVICE)
    with HostStall() as host, drive():
        wait_for(rogue.connected, 5, "the rogue to find the robot")
        since_ns = time.monotonic_ns()
        rogue.send(ids.MOVE, move_parameter(0.7, 0.0, 0.0), noreply=True)
        check_lasting_zero(robot, since_ns, 500_000_000, host)
    assert "another client commands the robot (sport 1008)" in bridge.stderr()


def test_a_publisher_whose_announcement_cannot_be_read_stops_the_robot(
    robot: FakeGo2, bridge: Running, drive: Drive, dds_domain: int, socket_path: Path
) -> None:
    """The binding decodes no name that is not UTF-8; the bridge once ended at every start while the writer lived."""
    peer = Peer(dds_domain)
    with HostStall() as host, drive():
        since_ns = time.monotonic_ns()
        qos = _CQos.qos_to_cqos(Qos(Policy.Reliability.BestEffort))
        DDS._dll_handle.dds_qset_entity_name(qos, ctypes.c_char_p(b"\xff"))
        topic = peer._topic("rt/unrelated", WirelessController_)
        DDS._dll_handle.dds_create_writer(peer.participant._ref, topic._ref, qos, None)
        check_lasting_zero(robot, since_ns, 500_000_000, host)
    peer.close()
    assert operate("status", socket_path)[1]["blocked_by"] == "second_publisher"


LEAVING = (signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP, signal.SIGXCPU)


@pytest.mark.slow
@pytest.mark.parametrize("number", LEAVING, ids=[number.name for number in LEAVING])
def test_a_signal_leaves_a_stopped_robot(
    robot: FakeGo2, bridge: Running, drive: Drive, socket_path: Path, number: signal.Signals
) -> None:
    """Among them a closed terminal, Ctrl-\\, Ctrl-Z, and too much computing without a pause."""
    with HostStall() as host, drive():
        since_ns = time.monotonic_ns()
        bridge.process.send_signal(number)
        check_lasting_zero(robot, since_ns, 60_000_000, host)
        assert bridge.process.wait(5) == 0 and not socket_path.exists()
    assert any(command.api_id == ids.STOP_MOVE for command in robot.received)


@pytest.mark.slow
def test_a_client_that_only_reads_is_no_commander(robot: FakeGo2, drive: Drive) -> None:
    with drive():
        RpcClient(robot.bus, ids.SPORT_SERVICE).call(ids.API_VERSION, timeout_s=5)
        time.sleep(0.3)
        assert robot.is_driven()


@pytest.mark.parametrize(
    ("remote", "said"),
    [
        ((0.0, 0.5, 0.0, 0.0, 0), "a person uses the robot's remote"),
        ((0.0, 0.0, 0.0, 0.0, 1 << 5 | 1 << 9), "emergency stop pressed on the remote"),
    ],
    ids=["stick", "L2 and B"],
)
def test_a_hand_on_the_remote_is_zero_within_60_ms(
    robot: FakeGo2, bridge: Running, drive: Drive, remote: tuple, said: str
) -> None:
    with HostStall() as host, drive():
        since_ns = time.monotonic_ns() + 20_000_000  # the fake robot reports every 20 ms
        robot.remote = remote
        check_lasting_zero(robot, since_ns, 60_000_000, host)
    assert said in bridge.stderr()


@pytest.mark.slow
def test_a_late_move_is_answered_within_40_ms_and_motion_after_a_stop_by_another_stop_move(
    robot: FakeGo2, bridge: Running, socket_path: Path
) -> None:
    """The late Move comes from another writer, because the network of this test cannot hold one back."""
    late = RpcClient(robot.bus, ids.SPORT_SERVICE)
    client = BridgeClient(socket_path)
    with HostStall() as host:
        client.arm()
        wait_for(lambda: client.poll().state == "armed", 20, "armed")
        client.stop()
        wait_for(lambda: client.poll().state == "stopped", 20, "stopped")
        late.send(ids.MOVE, move_parameter(0.5, 0.0, 0.0), noreply=True)
        # Not whether it is driven: the answer may be there before anybody looks.
        wait_for(lambda: any(command.velocity != ZERO for command in robot.moves()), 5, "the late Move")
        since_ns = next(command.received_ns for command in robot.moves() if command.velocity != ZERO)
        check_lasting_zero(robot, since_ns, 40_000_000, host)
    robot.received.clear()
    robot.truth, robot.mode = {"velocity_world_mps": np.array((0.3, 0.0, 0.0))}, ids.MODE_LOCOMOTION
    wait_for_request(robot, ids.STOP_MOVE)
    client.close()


@pytest.mark.slow
def test_a_stop_move_that_is_never_answered_holds_nothing_up(robot: FakeGo2, drive: Drive) -> None:
    robot.unanswered = {ids.STOP_MOVE}
    with HostStall() as host, drive() as runner:
        since_ns = time.monotonic_ns()
        runner.process.kill()
        check_lasting_zero(robot, since_ns, STOP_BOUND_NS, host)
        zeros = [
            command.received_ns
            for command in robot.moves()
            if command.velocity == ZERO and command.received_ns > since_ns
        ]
        for earlier_ns, later_ns in pairwise(zeros):
            check_stop_latency(later_ns - earlier_ns, 40_000_000, earlier_ns, host)


def test_a_killed_bridges_successor_stops_the_moving_robot_first(
    robot: FakeGo2, bridge: Running, drive: Drive, dds_domain: int, socket_path: Path, tmp_path: Path
) -> None:
    (tmp_path / "again").mkdir()
    with drive():
        robot.truth, robot.mode = {"velocity_world_mps": np.array((0.5, 0.0, 0.0))}, ids.MODE_LOCOMOTION
        bridge.process.kill()
        bridge.process.wait()
    robot.received.clear()
    arguments = ("--robot", GO2_SIM, "--domain", dds_domain, "--socket", socket_path)
    with running("firmware_bridge.bridge", *arguments, folder=tmp_path / "again") as successor:
        wait_for_request(robot, ids.STOP_MOVE)
        assert robot.received[0].velocity == ZERO
        wait_for(lambda: "the robot was moving" in successor.stderr(), 5, "the reason")


def test_another_robot_than_the_files_is_not_armed(robot: FakeGo2, bridge: Running, socket_path: Path) -> None:
    robot.version = "1.0.0.0"
    client = BridgeClient(socket_path)
    client.arm()
    wait_for(lambda: client.poll().cause == "wrong_robot", 10, "the refusal")
    assert {command.api_id for command in robot.received} == {ids.API_VERSION}
    client.close()


def test_an_operator_stops_a_driven_robot_and_only_an_operator_takes_it_back(
    robot: FakeGo2, bridge: Running, socket_path: Path, tmp_path: Path
) -> None:
    def status(command: str) -> dict[str, object]:
        code, values = operate(command, socket_path)
        assert code == 0
        return values

    with HostStall() as host, driver(socket_path, tmp_path):
        wait_for(robot.is_driven, 20, "the robot is driven")
        assert status("status")["state"] == "armed"
        since_ns = time.monotonic_ns()
        stopped = status("stop")
        check_lasting_zero(robot, since_ns, 100_000_000, host, wait_s=0.3)
    assert (stopped["state"], stopped["cause"]) == ("stopped", "estop")
    with driver(socket_path, tmp_path):
        wait_for(lambda: "arm refused" in bridge.stderr(), 10, "the refusal")
        assert not robot.is_driven()
        wait_for(lambda: operate("arm", socket_path)[0] == 0, 5, "the permission")
        wait_for(robot.is_driven, 20, "the robot is driven again")


@pytest.mark.slow
def test_where_the_robot_file_requires_it_an_operator_permits_every_single_arming(
    robot: FakeGo2, dds_domain: int, socket_path: Path, tmp_path: Path
) -> None:
    file = tmp_path / "robot.toml"
    file.write_text(GO2_SIM.read_text().replace("operator_arm = false", "operator_arm = true"))
    robot.reset()
    arguments = ("--robot", file, "--domain", dds_domain, "--socket", socket_path)
    with running("firmware_bridge.bridge", *arguments, folder=tmp_path):
        client = BridgeClient(socket_path)

        def has_status(state: str, cause: str) -> bool:
            status = client.poll()
            return status is not None and (status.state, status.cause) == (state, cause)

        client.arm()
        wait_for(lambda: has_status("disarmed", "operator"), 10, "the refusal")
        assert robot.received == []
        assert operate("arm", socket_path)[0] == 0
        client.arm()
        wait_for(lambda: has_status("armed", "none"), 20, "armed")
        client.stop()
        wait_for(lambda: has_status("stopped", "client_stop"), 10, "stopped")
        client.arm()
        wait_for(lambda: has_status("stopped", "operator"), 10, "the second refusal")
        client.close()


def test_the_status_of_a_running_bridge_is_json_on_request(
    bridge: Running, socket_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    command = ["status", "--robot", str(GO2_SIM), "--socket", str(socket_path), "--json", "-"]
    assert bridge_main(command) == 0
    assert json.loads(capfd.readouterr().out)["state"] == "disarmed"


def test_an_idle_operator_connection_is_not_in_the_way_of_a_stop(bridge: Running, socket_path: Path) -> None:
    idle = BridgeClient(f"{socket_path}.operator")
    assert operate("stop", socket_path)[0] == 0
    idle.close()


def test_systemd_receives_ready_the_state_the_watchdog_and_the_end(
    robot: FakeGo2, dds_domain: int, socket_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    arguments = ("--robot", GO2_SIM, "--domain", dds_domain, "--socket", socket_path)
    with notify_socket(tmp_path / "notify") as manager:
        for name, value in manager.environment(watchdog_us=100_000).items():
            monkeypatch.setenv(name, value)
        with running("firmware_bridge.bridge", *arguments, folder=tmp_path) as started:
            BridgeClient(socket_path).close()
            time.sleep(0.5)
            messages = manager.messages()  # or its queue, of ten, fills up and what comes then is lost
            assert started.end() == 0
        messages += manager.messages()
    assert messages[0]["READY"] == "1"
    assert 2 <= sum("WATCHDOG" in message for message in messages) <= 12
    assert "STOPPING" in messages[-1] or any("STOPPING" in message for message in messages[-3:])
    assert any(message.get("STATUS", "").startswith("disarmed: ") for message in messages)
