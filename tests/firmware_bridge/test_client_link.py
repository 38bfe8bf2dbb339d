"""The bridge's end of its sockets: connections, datagrams, and the users and files that it accepts."""

from __future__ import annotations

import errno
import grp
import os
import socket
import stat
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from firmware_bridge import client_link
from firmware_bridge import peer as peer_module
from firmware_bridge.client import BridgeClient, BridgeUnavailable
from firmware_bridge.client_link import ClientLink, SocketGroups, SocketTakenError, check_is_ours, listen
from firmware_bridge.core.config import ConfigError, runtime_dir
from firmware_bridge.core.link import Arm, BridgeStatus, Message, Stop, decode, encode

STOP = encode(Stop())
STATUS = BridgeStatus(1, "disarmed", "", 0, 0, 0, (0.0, 0.0, 0.0), True)
OWN_GROUP = grp.getgrgid(os.getgid()).gr_name


def connected_to(path: Path) -> socket.socket:
    client = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    client.connect(str(path))
    return client


def decoded(client: socket.socket) -> list[Message]:
    """Every datagram that waits at a client."""
    client.setblocking(False)
    messages = []
    while True:
        try:
            messages.append(decode(client.recv(1024)))
        except BlockingIOError:
            return messages


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

    @pytest.mark.parametrize("places", [2, 4])
    def test_the_newest_of_many_replaces_the_oldest(self, path: Path, places: int) -> None:
        with closing(ClientLink(path, places=places)) as link:
            clients = []
            for _ in range(6):
                clients.append(connected_to(path))
                link.receive()
            clients[-1].send(STOP)
            assert link.receive() == [Stop()]
            assert clients[0].recv(1) == b""
            for client in clients:
                client.close()


class TestDatagrams:
    def test_a_malformed_one_is_counted_and_the_next_one_arrives(self, path: Path) -> None:
        with closing(ClientLink(path)) as link, connected_to(path) as client:
            link.receive()
            client.send(b"TVEB?")
            client.send(STOP)
            assert link.receive() == [Stop()]
            assert link.malformed == 1

    def test_a_flood_is_read_64_a_step_and_the_rest_in_the_next(self, path: Path) -> None:
        with closing(ClientLink(path)) as link, connected_to(path) as client:
            link.receive()
            for _ in range(100):
                client.send(STOP)
            assert [len(link.receive()) for _ in range(3)] == [64, 36, 0]

    def test_what_a_client_sent_before_it_left_is_read_although_it_left_statuses_unread(self, path: Path) -> None:
        with closing(ClientLink(path)) as link:
            client = connected_to(path)
            link.receive()
            link.send_status(STATUS)
            client.send(STOP)
            client.close()
            assert link.receive() == [Stop()]
            assert not link.connected

    def test_a_stop_that_is_sent_while_the_bridge_hangs_is_read_when_it_runs_again(self, path: Path) -> None:
        with closing(ClientLink(path)) as link:
            with pytest.raises(BridgeUnavailable, match="does not answer"):
                BridgeClient(path, first=Stop())
            assert link.receive() + link.receive() == [Stop()]

    def test_a_connection_that_breaks_counts_as_gone(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def broken(*_: object) -> bytes:
            raise OSError(errno.ECONNRESET, os.strerror(errno.ECONNRESET))

        with closing(ClientLink(path)) as link, connected_to(path):
            link.receive()
            with monkeypatch.context() as patch:
                patch.setattr(socket.socket, "recv", broken)
                assert link.receive() == []
            assert not link.connected

    def test_a_second_client_of_the_runners_socket_is_refused_without_a_greeting(self, path: Path) -> None:
        with closing(ClientLink(path)) as link, connected_to(path) as first:
            link.receive()
            with connected_to(path) as second:
                link.receive()
                assert second.recv(1) == b""
            first.send(STOP)
            assert link.receive() == [Stop()]

    def test_a_status_goes_out_on_a_change_and_ten_times_a_second(self, path: Path) -> None:
        with closing(ClientLink(path)) as link, connected_to(path) as client:
            link.receive()
            client.setblocking(False)
            link.send_status(STATUS)
            for change in ({}, {"stamp_ns": 99_999_999}, {"commands": 7}):
                link.send_status(replace(STATUS, **change))
            assert decoded(client) == [STATUS]
            for news in ({"state": "armed"}, {"cause": "estop"}, {"blocked_by": "tipped"}, {"stamp_ns": 200_000_000}):
                link.send_status(replace(STATUS, **news))
                assert decoded(client) == [replace(STATUS, **news)]
            link.send_status(replace(STATUS, stamp_ns=300_000_000))
            assert len(decoded(client)) == 1

    def test_a_new_client_is_greeted_with_a_status_that_has_not_changed(self, path: Path) -> None:
        with closing(ClientLink(path, places=2)) as link, connected_to(path) as first:
            link.receive()
            link.send_status(STATUS)
            with connected_to(path) as second:
                link.receive()
                link.send_status(STATUS)
                assert decoded(second) == [STATUS]
            assert len(decoded(first)) == 2

    def test_a_client_that_has_gone_or_does_not_read_delays_no_other(self, path: Path) -> None:
        with closing(ClientLink(path, places=3)) as link, connected_to(path) as gone, connected_to(path) as hung:
            link.receive()
            link.receive()
            with connected_to(path) as reader:
                link.receive()
                gone.close()
                for stamp_ns in range(0, 10**11, 10**8):
                    link.send_status(replace(STATUS, stamp_ns=stamp_ns))
                    link.send(Arm())
                    assert len(decoded(reader)) >= 1
            assert len(decoded(hung)) < 2000

    def test_a_message_reaches_every_client(self, path: Path) -> None:
        with closing(ClientLink(path, places=2)) as link, connected_to(path) as first, connected_to(path) as second:
            link.receive()
            link.receive()
            link.send(Arm())
            assert decoded(first) == decoded(second) == [Arm()]

    def test_a_message_without_clients_goes_nowhere(self, path: Path) -> None:
        with closing(ClientLink(path)) as link:
            link.send(Arm())
            with connected_to(path) as client:
                link.receive()
                assert decoded(client) == []


class TestListening:
    def test_a_second_bridge_at_the_same_path_is_refused_and_the_first_goes_on(self, path: Path) -> None:
        with closing(ClientLink(path)) as link:
            with pytest.raises(SocketTakenError, match="another bridge listens"):
                listen(path)
            with connected_to(path):
                link.receive()
                assert link.connected

    def test_the_socket_of_a_killed_bridge_is_replaced(self, path: Path) -> None:
        listen(path).close()
        assert path.exists()
        with closing(ClientLink(path)) as link, connected_to(path):
            link.receive()
            assert link.connected
        assert not path.exists()

    def test_a_file_at_the_path_is_refused_and_kept(self, path: Path) -> None:
        path.write_text("mine")
        with pytest.raises(ConfigError, match="found a file"):
            listen(path)
        assert path.read_text() == "mine"

    def test_only_this_user_may_connect(self, path: Path) -> None:
        listen(path).close()
        assert stat.S_IMODE(path.stat().st_mode) == 0o600

    @pytest.mark.parametrize("group", [None, OWN_GROUP])
    def test_the_folders_above_are_made(self, tmp_path: Path, group: str | None) -> None:
        listen(tmp_path / "run" / "robots" / "bridge.sock", group).close()
        assert (tmp_path / "run" / "robots" / "bridge.sock").is_socket()

    def test_five_connections_wait_and_no_more(self, path: Path) -> None:
        waiting: list[socket.socket] = []
        with closing(listen(path)), pytest.raises(BlockingIOError):
            while len(waiting) < 20:
                waiting.append(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET))
                waiting[-1].setblocking(False)
                waiting[-1].connect(str(path))
        for client in waiting:
            client.close()
        assert len(waiting) == 6

    @pytest.mark.parametrize("error", [PermissionError(errno.EACCES, "Permission denied"), ConfigError("no group")])
    def test_a_refusal_leaves_no_descriptor_open(
        self, path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
    ) -> None:
        def fail(*_: object, **_named: object) -> None:
            raise error

        monkeypatch.setattr(client_link, "_make_folder", fail)
        before = len(list(Path("/proc/self/fd").iterdir()))
        with pytest.raises(ConfigError) as refusal:
            listen(path)
        assert len(list(Path("/proc/self/fd").iterdir())) == before, refusal.value  # which holds the local variables

    def test_a_stale_socket_that_somebody_else_removes_first_is_no_error(
        self, path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(socket.socket, "connect_ex", lambda *_: errno.ECONNREFUSED)
        listen(path).close()
        assert path.is_socket()

    def test_closing_disconnects_the_clients_and_takes_a_removed_file_for_done(self, path: Path) -> None:
        link = ClientLink(path)
        with connected_to(path) as client:
            link.receive()
            path.unlink()
            link.close()
            assert client.recv(1) == b""

    @pytest.mark.parametrize("is_replaced", [False, True])
    def test_a_socket_without_its_file_knows_it_and_leaves_anothers(self, path: Path, is_replaced: bool) -> None:
        with closing(ClientLink(path)) as link:
            assert not link.is_removed
            path.unlink()
            if is_replaced:
                path.write_text("another's")
            assert link.is_removed
        assert path.exists() == is_replaced

    def test_a_file_that_goes_while_the_socket_closes_is_no_error(
        self, path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        link = ClientLink(path)
        path.unlink()
        monkeypatch.setattr(ClientLink, "is_removed", False)
        link.close()


class TestGroups:
    def test_one_group_for_runner_and_operators_is_refused(self) -> None:
        with pytest.raises(ConfigError, match="expected two groups"):
            SocketGroups("robots", "robots")

    def test_a_group_that_the_machine_does_not_know_is_refused(self, tmp_path: Path) -> None:
        folder = tmp_path / "run"
        with pytest.raises(ConfigError, match="no such group"):
            listen(folder / "bridge.sock", "no-such-group-here")

    def test_a_folder_that_others_may_write_to_is_refused(self, tmp_path: Path) -> None:
        folder = tmp_path / "run"
        folder.mkdir()
        folder.chmod(0o733)
        with pytest.raises(ConfigError, match="mode 0711"):
            listen(folder / "bridge.sock", OWN_GROUP)

    def test_a_socket_of_a_group_is_open_to_it_and_its_folder_can_only_be_passed_through(self, tmp_path: Path) -> None:
        path = tmp_path / "run" / "bridge.sock"
        old = os.umask(0o077)
        try:
            listen(path, OWN_GROUP).close()
        finally:
            os.umask(old)
        assert stat.S_IMODE(path.parent.stat().st_mode) == 0o711
        found = path.stat()
        assert (stat.S_IMODE(found.st_mode), found.st_uid, found.st_gid) == (0o660, os.getuid(), os.getgid())

    @pytest.mark.parametrize("mode", [0o700, 0o710, 0o721, 0o713])
    def test_a_folder_that_a_group_cannot_pass_or_others_may_change_is_refused(self, tmp_path: Path, mode: int) -> None:
        (tmp_path / "run").mkdir()
        (tmp_path / "run").chmod(mode)
        with pytest.raises(ConfigError, match="of this user's with mode 0711"):
            listen(tmp_path / "run" / "bridge.sock", OWN_GROUP)

    def test_a_file_in_the_place_of_the_folder_is_refused(self, tmp_path: Path) -> None:
        (tmp_path / "run").touch()
        (tmp_path / "run").chmod(0o711)
        with pytest.raises(ConfigError, match="of this user's with mode 0711"):
            listen(tmp_path / "run" / "bridge.sock", OWN_GROUP)

    def test_a_folder_of_another_user_is_refused(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        (tmp_path / "run").mkdir()
        (tmp_path / "run").chmod(0o711)
        owner = os.getuid()
        monkeypatch.setattr(os, "getuid", lambda: owner + 1)
        with pytest.raises(ConfigError, match=f"of user {owner}"):
            listen(tmp_path / "run" / "bridge.sock", OWN_GROUP)

    def test_the_reason_is_told_also_when_the_socket_has_gone_meanwhile(
        self, path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def gone(*_: object) -> None:
            path.with_name("run").joinpath("bridge.sock").unlink()
            raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))

        monkeypatch.setattr(os, "chown", gone)
        with pytest.raises(ConfigError, match="not in it"):
            listen(path.with_name("run") / "bridge.sock", OWN_GROUP)

    def test_a_group_that_the_bridge_is_not_in_is_refused_and_leaves_no_socket(
        self, path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def denied(*_: object) -> None:
            raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))

        monkeypatch.setattr(os, "chown", denied)
        with pytest.raises(ConfigError, match="not in it"):
            listen(path.parent / "run" / "bridge.sock", OWN_GROUP)
        assert list((path.parent / "run").iterdir()) == []


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

    def test_a_file_is_refused(self, tmp_path: Path) -> None:
        (tmp_path / "file").touch(mode=0o600)
        with pytest.raises(ConfigError, match="expected a folder of this user's alone"):
            check_is_ours(tmp_path / "file")

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
