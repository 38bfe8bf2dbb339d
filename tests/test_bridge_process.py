"""The real `edge-bridge` process between a client that fails and a robot that listens; times are the robot's."""

from __future__ import annotations

import ast
import io
import json
import os
import signal
import stat
import subprocess
import sys
import time
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

from firmware_bridge.client import BridgeClient, BridgeUnavailable
from firmware_bridge.unitree import ids
from tests.fake_go2 import FakeGo2
from tests.processes import GO2_SIM, REPOSITORY, HostStall, Running, check_stop_latency, running, wait_for

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
    with running("firmware_bridge.bridge", *arguments, folder=tmp_path) as started:
        robot.heard.clear()
        robot.mode = ids.MODE_LIE_DOWN
        yield started


def driver(socket_path: Path, folder: Path):
    return running("tests.bridge_driver", socket_path, 0.5, folder=folder)


def latency_to_zero_ns(robot: FakeGo2, since_ns: int) -> int:
    """From `since_ns` until the robot heard its first zero velocity with nothing but zeros after it."""
    time.sleep(1.0)
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


def test_a_second_client_is_turned_away_and_the_first_drives_on(
    robot: FakeGo2, bridge: Running, socket_path: Path, tmp_path: Path
) -> None:
    with driver(socket_path, tmp_path):
        wait_for(robot.is_driven, 20, "the robot is driven")
        with pytest.raises(BridgeUnavailable, match="another client"):
            BridgeClient(socket_path)
        time.sleep(0.3)
        assert robot.is_driven()


def test_a_new_client_may_arm_again_after_the_first_has_died(
    robot: FakeGo2, bridge: Running, socket_path: Path, tmp_path: Path
) -> None:
    for _ in range(2):
        with driver(socket_path, tmp_path) as runner:
            wait_for(robot.is_driven, 20, "the robot is driven")
            runner.process.kill()
        wait_for(lambda: not robot.is_driven(), 20, "zero velocity")


def test_garbage_on_the_socket_is_ignored(robot: FakeGo2, bridge: Running, socket_path: Path) -> None:
    client = BridgeClient(socket_path)
    for data in (b"\0", b"TVEB" + b"\xff" * 600, b"x" * 511):
        client._socket.send(data)
    client.arm()
    wait_for(lambda: client.poll().state == "armed", 20, "armed")
    client.close()


def test_the_socket_is_the_users_alone(bridge: Running, socket_path: Path) -> None:
    assert stat.S_IMODE(socket_path.stat().st_mode) == 0o600


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


def test_the_bridge_imports_neither_numpy_nor_anything_that_learns() -> None:
    code = (
        "import firmware_bridge.bridge, sys; print(sorted({'numpy', 'torch', 'onnxruntime', 'cv2'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_bridge_process_stays_small_enough_to_be_read_in_an_afternoon() -> None:
    ours = "[m.__file__ for name, m in sys.modules.items() if name.startswith('firmware_bridge')]"
    code = f"import firmware_bridge.bridge, sys; print(*{ours})"
    done = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    assert sum(lines_of_code(Path(name).read_text()) for name in done.stdout.split()) < 1000


def lines_of_code(source: str) -> int:
    """Lines that hold code: no blank lines, comments or docstrings."""
    documentation = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)) and ast.get_docstring(node, clean=False):
            documentation |= set(range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1))
    skipped = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)
    code = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in skipped:
            code |= set(range(token.start[0], token.end[0] + 1))
    return len(code - documentation)
