"""The bridge as a program: how large it is, what it imports, its watchdog, its local input, and commands without it."""

from __future__ import annotations

import ast
import io
import os
import signal
import socket
import subprocess
import sys
import time
import tokenize
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import pytest

from firmware_bridge.absent_robot import AbsentRobot
from firmware_bridge.bridge import Bridge, is_pressed, take_priority
from firmware_bridge.bridge import main as bridge_main
from firmware_bridge.client import BridgeClient, BridgeUnavailable
from firmware_bridge.client_link import ClientLink, SocketTakenError
from firmware_bridge.core.config import BRIDGE_PRIORITY, SERVICE_SOCKET, load_robot_config, runtime_dir
from firmware_bridge.core.link import BridgeStatus
from firmware_bridge.core.robot_state import LinkOpenError
from firmware_bridge.core.step_types import Outputs, Report
from firmware_bridge.system.line_log import LineLog
from firmware_bridge.system.notify import Notifier
from tests.support.processes import GO2_SIM, REPOSITORY


@pytest.mark.parametrize(
    ("failed", "late", "said"),
    [(False, False, None), (True, False, "ends with the bridge"), (False, True, "a killed bridge loses this stop")],
)
def test_a_confirmed_stop_that_is_not_on_the_disk_says_so(failed: bool, late: bool, said: str | None) -> None:
    shell, sent = Bridge.__new__(Bridge), []
    status = BridgeStatus(1, "stopped", "emergency stop by an operator", 0, 0, 0, (0.0, 0.0, 0.0), True)
    silent = SimpleNamespace(
        receive=list, connected=False, send_status=lambda _: None, malformed=0, send=lambda _: None
    )
    shell._join_late = lambda: None  # type: ignore
    shell._link, shell._observers, shell._estop_file = silent, silent, None  # type: ignore
    shell._operators = SimpleNamespace(receive=list, send_status=sent.append)  # type: ignore
    shell._robot = SimpleNamespace(read=lambda _: Report(), write=lambda _: None)  # type: ignore
    shell._core = SimpleNamespace(step=lambda *_: Outputs((), status, 0, "latched"))  # type: ignore
    shell._latch_file = SimpleNamespace(keep=lambda *_: True, failed=failed, is_late=late)  # type: ignore
    shell._report_progress = lambda _: None  # type: ignore
    shell._step()
    assert ("NOT ON DISK" in sent[0].reason) == (said is not None) and (said or "") in sent[0].reason


def test_a_frozen_bridge_does_not_feed_the_watchdog() -> None:
    pings: list[int] = []
    shell = Bridge.__new__(Bridge)
    shell._reported, shell._ready = "armed: driving", True
    shell._notifier = SimpleNamespace(watchdog_period_ns=100, watchdog=lambda: pings.append(1))  # type: ignore
    shell._pinged_ns, shell._wake_ns = 0, 10**9
    status = BridgeStatus(10**9 + 60_000_000, "armed", "driving", 0, 0, 0, (0.0, 0.0, 0.0), False)
    shell._report_progress(status)
    assert pings == []
    shell._wake_ns = status.stamp_ns
    shell._report_progress(status)
    assert pings == [1]


def waiting_shell(*files: socket.socket) -> Bridge:
    """A bridge that polls these sockets of clients."""
    shell = Bridge.__new__(Bridge)
    shell._link = SimpleNamespace(files=lambda: files)  # type: ignore
    shell._operators = shell._observers = SimpleNamespace(files=list)  # type: ignore
    return shell


def test_a_client_that_floods_the_bridge_does_not_keep_it_from_sleeping() -> None:
    (bridge, client), (wakeup, signals) = socket.socketpair(), socket.socketpair()
    with bridge, client, wakeup, signals:
        client.send(b"x")  # never read here, as if a client had sent more than a step reads
        shell, begin_ns = waiting_shell(bridge), time.monotonic_ns()
        for _ in range(20):
            assert not shell._wait(wakeup, time.monotonic_ns() + 10**9)
        assert time.monotonic_ns() - begin_ns >= 20_000_000
        signals.send(b"x")
        assert shell._wait(wakeup, time.monotonic_ns() + 10**9)


@pytest.mark.parametrize(("ahead_ns", "longest_s"), [(10**9, 1e-3), (200_000, 2e-4), (-(10**9), 0.0)])
def test_the_pause_after_a_step_ends_before_the_next_step_is_due(
    monkeypatch: pytest.MonkeyPatch, ahead_ns: int, longest_s: float
) -> None:
    slept: list[float] = []
    wakeup, signals = socket.socketpair()
    with wakeup, signals, monkeypatch.context() as patch:
        signals.send(b"x")
        patch.setattr(time, "sleep", slept.append)
        assert waiting_shell()._wait(wakeup, time.monotonic_ns() + ahead_ns)
    assert len(slept) == 1 and 0.0 <= slept[0] <= longest_s


class FakeScheduling:
    """The process's scheduling: policy and priority; `permitted`: whether the system grants real-time priorities."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, policy: int, priority: int, *, permitted: bool = True) -> None:
        self.found, self._permitted = (policy, priority), permitted
        monkeypatch.setattr(os, "sched_getscheduler", lambda _: self.found[0])
        monkeypatch.setattr(os, "sched_getparam", lambda _: os.sched_param(self.found[1]))
        monkeypatch.setattr(os, "sched_setscheduler", self._set)

    def _set(self, _: int, policy: int, param: os.sched_param) -> None:
        if not self._permitted:
            raise PermissionError(1, "Operation not permitted")
        self.found = policy, param.sched_priority


OURS = (os.SCHED_FIFO, BRIDGE_PRIORITY)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ((os.SCHED_OTHER, 0), OURS),
        ((os.SCHED_FIFO, BRIDGE_PRIORITY - 1), OURS),
        ((os.SCHED_RR, BRIDGE_PRIORITY + 1), (os.SCHED_RR, BRIDGE_PRIORITY + 1)),
        ((os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, 99), (os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, 99)),
    ],
)
def test_the_bridge_takes_its_real_time_priority_and_keeps_a_higher_one(
    monkeypatch: pytest.MonkeyPatch, before: tuple[int, int], after: tuple[int, int]
) -> None:
    with monkeypatch.context() as patch:
        scheduling = FakeScheduling(patch, *before)
        take_priority(BRIDGE_PRIORITY)
    assert scheduling.found == after


@pytest.mark.parametrize(
    ("before", "after"),
    [(OURS, (os.SCHED_FIFO, BRIDGE_PRIORITY - 1)), ((os.SCHED_RR, 70), (os.SCHED_RR, 70))],
)
def test_the_threads_of_the_robots_link_get_one_less(
    monkeypatch: pytest.MonkeyPatch, before: tuple[int, int], after: tuple[int, int]
) -> None:
    """On a single core a flood that keeps them busy would otherwise hold the thread that stops the robot."""
    opened: list[tuple[int, int]] = []
    shell = Bridge.__new__(Bridge)
    shell._config, shell._robot = load_robot_config(GO2_SIM), AbsentRobot("late")
    shell._log = SimpleNamespace(write=print)  # type: ignore
    with monkeypatch.context() as patch:
        scheduling = FakeScheduling(patch, *before)
        shell._open_backend = lambda *_: opened.append(scheduling.found) or AbsentRobot("")  # type: ignore
        shell._join_robot()
    assert opened == [after] and scheduling.found == before


def test_a_link_that_appears_before_it_can_be_opened_is_tried_again_each_second(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A serial device appears as root's alone, before udev gives it to its group."""
    now_ns, tried_ns = [0], []

    def denied() -> bool:
        tried_ns.append(now_ns[0])
        raise LinkOpenError("serial device /dev/ttyACM0: Permission denied")

    shell = Bridge.__new__(Bridge)
    shell._join_ns, shell._robot, shell._join_robot = 0, AbsentRobot("missing"), denied  # type: ignore
    with monkeypatch.context() as patch:
        patch.setattr(time, "monotonic_ns", lambda: now_ns[0])
        for _ in range(110):
            shell._join_late()
            now_ns[0] += 20_000_000
    assert tried_ns == [0, 10**9, 2 * 10**9]
    assert shell._robot.reason == "serial device /dev/ttyACM0: Permission denied"  # type: ignore


def test_a_bridge_under_nohup_stays_when_its_terminal_is_closed() -> None:
    script = (
        "import os, signal; from firmware_bridge.system.process import signals_to_socket\n"
        "signal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
        "with signals_to_socket() as wakeup:\n"
        "    os.kill(os.getpid(), signal.SIGHUP); os.kill(os.getpid(), signal.SIGTERM)\n"
        "    print(*wakeup.recv(9))\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=REPOSITORY, check=True)
    assert done.stdout.split() == [str(int(signal.SIGTERM))]


def test_a_terminal_that_stops_background_programs_does_not_freeze_the_bridge() -> None:
    script = (
        "import os, signal; from firmware_bridge.system.process import signals_to_socket\n"
        "with signals_to_socket():\n"
        "    os.kill(os.getpid(), signal.SIGTTOU); os.kill(os.getpid(), signal.SIGTTIN); print('on')\n"
    )
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True, cwd=REPOSITORY) as process:
        _, status = os.waitpid(process.pid, os.WUNTRACED)
        process.kill()
        assert process.stdout is not None and process.stdout.read() == "on\n" and not os.WIFSTOPPED(status)


def test_a_bridge_without_the_right_to_a_priority_runs_without_one(monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        scheduling = FakeScheduling(patch, os.SCHED_OTHER, 0, permitted=False)
        take_priority(BRIDGE_PRIORITY)
    assert scheduling.found == (os.SCHED_OTHER, 0)


@pytest.mark.parametrize(("content", "pressed"), [(b"0\n", False), (b"1\n", True), (b"", True), (b"junk", True)])
def test_a_local_emergency_stop_is_pressed_unless_its_file_reads_zero(
    tmp_path: Path, content: bytes, pressed: bool
) -> None:
    path = tmp_path / "value"
    path.write_bytes(content)
    assert is_pressed(path) is pressed
    assert is_pressed(tmp_path / "missing") and is_pressed(tmp_path)


def test_the_bridge_imports_neither_numpy_nor_anything_that_learns() -> None:
    code = (
        "import firmware_bridge.bridge, sys; print(sorted({'numpy', 'torch', 'onnxruntime', 'cv2'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


WIRE_TABLES = {"idl.py", "idl_low.py", "ids.py"}


READS_THE_ROBOT_FILE = {"config.py", "config_can.py", "config_mavlink.py", "config_ros2.py", "sections.py"}


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


def test_without_a_bridge_the_client_advises_the_user(tmp_path: Path) -> None:
    with pytest.raises(BridgeUnavailable, match="start `edge-bridge"):
        BridgeClient(tmp_path / "bridge.sock")


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, ...]]:
    """What would have been sent, and to which sockets."""
    found: list[tuple[str, ...]] = []

    def operate(command: str, *sockets: Path) -> tuple[int, dict[str, object]]:
        found.append((command, *map(str, sockets)))
        return 0, {}

    monkeypatch.setattr("firmware_bridge.operate.operate", operate)
    return found


@pytest.mark.parametrize("broken", ["", "[bridge]\nsocket = 5\n", "\x00", None])
def test_a_stop_needs_no_usable_robot_file(
    tmp_path: Path, broken: str | None, asked: list[tuple[str, ...]], capsys: pytest.CaptureFixture[str]
) -> None:
    robot = tmp_path / "robot.toml"
    if broken is not None:
        robot.write_text(broken)
    usual = (str(SERVICE_SOCKET), str(runtime_dir() / "bridge.sock"))
    assert bridge_main(["stop", "--robot", str(robot)]) == 0
    assert asked == [("stop", *usual)]
    assert "robot.toml" in capsys.readouterr().err
    assert bridge_main(["stop", "--robot", str(robot), "--socket", "/own.sock"]) == 0
    assert asked[1:] == [("stop", "/own.sock")]
    assert bridge_main(["arm", "--robot", str(robot)]) == 2 and len(asked) == 2


def test_a_stop_is_sent_although_its_result_cannot_be_written(
    tmp_path: Path, asked: list[tuple[str, ...]], capsys: pytest.CaptureFixture[str]
) -> None:
    nowhere = str(tmp_path)  # a folder
    assert bridge_main(["stop", "--robot", str(GO2_SIM), "--json", nowhere]) == 1
    assert [command for command, *_ in asked] == ["stop"]
    assert "the result could not be written" in capsys.readouterr().err
    assert bridge_main(["arm", "--robot", str(GO2_SIM), "--json", nowhere]) == 2 and len(asked) == 1


def test_an_interrupted_operators_command_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: object) -> tuple[int, dict[str, object]]:
        raise KeyboardInterrupt

    monkeypatch.setattr("firmware_bridge.operate.operate", interrupted)
    assert bridge_main(["stop", "--robot", str(GO2_SIM)]) == 130
    error = capsys.readouterr().err
    assert "interrupted" in error and error.count("\n") == 1


def test_a_second_bridge_does_not_touch_the_robots_link(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Bridge, "_join_robot", lambda _: pytest.fail("the link was opened"))
    path = tmp_path / "bridge.sock"
    config, log = load_robot_config(GO2_SIM, socket=path), LineLog(io.StringIO(), "edge-bridge")
    with closing(ClientLink(path)), pytest.raises(SocketTakenError):
        Bridge(config, log, Notifier({}), tmp_path / "latch")
    log.close(1.0)


@pytest.mark.parametrize("command", ["stop", "arm", "status"])
def test_an_operators_command_without_a_bridge_is_refused_in_one_line(
    tmp_path: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert bridge_main([command, "--robot", str(GO2_SIM), "--socket", str(tmp_path / "bridge.sock")]) == 3
    error = capsys.readouterr().err
    assert "no bridge listens" in error and error.count("\n") == 1
