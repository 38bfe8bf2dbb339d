"""What an operator's command does at the bridge's sockets; no robot, none of the bridge's rules."""

from __future__ import annotations

import errno
import io
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from edge.deploy import units
from firmware_bridge import bridge as bridge_module
from firmware_bridge import operate as operate_module
from firmware_bridge import peer as peer_module
from firmware_bridge.bridge import Bridge
from firmware_bridge.bridge import main as bridge_main
from firmware_bridge.client_link import ClientLink
from firmware_bridge.core import sections
from firmware_bridge.core.config import OPERATOR_SUFFIX, SERVICE_SOCKET, load_robot_config
from firmware_bridge.core.link import Arm, BridgeStatus, Message, Stop
from firmware_bridge.operate import operate
from firmware_bridge.system.line_log import LineLog
from firmware_bridge.system.notify import Notifier
from tests.support.processes import GO2_SIM, REPOSITORY


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "bridge.sock"


class Answering:
    """A bridge's operator socket in a thread: notes what it receives, and answers as a bridge that obeys."""

    def __init__(self, path: Path, drop: int = 0) -> None:
        """`drop`: so many clients are disconnected when they have sent a stop."""
        self.received: list[Message] = []
        self._drop = drop
        self._link = ClientLink(Path(f"{path}{OPERATOR_SUFFIX}"), places=4)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        stamp_ns = 2**62  # newer than every question
        while not self._closing.wait(0.002):
            messages = self._link.receive()
            if Stop() in messages and self._drop > 0:
                self._drop -= 1
                self._link.files()[-1].shutdown(socket.SHUT_RDWR)
                continue
            self.received += messages
            stopped = "estop" if Stop() in self.received else "none"
            stamp_ns += 10**9
            zero = (0.0, 0.0, 0.0)
            self._link.send_status(
                BridgeStatus(stamp_ns, "stopped", "as commanded", 0, 0, 0, zero, True, stopped, stopped, motion="still")
            )

    def close(self) -> None:
        self._closing.set()
        self._thread.join()
        self._link.close()


@contextmanager
def answering(*paths: Path, drop: int = 0) -> Iterator[list[Answering]]:
    bridges = [Answering(path, drop) for path in paths]
    try:
        yield bridges
    finally:
        for bridge in bridges:
            bridge.close()


class TestOperate:
    def test_a_stop_reaches_every_bridge_that_answers(self, tmp_path: Path) -> None:
        paths = tmp_path / "service", tmp_path / "own"
        with answering(*paths) as bridges:
            assert operate("stop", *paths)[0] == 0
        assert all(Stop() in bridge.received for bridge in bridges)

    def test_a_stop_whose_connection_ends_is_sent_again(self, path: Path) -> None:
        with answering(path, drop=2) as (bridge,):
            assert operate("stop", path)[0] == 0
        assert Stop() in bridge.received

    def test_a_socket_without_a_listener_changes_nothing(self, path: Path, tmp_path: Path) -> None:
        with answering(path):
            assert [operate(command, tmp_path / "none", path)[0] for command in ("status", "arm", "stop")] == [0] * 3

    def test_a_bridge_that_has_died_beside_another_one_is_no_success(self, tmp_path: Path, capsys) -> None:
        dead, mine = tmp_path / "dead", tmp_path / "own"
        left_behind(dead)
        with answering(mine) as (bridge,):
            assert operate("stop", dead, mine)[0] == 1
        assert Stop() in bridge.received
        assert f"the bridge of {dead} has died: its robot is NOT stopped" in capsys.readouterr().err

    @pytest.mark.parametrize("gap_s", [0.0, 0.05], ids=["at once", "after its socket was absent for 50 ms"])
    def test_a_bridge_that_starts_again_within_a_second_takes_the_stop(self, gap_s: float, tmp_path: Path) -> None:
        path = tmp_path / "service"
        left_behind(path)
        with ExitStack() as stack, ThreadPoolExecutor(1) as pool:
            code = pool.submit(operate, "stop", path)
            time.sleep(0.05)
            if gap_s:
                Path(f"{path}{OPERATOR_SUFFIX}").unlink()
                time.sleep(gap_s)
            (bridge,) = stack.enter_context(answering(path))
            assert code.result()[0] == 0
        assert Stop() in bridge.received

    def test_an_arm_that_two_bridges_could_mean_is_refused(self, tmp_path: Path, capsys) -> None:
        paths = tmp_path / "service", tmp_path / "own"
        with answering(*paths) as bridges:
            assert operate("arm", *paths)[0] == 3
        assert not any(Arm() in bridge.received for bridge in bridges)
        assert "choose one with --socket" in capsys.readouterr().err

    @pytest.mark.parametrize(("own", "code"), [(True, 1), (False, 3)])
    def test_a_bridge_that_this_user_may_not_reach_is_no_success(
        self, tmp_path: Path, own: bool, code: int, capsys, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        service, mine = tmp_path / "service", tmp_path / "own"
        deny(monkeypatch, service)
        with answering(*([mine] if own else [])):
            assert operate("stop", service, mine)[0] == code
        assert f"no permission for the bridge at {service}{OPERATOR_SUFFIX}; use sudo" in capsys.readouterr().err


def left_behind(path: Path) -> None:
    """The operators' socket of a bridge that was killed."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as killed:
        killed.bind(f"{path}{OPERATOR_SUFFIX}")


def deny(monkeypatch: pytest.MonkeyPatch, path: Path) -> None:
    """Connecting to `path` is not permitted: root, as whom tests may run, would be."""
    real: Callable[[socket.socket, str], None] = socket.socket.connect

    class Socket(socket.socket):
        def connect(self, address: str) -> None:  # type: ignore[override]
            if address == f"{path}{OPERATOR_SUFFIX}":
                raise PermissionError(errno.EACCES, "Permission denied")
            real(self, address)

    monkeypatch.setattr(peer_module.socket, "socket", Socket)


class TestCommandLine:
    def test_the_services_socket_is_the_units(self) -> None:
        assert SERVICE_SOCKET == units.SOCKET

    def test_without_a_socket_both_default_sockets_are_tried(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        asked: list[tuple[str, ...]] = []
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
        monkeypatch.setattr(operate_module, "operate", lambda *given: asked.append(given) or (0, {}))
        for command in ("stop", "arm", "status"):
            assert bridge_main([command, "--robot", str(GO2_SIM)]) == 0
        own = tmp_path / "tic-vla-edge" / "bridge.sock"
        assert asked == [(command, SERVICE_SOCKET, own) for command in ("stop", "arm", "status")]

    @pytest.mark.parametrize("has_session", [True, False], ids=["in a session", "of su or cron"])
    def test_a_bridge_of_the_same_users_other_kind_of_shell_is_found(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_session: bool
    ) -> None:
        user, temporary = tmp_path / "run" / str(os.getuid()), tmp_path / "tmp"
        places = [user / "tic-vla-edge", temporary / f"tic-vla-edge-{os.getuid()}"]
        monkeypatch.setattr(sections, "RUN_USER", user.parent)
        monkeypatch.setattr(sections, "TMP", temporary)
        if has_session:
            monkeypatch.setenv("XDG_RUNTIME_DIR", str(user))
        else:
            monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
            places.reverse()
        here, elsewhere = (place / "bridge.sock" for place in places)
        assert operate_module.sockets_of("stop", str(GO2_SIM), None) == (SERVICE_SOCKET, here)
        elsewhere.parent.mkdir(parents=True)
        elsewhere.touch()
        assert operate_module.sockets_of("stop", str(GO2_SIM), None) == (SERVICE_SOCKET, here, elsewhere)

    def test_a_socket_that_is_given_is_the_only_one(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        asked: list[tuple[str, ...]] = []
        monkeypatch.setattr(operate_module, "operate", lambda *given: asked.append(given) or (0, {}))
        bridge_main(["stop", "--robot", str(GO2_SIM), "--socket", str(path)])
        assert asked == [("stop", path)]


class TestRemoved:
    """A bridge that no operator can reach any more, as when a log-out has removed its folder."""

    @pytest.fixture
    def bridge(self, path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bridge]:
        monkeypatch.setattr(bridge_module, "_LOOK_AGAIN_NS", 0)
        monkeypatch.setattr(bridge_module, "missing_link", lambda _: "no cable")
        log = LineLog(io.StringIO(), "edge-bridge")
        yield Bridge(load_robot_config(GO2_SIM, socket=path), log, Notifier({}), tmp_path / "latch")
        log.close(1.0)

    @pytest.mark.parametrize("suffix", ["", OPERATOR_SUFFIX], ids=["the runner's", "the operators'"])
    @pytest.mark.parametrize("replaced", [True, False], ids=["replaced", "removed"])
    def test_it_ends_and_says_why(self, bridge: Bridge, path: Path, suffix: str, replaced: bool) -> None:
        file = Path(f"{path}{suffix}")
        file.rename(f"{file}.old")
        if replaced:
            file.touch()
        wakeup, other = socket.socketpair()
        with wakeup, other:
            bridge.run(wakeup)
        assert bridge.failed is not None and "no stop could reach this bridge" in bridge.failed
        assert file.exists() is replaced, "a file of another bridge stays"

    def test_with_its_sockets_in_place_it_runs_until_a_signal(self, bridge: Bridge, path: Path) -> None:
        wakeup, other = socket.socketpair()
        with wakeup, other, ThreadPoolExecutor(1) as pool:
            running = pool.submit(bridge.run, wakeup)
            time.sleep(0.3)
            assert not running.done()
            other.send(b"x")
            running.result(5.0)
        assert bridge.failed is None and not path.exists()


@pytest.mark.process
@pytest.mark.parametrize("errors", ["2>/dev/full", "2>&-"], ids=["full", "closed"])
@pytest.mark.parametrize("program", ["firmware_bridge.bridge stop --robot none.toml", "edge.run.say stop --to none"])
def test_a_stop_is_sent_although_no_message_can_be_written(path: Path, program: str, errors: str) -> None:
    command = f"{sys.executable} -m {program} --socket {path} {errors}"
    with answering(path) as (bridge,):
        done = subprocess.run(["sh", "-c", command], cwd=REPOSITORY, capture_output=True, check=False, timeout=300)
    assert Stop() in bridge.received and done.returncode == 0
