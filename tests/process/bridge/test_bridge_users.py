"""Bridge, runner and operator as different users: which of them reaches which socket, and which bridge is believed."""

from __future__ import annotations

import grp
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from firmware_bridge.core.config import OPERATOR_SUFFIX
from firmware_bridge.peer import is_trusted_listener
from tests.support.processes import GO2_SIM, REPOSITORY, Running, running

pytestmark = pytest.mark.process

BRIDGE, RUNNER, OPERATOR, STRANGER = 64901, 64902, 64903, 64904
"""User numbers that no machine gives to anybody."""
SERVICE = Path("/run/tic-vla-edge/bridge.sock")
needs_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can become other users")


def folders(**changes: tuple[int, int]) -> object:
    """An lstat of a machine with the service's folder; `changes`: owner and mode of run, service or root."""
    table = {"root": (0, 0o40755), "run": (0, 0o40755), "service": (BRIDGE, 0o40711), **changes}
    named = {Path("/"): "root", Path("/run"): "run", SERVICE.parent: "service"}

    def lstat(path: Path) -> os.stat_result:
        if path not in named:
            raise FileNotFoundError(path)
        owner, mode = table[named[path]]
        return os.stat_result((mode, 0, 0, 1, owner, 0, 0, 0, 0, 0))

    return lstat


def is_trusted(uid: int, path: Path = SERVICE, own_uid: int = RUNNER, **changes: tuple[int, int]) -> bool:
    return is_trusted_listener(path, uid, own_uid=own_uid, lstat=folders(**changes))  # type: ignore[arg-type]


class TestTrust:
    """Which listeners a client accepts as the bridge."""

    @pytest.mark.parametrize("own_uid", [RUNNER, 0])
    def test_the_bridges_user_in_the_folder_that_root_gave_it_and_no_third_user(self, own_uid: int) -> None:
        assert is_trusted(BRIDGE, own_uid=own_uid)
        assert not is_trusted(STRANGER, own_uid=own_uid)

    def test_root_and_the_own_user_anywhere(self) -> None:
        assert is_trusted(0, Path("/tmp/x/bridge.sock")) and is_trusted(RUNNER, Path("/tmp/x/bridge.sock"))

    def test_no_user_that_has_made_the_folder_by_itself(self) -> None:
        assert not is_trusted(STRANGER, run=(0, 0o41777), service=(STRANGER, 0o40755))
        assert not is_trusted(STRANGER, run=(STRANGER, 0o40755), service=(STRANGER, 0o40755))

    @pytest.mark.parametrize("mode", [0o40731, 0o40713, 0o120777, 0o100644])
    def test_no_folder_that_others_may_write_to_nothing_else_and_nothing_missing(self, mode: int) -> None:
        assert not is_trusted(BRIDGE, service=(BRIDGE, mode))
        assert not is_trusted(BRIDGE, Path("/nowhere/bridge.sock"))


def other_groups() -> list[grp.struct_group]:
    return sorted((group for group in grp.getgrall() if group.gr_gid != 0), key=lambda group: group.gr_gid)


@pytest.fixture(scope="class")
def given_folder() -> Iterator[Path]:
    """A folder that root has given to the bridge's user, as systemd does."""
    folder = Path(tempfile.mkdtemp(prefix="tic-vla-test-", dir="/run"))
    os.chown(folder, BRIDGE, BRIDGE)
    folder.chmod(0o711)
    yield folder
    shutil.rmtree(folder)


@pytest.fixture(scope="class")
def socket_path(given_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The command socket of a bridge of its own user, whose interface is not there: it never joins a network."""
    folder = tmp_path_factory.mktemp("users")
    path, (runners, operators, *_) = given_folder / "bridge.sock", other_groups()
    arguments = ["--robot", robot_file(given_folder), "--socket", path, "--runner-group", runners.gr_name]
    arguments += ["--operator-group", operators.gr_name]
    numbers = f"{BRIDGE},{runners.gr_gid},{operators.gr_gid}"
    user = ("tests.support.robot.as_user", BRIDGE, numbers, "bridge")
    with running(*user, *arguments, folder=folder, ready="waiting for interface"):
        yield path


def robot_file(folder: Path) -> Path:
    path = folder / "robot.toml"
    path.write_text(GO2_SIM.read_text().replace('interface = "lo"', 'interface = "cable99"'))
    path.chmod(0o644)
    return path


def connect(uid: int, groups: list[int], path: Path) -> str:
    """What a client of that user says about a socket."""
    numbers = ",".join(map(str, [uid, *groups]))
    command = [sys.executable, "-m", "tests.support.robot.as_user", str(uid), numbers, "connect", str(path)]
    return subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=30, check=False).stdout


@needs_root
class TestRealUsers:
    def test_the_runner_reaches_its_own_socket_and_not_the_operators(self, socket_path: Path) -> None:
        runners = other_groups()[0].gr_gid
        assert connect(RUNNER, [runners], socket_path) == "connected"
        assert "no permission" in connect(RUNNER, [runners], Path(f"{socket_path}{OPERATOR_SUFFIX}"))

    def test_an_operator_reaches_the_operators_socket_and_not_the_runners(self, socket_path: Path) -> None:
        operators = other_groups()[1].gr_gid
        assert connect(OPERATOR, [operators], Path(f"{socket_path}{OPERATOR_SUFFIX}")) == "connected"
        assert "no permission" in connect(OPERATOR, [operators], socket_path)

    def test_any_other_user_reaches_neither(self, socket_path: Path) -> None:
        for path in (socket_path, Path(f"{socket_path}{OPERATOR_SUFFIX}")):
            assert "no permission" in connect(STRANGER, [], path)

    def test_the_runner_refuses_an_impostors_socket(self, tmp_path: Path) -> None:
        folder = Path(tempfile.mkdtemp(prefix="tic-vla-test-", dir="/tmp"))
        os.chown(folder, STRANGER, STRANGER)
        folder.chmod(0o711)
        path = folder / "bridge.sock"
        try:
            with running(
                "tests.support.robot.as_user", STRANGER, str(STRANGER), "listen", path, folder=tmp_path
            ) as impostor:
                assert isinstance(impostor, Running)
                assert f"belongs to user {STRANGER}" in connect(RUNNER, [], path)
        finally:
            shutil.rmtree(folder)
