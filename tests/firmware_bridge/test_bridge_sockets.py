"""The bridge's two sockets and what an operator's command does at them; no robot, none of the bridge's rules."""

from __future__ import annotations

import errno
import os
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from edge.deploy import units
from firmware_bridge import operate as operate_module
from firmware_bridge import peer as peer_module
from firmware_bridge.bridge import main as bridge_main
from firmware_bridge.client import BridgeClient, BridgeUnavailable
from firmware_bridge.client_link import ClientLink, listen
from firmware_bridge.core.config import OPERATOR_SUFFIX, SERVICE_SOCKET, ConfigError, runtime_dir
from firmware_bridge.core.link import Arm, BridgeStatus, Message, Stop, encode
from firmware_bridge.operate import operate
from tests.support.processes import GO2_SIM

STOP = encode(Stop())


def connected_to(path: Path) -> socket.socket:
    client = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    client.connect(str(path))
    return client


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "bridge.sock"


class TestOneClient:
    def test_a_client_that_goes_is_seen_to_go_before_a_waiting_one_is_let_in(self, path: Path) -> None:
        with closing(ClientLink(path)) as link:
            first = connected_to(path)
            link.receive()
            first.close()
            second = connected_to(path)
            seen = []
            for _ in range(2):
                link.receive()
                seen.append(link.connected)
            assert seen == [False, True]
            second.close()

    @pytest.mark.parametrize("error", [errno.EMFILE, errno.ECONNABORTED])
    def test_a_connection_that_cannot_be_accepted_ends_nothing_and_is_not_polled_in_a_loop(
        self, path: Path, error: int, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def fail(_: socket.socket) -> None:
            raise OSError(error, os.strerror(error))

        with closing(ClientLink(path)) as link:
            listening = link.files()
            with monkeypatch.context() as patch:
                patch.setattr(socket.socket, "accept", fail)
                assert link.receive() == []
                assert link.files() == []
            link.receive()
            assert link.files() == listening


class TestOperators:
    def test_another_operator_swallows_no_stop(self, path: Path) -> None:
        with closing(ClientLink(path, places=4)) as link:
            first = connected_to(path)
            link.receive()
            first.send(STOP)
            second = connected_to(path)
            assert link.receive() == [Stop()]
            link.receive()
            first.send(STOP)
            assert link.receive() == [Stop()]
            first.close()
            second.close()

    def test_the_newest_of_many_replaces_the_oldest(self, path: Path) -> None:
        with closing(ClientLink(path, places=4)) as link:
            clients = []
            for _ in range(6):
                clients.append(connected_to(path))
                link.receive()
            clients[-1].send(STOP)
            assert link.receive() == [Stop()]
            assert clients[0].recv(1) == b""
            for client in clients:
                client.close()


class TestFolder:
    @pytest.fixture
    def folder(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
        return runtime_dir()

    def test_it_is_made_for_this_user_alone(self, folder: Path) -> None:
        listen(folder / "bridge.sock").close()
        assert folder.stat().st_mode & 0o777 == 0o700

    @pytest.mark.parametrize("bits", [0o770, 0o707, 0o711])
    def test_one_that_others_may_enter_is_refused(self, folder: Path, bits: int) -> None:
        folder.mkdir()
        folder.chmod(bits)
        with pytest.raises(ConfigError, match="expected a folder of this user's alone"):
            listen(folder / "bridge.sock")

    def test_a_link_to_a_folder_is_refused(self, folder: Path, tmp_path: Path) -> None:
        (tmp_path / "elsewhere").mkdir(mode=0o700)
        folder.symlink_to(tmp_path / "elsewhere")
        with pytest.raises(ConfigError, match="expected a folder of this user's alone"):
            listen(folder / "bridge.sock")

    def test_another_users_is_refused(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        folder.mkdir(mode=0o700)
        owner = folder.stat().st_uid
        monkeypatch.setattr(os, "getuid", lambda: owner + 1)
        with pytest.raises(ConfigError, match=f"of user {owner}"):
            listen(folder / "bridge.sock")

    def test_an_unreadable_folder_is_one_line(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def denied(_: Path) -> bool:
            raise PermissionError(errno.EACCES, "Permission denied")

        monkeypatch.setattr(Path, "exists", denied)
        with pytest.raises(ConfigError, match="cannot be used: Permission denied"):
            listen(path)

    def test_a_listener_of_another_user_is_not_believed(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        with closing(ClientLink(path)):
            monkeypatch.setattr(peer_module, "peer_uid", lambda _: os.getuid() + 1)
            with pytest.raises(BridgeUnavailable, match="not to a bridge of this user's"):
                BridgeClient(path)


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

    def test_a_socket_that_is_given_is_the_only_one(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        asked: list[tuple[str, ...]] = []
        monkeypatch.setattr(operate_module, "operate", lambda *given: asked.append(given) or (0, {}))
        bridge_main(["stop", "--robot", str(GO2_SIM), "--socket", str(path)])
        assert asked == [("stop", path)]
