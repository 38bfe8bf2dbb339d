"""The real `edge-bridge` process between a client that fails and a robot that listens; times are the robot's."""

from __future__ import annotations

import ast
import functools
import io
import json
import math
import os
import signal
import socket
import stat
import struct
import subprocess
import sys
import time
import tokenize
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from random import Random
from types import SimpleNamespace

import numpy as np
import pytest

from firmware_bridge.bridge import Bridge, is_pressed
from firmware_bridge.bridge import main as bridge_main
from firmware_bridge.client import BridgeClient, BridgeUnavailable
from firmware_bridge.core.config import load_robot_config
from firmware_bridge.core.link import MAX_DATAGRAM_BYTES, VERSION, Arm, BridgeStatus, Velocity, decode, encode
from firmware_bridge.operate import operate
from firmware_bridge.unitree.messages import ids
from firmware_bridge.unitree.rpc import RpcClient, move_parameter
from tests.support.notify_socket import notify_socket
from tests.support.processes import GO2_SIM, REPOSITORY, HostStall, Running, check_stop_latency, running, wait_for
from tests.support.robot.fake_go2 import FakeGo2

pytestmark = pytest.mark.process

STOP_BOUND_NS = 300_000_000
ZERO = (0.0, 0.0, 0.0)


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
    """A fresh bridge, and a robot that lies down and has heard nothing."""
    arguments = ("--robot", GO2_SIM, "--domain", dds_domain, "--socket", socket_path, "--json", tmp_path / "r.json")
    robot.reset()  # before, so that nobody is at the remote; after, so that nothing was heard
    with running("firmware_bridge.bridge", *arguments, folder=tmp_path) as started:
        robot.reset()
        yield started


def lasting_zero_ns(robot: FakeGo2, since_ns: int, bound_ns: int, host: HostStall, wait_s: float = 0.6) -> int:
    """Check that the robot heard zero within the bound of `since_ns` and nothing but zeros after it; how soon, ns."""
    latency_ns = latency_to_zero_ns(robot, since_ns, wait_s)
    check_stop_latency(latency_ns, bound_ns, since_ns, host)
    return latency_ns


def wait_for_heard(robot: FakeGo2, api_id: int) -> int:
    """When the robot heard the first such request that it still remembers, ns."""
    wait_for(lambda: any(heard.api_id == api_id for heard in list(robot.heard)), 10, f"request {api_id}")
    return next(heard.received_ns for heard in list(robot.heard) if heard.api_id == api_id)


def driver(socket_path: Path, folder: Path):
    return running("tests.support.robot.bridge_driver", socket_path, 0.5, folder=folder)


def latency_to_zero_ns(robot: FakeGo2, since_ns: int, wait_s: float = 0.6) -> int:
    """From `since_ns` until the robot heard its first zero velocity with nothing but zeros after it."""
    time.sleep(wait_s)
    moves = robot.moves()
    last_moving = max(i for i, heard in enumerate(moves) if heard.velocity != ZERO)
    assert last_moving + 1 < len(moves), "no zero velocity was ever heard"
    return moves[last_moving + 1].received_ns - since_ns


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_a_dead_or_frozen_runner_leaves_zero_on_the_wire(
    robot: FakeGo2, bridge: Running, socket_path: Path, tmp_path: Path, number: signal.Signals
) -> None:
    with HostStall() as host, driver(socket_path, tmp_path) as runner:
        wait_for(robot.is_driven, 20, "the robot is driven")
        time.sleep(0.25)
        since_ns = time.monotonic_ns()
        os.kill(runner.pid, number)
        latency_ns = latency_to_zero_ns(robot, since_ns)
        check_stop_latency(latency_ns, STOP_BOUND_NS, since_ns, host)
        assert ids.STOP_MOVE in [heard.api_id for heard in robot.heard if heard.received_ns > since_ns]
        runner.process.kill()


@pytest.mark.slow
def test_a_frozen_runner_that_thaws_does_not_drive_again(
    robot: FakeGo2, bridge: Running, socket_path: Path, tmp_path: Path
) -> None:
    with driver(socket_path, tmp_path) as runner:
        wait_for(robot.is_driven, 20, "the robot is driven")
        os.kill(runner.pid, signal.SIGSTOP)
        time.sleep(0.5)
        robot.heard.clear()
        os.kill(runner.pid, signal.SIGCONT)
        time.sleep(0.5)
        assert robot.moves() and all(heard.velocity == ZERO for heard in robot.moves())


def test_ending_the_bridge_while_driving_leaves_zero_and_a_stop_move(
    robot: FakeGo2, bridge: Running, socket_path: Path, tmp_path: Path
) -> None:
    with driver(socket_path, tmp_path):
        wait_for(robot.is_driven, 20, "the robot is driven")
        robot.heard.clear()
        assert bridge.end() == 0
    wait_for(lambda: robot.moves() and robot.moves()[-1].velocity == ZERO, 20, "zero as the last command")
    assert ids.STOP_MOVE in [heard.api_id for heard in robot.heard]
    result = json.loads((tmp_path / "r.json").read_text())
    assert result["zero_after_stop"] and result["last_command"] == [0.0, 0.0, 0.0]
    assert not socket_path.exists()


def test_a_robot_that_falls_silent_is_stopped(
    robot: FakeGo2, bridge: Running, socket_path: Path, tmp_path: Path
) -> None:
    with driver(socket_path, tmp_path):
        wait_for(robot.is_driven, 20, "the robot is driven")
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
    assert robot.heard == []


@pytest.mark.slow
def test_a_second_client_is_turned_away_and_the_first_drives_on(
    robot: FakeGo2, bridge: Running, socket_path: Path, tmp_path: Path
) -> None:
    with driver(socket_path, tmp_path):
        wait_for(robot.is_driven, 20, "the robot is driven")
        with pytest.raises(BridgeUnavailable, match="another client"):
            BridgeClient(socket_path)
        time.sleep(0.3)
        assert robot.is_driven()


@pytest.mark.slow
def test_a_new_client_may_arm_again_after_the_first_has_died(
    robot: FakeGo2, bridge: Running, socket_path: Path, tmp_path: Path
) -> None:
    for _ in range(2):
        with driver(socket_path, tmp_path) as runner:
            wait_for(robot.is_driven, 20, "the robot is driven")
            runner.process.kill()
        wait_for(lambda: not robot.is_driven(), 20, "zero velocity")


def test_garbage_on_the_socket_is_ignored(robot: FakeGo2, bridge: Running, socket_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as client:
        client.connect(str(socket_path))
        for data in (b"\0", b"TVEB" + b"\xff" * 600, b"x" * 511, encode(Arm())):
            client.send(data)
        wait_for(lambda: decode(client.recv(MAX_DATAGRAM_BYTES)).state == "armed", 20, "armed")


def test_the_socket_is_the_users_alone(bridge: Running, socket_path: Path) -> None:
    assert stat.S_IMODE(socket_path.stat().st_mode) == 0o600


@pytest.mark.slow
def test_a_second_bridge_on_the_socket_is_refused(bridge: Running, dds_domain: int, socket_path: Path) -> None:
    command = [sys.executable, "-m", "firmware_bridge.bridge", "--robot", str(GO2_SIM), "--socket", str(socket_path)]
    command += ["--domain", str(dds_domain)]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=20, check=False)
    assert done.returncode == 3
    assert "another bridge listens" in done.stderr and done.stderr.count("\n") == 1


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


def test_a_file_that_is_no_socket_is_left_alone(dds_domain: int, socket_path: Path) -> None:
    socket_path.write_text("precious")
    command = [sys.executable, "-m", "firmware_bridge.bridge", "--robot", str(GO2_SIM), "--socket", str(socket_path)]
    command += ["--domain", str(dds_domain)]
    done = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=20, check=False)
    assert done.returncode == 2 and "found a file" in done.stderr
    assert socket_path.read_text() == "precious"


def test_without_a_bridge_the_client_says_what_to_do(socket_path: Path) -> None:
    with pytest.raises(BridgeUnavailable, match="start `edge-bridge"):
        BridgeClient(socket_path)


def test_a_second_commander_gets_the_robot_zeroed_and_the_bridge_latched(
    robot: FakeGo2, bridge: Running, socket_path: Path, tmp_path: Path
) -> None:
    rogue = RpcClient(robot.bus, ids.SPORT_SERVICE)
    with HostStall() as host, driver(socket_path, tmp_path):
        wait_for(robot.is_driven, 20, "the robot is driven")
        wait_for(rogue.connected, 5, "the rogue to find the robot")
        since_ns = time.monotonic_ns()
        rogue.send(ids.MOVE, move_parameter(0.7, 0.0, 0.0), noreply=True)
        lasting_zero_ns(robot, since_ns, 500_000_000, host)
    assert "another client commands the robot (sport 1008)" in bridge.stderr()


@pytest.mark.slow
def test_somebody_who_only_asks_is_no_commander(
    robot: FakeGo2, bridge: Running, socket_path: Path, tmp_path: Path
) -> None:
    with driver(socket_path, tmp_path):
        wait_for(robot.is_driven, 20, "the robot is driven")
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
    robot: FakeGo2, bridge: Running, socket_path: Path, tmp_path: Path, remote: tuple, said: str
) -> None:
    with HostStall() as host, driver(socket_path, tmp_path):
        wait_for(robot.is_driven, 20, "the robot is driven")
        since_ns = time.monotonic_ns() + 20_000_000  # the fake robot reports every 20 ms
        robot.remote = remote
        lasting_zero_ns(robot, since_ns, 60_000_000, host)
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
        wait_for(lambda: any(heard.velocity != ZERO for heard in robot.moves()), 5, "the late Move")
        since_ns = next(heard.received_ns for heard in robot.moves() if heard.velocity != ZERO)
        lasting_zero_ns(robot, since_ns, 40_000_000, host)
    robot.heard.clear()
    robot.truth, robot.mode = {"velocity_world_mps": np.array((0.3, 0.0, 0.0))}, ids.MODE_LOCOMOTION
    wait_for_heard(robot, ids.STOP_MOVE)
    client.close()


@pytest.mark.slow
def test_a_stop_move_that_is_never_answered_holds_nothing_up(
    robot: FakeGo2, bridge: Running, socket_path: Path, tmp_path: Path
) -> None:
    robot.unanswered = {ids.STOP_MOVE}
    with HostStall() as host, driver(socket_path, tmp_path) as runner:
        wait_for(robot.is_driven, 20, "the robot is driven")
        since_ns = time.monotonic_ns()
        runner.process.kill()
        lasting_zero_ns(robot, since_ns, STOP_BOUND_NS, host)
        zeros = [
            heard.received_ns for heard in robot.moves() if heard.velocity == ZERO and heard.received_ns > since_ns
        ]
        for earlier_ns, later_ns in pairwise(zeros):
            check_stop_latency(later_ns - earlier_ns, 40_000_000, earlier_ns, host)


def test_a_killed_bridges_successor_stops_the_moving_robot_first(
    robot: FakeGo2, bridge: Running, dds_domain: int, socket_path: Path, tmp_path: Path
) -> None:
    (tmp_path / "again").mkdir()
    with driver(socket_path, tmp_path):
        wait_for(robot.is_driven, 20, "the robot is driven")
        robot.truth, robot.mode = {"velocity_world_mps": np.array((0.5, 0.0, 0.0))}, ids.MODE_LOCOMOTION
        bridge.process.kill()
        bridge.process.wait()
    robot.heard.clear()
    arguments = ("--robot", GO2_SIM, "--domain", dds_domain, "--socket", socket_path)
    with running("firmware_bridge.bridge", *arguments, folder=tmp_path / "again") as successor:
        wait_for_heard(robot, ids.STOP_MOVE)
        assert robot.heard[0].velocity == ZERO
        wait_for(lambda: "the robot was moving" in successor.stderr(), 5, "the reason")


@pytest.mark.slow
def test_a_bridge_that_was_frozen_does_not_drive_on(
    robot: FakeGo2, bridge: Running, socket_path: Path, tmp_path: Path
) -> None:
    with driver(socket_path, tmp_path):
        wait_for(robot.is_driven, 20, "the robot is driven")
        os.kill(bridge.pid, signal.SIGSTOP)
        time.sleep(0.6)
        robot.heard.clear()
        os.kill(bridge.pid, signal.SIGCONT)
        time.sleep(0.5)
        assert robot.moves() and all(heard.velocity == ZERO for heard in robot.moves())


def test_another_robot_than_the_files_is_not_armed(robot: FakeGo2, bridge: Running, socket_path: Path) -> None:
    robot.version = "1.0.0.0"
    client = BridgeClient(socket_path)
    client.arm()
    wait_for(lambda: client.poll().cause == "wrong_robot", 10, "the refusal")
    assert {heard.api_id for heard in robot.heard} == {ids.API_VERSION}
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
        lasting_zero_ns(robot, since_ns, 100_000_000, host, wait_s=0.3)
    assert (stopped["state"], stopped["cause"]) == ("stopped", "estop")
    with driver(socket_path, tmp_path):
        wait_for(lambda: "arm refused" in bridge.stderr(), 10, "the refusal")
        assert not robot.is_driven()
        assert status("arm")["permit"] == "given"
        wait_for(robot.is_driven, 20, "the robot is driven again")


@pytest.mark.slow
def test_where_the_robot_file_says_so_an_operator_permits_every_single_arming(
    robot: FakeGo2, dds_domain: int, socket_path: Path, tmp_path: Path
) -> None:
    file = tmp_path / "robot.toml"
    file.write_text(GO2_SIM.read_text().replace("operator_arm = false", "operator_arm = true"))
    robot.reset()
    arguments = ("--robot", file, "--domain", dds_domain, "--socket", socket_path)
    with running("firmware_bridge.bridge", *arguments, folder=tmp_path):
        client = BridgeClient(socket_path)

        def told(state: str, cause: str) -> bool:
            status = client.poll()
            return status is not None and (status.state, status.cause) == (state, cause)

        client.arm()
        wait_for(lambda: told("disarmed", "operator"), 10, "the refusal")
        assert robot.heard == []
        assert operate("arm", socket_path)[0] == 0
        client.arm()
        wait_for(lambda: told("armed", "none"), 20, "armed")
        client.stop()
        wait_for(lambda: told("stopped", "client_stop"), 10, "stopped")
        client.arm()
        wait_for(lambda: told("stopped", "operator"), 10, "the second refusal")
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


@pytest.mark.parametrize("command", ["stop", "arm", "status"])
def test_an_operators_command_without_a_bridge_is_refused_in_one_line(
    socket_path: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert bridge_main([command, "--robot", str(GO2_SIM), "--socket", str(socket_path)]) == 3
    error = capsys.readouterr().err
    assert "no bridge listens" in error and error.count("\n") == 1


@pytest.mark.slow
def test_ten_thousand_hostile_datagrams_neither_crash_it_nor_move_the_robot_too_fast_nor_make_it_late(
    robot: FakeGo2, bridge: Running, socket_path: Path
) -> None:
    limits = load_robot_config(GO2_SIM).limits
    client = BridgeClient(socket_path)
    client.arm()
    wait_for(lambda: client.poll().state == "armed", 20, "armed")
    robot.heard.clear()
    with HostStall() as host:
        since_ns = time.monotonic_ns()
        for seq, data in enumerate(hostile_datagrams(10_000)):
            wait_for(functools.partial(sent, client, data), 10, "room in the socket")
            if seq % 100 == 0:
                client.send_velocity(seq, time.monotonic_ns(), 0.3, 0.0, 0.0)
                time.sleep(0.01)
        moves = [heard for heard in robot.moves() if heard.received_ns > since_ns]
        for earlier, later in pairwise(moves):
            gap_ns = later.received_ns - earlier.received_ns
            check_stop_latency(gap_ns, 40_000_000, earlier.received_ns, host)
    assert bridge.process.poll() is None
    assert len(moves) > 30
    for vx_mps, vy_mps, wz_radps in (heard.velocity for heard in moves):
        assert limits.vx_min_mps <= vx_mps <= limits.vx_max_mps
        assert abs(vy_mps) <= limits.vy_max_mps and abs(wz_radps) <= limits.wz_max_radps
    client.close()
    wait_for(lambda: not robot.is_driven(), 5, "zero velocity")


def hostile_datagrams(count: int) -> Iterator[bytes]:
    """Noise, valid datagrams with bytes changed, other versions and kinds, and too long ones; always the same."""
    random = Random(0)
    for number in range(count):
        valid = bytearray(encode(Velocity(number, time.monotonic_ns(), random.uniform(-9, 9), 0.2, math.nan)))
        kind = number % 5
        if kind == 0:
            yield random.randbytes(random.randrange(1, 80))
        elif kind == 1:
            for _ in range(random.randrange(1, 4)):
                valid[random.randrange(len(valid))] = random.randrange(256)
            yield bytes(valid)
        elif kind == 2:
            valid[4], valid[5] = random.randrange(256), random.choice((3, 4, 5, 255))
            yield bytes(valid)
        elif kind == 3:
            yield bytes(valid) + random.randbytes(random.randrange(1, 900))
        else:
            yield struct.pack("<4sBBHQq3d", b"TVEB", VERSION, 3, 40, number, 2**62, 3e38, -math.inf, 1e308)


def sent(client: BridgeClient, data: bytes) -> bool:
    """Whether the socket took it."""
    try:
        client._socket.send(data)
    except BlockingIOError:
        return False
    return True


def test_systemd_hears_ready_the_state_the_watchdog_and_the_end(
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


def test_a_frozen_bridge_does_not_feed_the_watchdog() -> None:
    pings: list[int] = []
    shell = Bridge.__new__(Bridge)
    shell._said, shell._ready = "armed: driving", True
    shell._notifier = SimpleNamespace(watchdog_period_ns=100, watchdog=lambda: pings.append(1))  # type: ignore
    shell._pinged_ns, shell._wake_ns = 0, 10**9
    status = BridgeStatus(10**9 + 60_000_000, "armed", "driving", 0, 0, 0, ZERO, False)
    shell._report_progress(status)
    assert pings == []
    shell._wake_ns = status.stamp_ns
    shell._report_progress(status)
    assert pings == [1]


@pytest.mark.parametrize(("content", "pressed"), [(b"0\n", False), (b"1\n", True), (b"", True), (b"junk", True)])
def test_a_local_emergency_stop_is_pressed_unless_its_file_reads_zero(
    tmp_path: Path, content: bytes, pressed: bool
) -> None:
    path = tmp_path / "value"
    path.write_bytes(content)
    assert is_pressed(path) is pressed


def test_a_local_emergency_stop_that_cannot_be_read_is_pressed(tmp_path: Path) -> None:
    assert is_pressed(tmp_path / "missing") and is_pressed(tmp_path)


def test_the_bridge_imports_neither_numpy_nor_anything_that_learns() -> None:
    code = (
        "import firmware_bridge.bridge, sys; print(sorted({'numpy', 'torch', 'onnxruntime', 'cv2'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


WIRE_TABLES = {"idl.py", "idl_low.py", "ids.py"}
READS_THE_ROBOT_FILE = {"config.py"}
# 1,000 before the latch, permissions, publisher counts, late interface, socket groups and safe outputs: 500 lines more.
MOST_LINES = 1550


@pytest.mark.slow
def test_the_bridge_process_stays_small_enough_to_be_read_in_an_afternoon() -> None:
    """All of ours that it imports, but for the wire's tables and the reading of the robot file before it starts."""
    ours = "[m.__file__ for name, m in sys.modules.items() if name.startswith('firmware_bridge')]"
    code = f"import firmware_bridge.bridge, sys; print(*{ours})"
    done = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    sizes = {path.name: lines_of_code(path.read_text()) for path in map(Path, done.stdout.split())}
    read_by_people = {name: size for name, size in sizes.items() if name not in WIRE_TABLES | READS_THE_ROBOT_FILE}
    assert sum(read_by_people.values()) < MOST_LINES, read_by_people


def lines_of_code(source: str) -> int:
    """Lines that hold code: no blank lines, comments, documentation strings or imports."""
    left_out = set()
    for node in ast.walk(ast.parse(source)):
        says = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        if says or isinstance(node, (ast.Import, ast.ImportFrom)):
            left_out |= set(range(node.lineno, (node.end_lineno or 0) + 1))  # type: ignore[attr-defined]
    skipped = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)
    code = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in skipped:
            code |= set(range(token.start[0], token.end[0] + 1))
    return len(code - left_out)
