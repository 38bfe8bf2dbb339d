"""What `edge-hil` refuses before anything is started, and what its help says of addresses."""

from __future__ import annotations

import re
import socket
from pathlib import Path

import pytest

from sim_hil.hil import command as hil
from sim_hil.hil import display
from sim_hil.hil.arguments import EPILOG
from sim_hil.hil.display import DisplayError, check_display
from sim_hil.protocols.can.front_end import LinkOptions as CanLink
from sim_hil.protocols.mavlink.front_end import LinkOptions as MavlinkLink

SPOKEN = {"unitree": "go2", "mavlink": "carter", "can": "carter"}


def refusal(capsys: pytest.CaptureFixture[str], protocol: str, *arguments: str) -> str:
    """The one line with which the command ends."""
    assert hil.main(["--robot", SPOKEN[protocol], "--scene", "corridor", "--protocol", protocol, *arguments]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


@pytest.fixture(autouse=True)
def nothing_is_started(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hil, "Simulation", None)


@pytest.mark.parametrize("name", [None, "", ":1234", "127.0.0.1:1234", "nonsense", ":", "/no/such/socket:0"])
def test_a_missing_display_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str | None
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    if name is not None:
        monkeypatch.setenv("DISPLAY", name)
    assert "--gui" in refusal(capsys, "unitree", "--gui")


@pytest.mark.parametrize("name", [":7", "unix:7.0", "unix/host:7"])
def test_a_display_of_this_machine_is_reached_by_its_socket(tmp_path: Path, name: str) -> None:
    with pytest.raises(DisplayError, match=f"DISPLAY={name}"):
        check_display(name, str(tmp_path))
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "X7"))
        server.listen()
        check_display(name, str(tmp_path))


def test_a_socket_without_a_server_is_no_display(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "X7"))
    assert (tmp_path / "X7").exists()
    with pytest.raises(DisplayError, match="expected an X server, found none"):
        check_display(":7", str(tmp_path))


def test_a_display_of_another_host_is_reached_over_tcp(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        monkeypatch.setattr(display, "FIRST_PORT", server.getsockname()[1] - 10)
        check_display("127.0.0.1:10.0")


@pytest.mark.parametrize(
    ("protocol", "flag", "value", "instead"),
    [
        ("can", "--domain", "0", "--link"),
        ("can", "--interface", "lo", "--link"),
        ("mavlink", "--domain", "3", "--link"),
        ("mavlink", "--interface", "eth0", "--link"),
        ("unitree", "--link", "udp:1", "--domain and --interface"),
    ],
)
def test_an_option_of_another_protocol_is_refused(
    capsys: pytest.CaptureFixture[str], protocol: str, flag: str, value: str, instead: str
) -> None:
    error = refusal(capsys, protocol, flag, value)
    assert f"{flag}: expected only with --protocol" in error and f"for {protocol} use {instead} instead" in error


@pytest.mark.parametrize("rate", ["0", "501"])
def test_a_rate_of_poses_that_physics_does_not_have_is_refused(capsys: pytest.CaptureFixture[str], rate: str) -> None:
    assert "--pose-hz" in refusal(capsys, "can", "--pose-hz", rate)


def test_every_address_in_the_help_is_valid_for_its_protocol() -> None:
    examples = re.findall(r"--protocol (can|mavlink) --link (\S+)", EPILOG)
    assert {protocol for protocol, _ in examples} == {"can", "mavlink"}
    for protocol, link in examples:
        {"can": CanLink, "mavlink": MavlinkLink}[protocol].parse(link)
