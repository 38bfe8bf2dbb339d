"""The command line of the live view, and the token that survives a restart."""

from __future__ import annotations

import argparse
import socket
import stat
from pathlib import Path

import pytest

from edge.live import options as options_module
from edge.live.options import LiveError, LiveOptions, add_live_arguments, kept_token, live_options
from firmware_bridge.core.config import ConfigError


def read(*arguments: str) -> LiveOptions | None:
    parser = argparse.ArgumentParser()
    add_live_arguments(parser)
    return live_options(parser.parse_args(arguments))


def test_nothing_listens_unless_asked() -> None:
    assert read() is None


def test_the_arguments_of_the_options_give_the_same_options(tmp_path: Path) -> None:
    options = LiveOptions("0.0.0.0", 9000, tmp_path / "token")
    assert read(*options.arguments()) == options


@pytest.mark.parametrize("flag", ["--live-address=0.0.0.0", "--live-token=token"])
def test_an_option_without_the_view_is_refused(flag: str) -> None:
    with pytest.raises(ConfigError, match="expected --live beside it"):
        read(flag)


def test_a_kept_token_is_written_once_for_this_user_alone(tmp_path: Path) -> None:
    path = tmp_path / "token"
    assert kept_token(path) == kept_token(path)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_a_token_that_others_may_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "token"
    kept_token(path)
    path.chmod(0o640)
    with pytest.raises(LiveError, match="nobody else may read"):
        kept_token(path)


def test_a_link_a_folder_and_a_short_token_are_refused(tmp_path: Path) -> None:
    (tmp_path / "there").write_text("x" * 30)
    (tmp_path / "link").symlink_to(tmp_path / "there")
    short = tmp_path / "short"
    short.touch(0o600)
    for path in (tmp_path / "link", tmp_path, short, tmp_path / "missing" / "token"):
        with pytest.raises(LiveError, match="--live-token"):
            kept_token(path)


@pytest.mark.parametrize(
    ("address", "shown"),
    [
        ("127.0.0.1", "127.0.0.1"),
        ("0.0.0.0", "127.0.0.1"),
        ("::1", "[::1]"),
        ("::", "[::1]"),  # asyncio listens there for IPv6 alone
        ("fd00::7", "[fd00::7]"),
        ("robot.local", "robot.local"),
    ],
)
def test_the_printed_address_is_one_that_a_browser_of_this_machine_can_open(address: str, shown: str) -> None:
    assert LiveOptions(address).url(8765, "t") == f"http://{shown}:8765/?token=t"


def test_other_computers_get_an_address_of_their_own_where_every_interface_listens(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = LiveOptions("0.0.0.0").url_elsewhere(8765, "t")
    assert found is not None and found.endswith(":8765/?token=t") and "127.0.0.1" not in found
    assert LiveOptions().url_elsewhere(8765, "t") is None

    class NoNetwork(socket.socket):
        def connect(self, address: object) -> None:  # type: ignore[override]
            raise OSError("no network")

    monkeypatch.setattr(options_module.socket, "socket", NoNetwork)
    assert LiveOptions("0.0.0.0").url_elsewhere(8765, "t") == f"http://{socket.gethostname()}:8765/?token=t"


def test_without_a_file_every_run_has_a_new_token() -> None:
    assert LiveOptions().token() != LiveOptions().token()
