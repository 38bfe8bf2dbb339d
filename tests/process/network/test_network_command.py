"""The network shim's command: the file it reads, what it is told while it runs, and its exit codes."""

from __future__ import annotations

import json
import re
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from sim_hil.network.__main__ import main
from sim_hil.network.config import NetworkError, load_network, parse_network
from sim_hil.network.impairment import Impairment
from sim_hil.network.relay import Relay
from tests.support.processes import REPOSITORY

pytestmark = pytest.mark.process

UDP = '[[links]]\nname = "l"\nkind = "udp"\nleft = "127.0.0.1:0"\nright = "127.0.0.1:9"\n'
FRAMES = '[[links]]\nname = "l"\nkind = "frames"\nleft = "-"\nright = "-"\n'
COMMANDS = ["--left", "true", "--right", "true"]


class TestConfig:
    def test_a_direction_of_its_own_adds_to_what_both_have(self) -> None:
        link = {
            "name": "a", "kind": "udp", "left": "127.0.0.1:1", "right": "127.0.0.1:2",
            "impairment": {"delay_ms": 10}, "back": {"loss_percent": 5, "partitions": [[1, 2]]},
        }  # fmt: skip
        (parsed,) = parse_network({"seed": 3, "links": [link]}).links
        assert parsed.there == Impairment(delay_ms=10)
        assert parsed.back == Impairment(delay_ms=10, loss_percent=5, partitions=((1.0, 2.0),))

    @pytest.mark.parametrize(
        ("text", "complaint"),
        [
            ("seed = 1", "at least one"),
            ("[[links]]", "name"),
            ('[[links]]\nname = "a"\nkind = "smoke"\nleft = "x"\nright = "y"', "kind"),
            ('[[links]]\nname = "a"\nkind = "udp"\nleft = "x"\nright = "y:1"', "HOST:PORT"),
            ('[[links]]\nname = "a"\nkind = "frames"\nleft = "x"', "right"),
            ('[[links]]\nname = "a"\nkind = "frames"\nleft = "x"\nright = "y"\ncolour = 1', "colour"),
            ('[[links]]\nname = "a"\nkind = "frames"\nleft = "x"\nright = "y"\nthere = { lag_ms = 1 }', "lag_ms"),
            (
                '[[links]]\nname = "a"\nkind = "frames"\nleft = "x"\nright = "y"\nback = { partitions = [1] }',
                "pairs|from",
            ),
            ("seed = ", "TOML"),
        ],
    )
    def test_a_file_that_is_wrong_is_one_line(self, tmp_path: Path, text: str, complaint: str) -> None:
        path = tmp_path / "links.toml"
        path.write_text(text)
        with pytest.raises(NetworkError, match=complaint) as error:
            load_network(path)
        assert "\n" not in str(error.value) and str(path) in str(error.value)

    def test_the_command_refuses_it_with_exit_status_2(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        path = tmp_path / "links.toml"
        path.write_text("links = 3")
        assert main(["run", str(path)]) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1


class TestExitCodes:
    @pytest.mark.parametrize(
        ("text", "arguments", "complaint"),
        [
            ("", ["run", "no-such-file"], "expected a readable file"),
            ("x = " + "[" * 5000, ["run", "FILE"], "expected TOML"),
            (UDP.replace('"udp"', "[1]"), ["run", "FILE"], "kind: expected"),
            (UDP.replace("127.0.0.1:0", "a..b:0"), ["run", "FILE"], "."),
            (UDP, ["run", "FILE", "--duration", "nan"], "--duration: expected"),
            (UDP, ["run", "FILE", "--control", "x" * 200], "--control .+: expected .+ too long"),
            (UDP, ["run", "FILE", "--json", "/"], "--json .+: expected"),
            (UDP, ["between", "FILE", *COMMANDS], "exactly one link of kind frames"),
            (FRAMES, ["between", "FILE", "--left", "sh 'x", "--right", "true"], "--left: expected"),
            (FRAMES, ["between", "FILE", "--left", "true", "--right", ""], "--right: expected"),
        ],
    )
    def test_bad_input_is_2_and_one_line(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, arguments: list[str], complaint: str
    ) -> None:
        path = tmp_path / "links.toml"
        path.write_text(text)
        assert main([str(path) if each == "FILE" else each for each in arguments]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert re.search(f"^network: .*{complaint}", line)

    @pytest.mark.parametrize("missing", [True, False])
    def test_who_may_not_make_namespaces_is_told_so(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, missing: bool
    ) -> None:
        path, programs = tmp_path / "links.toml", tmp_path / "bin"
        path.write_text(FRAMES)
        programs.mkdir()
        for name in () if missing else ("unshare", "ip"):
            (programs / name).write_text(f"#!/bin/sh\necho '{name}: Operation not permitted' >&2\nexit 1\n")
            (programs / name).chmod(0o755)
        monkeypatch.setenv("PATH", str(programs))
        assert main(["between", str(path), *COMMANDS]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert ("install util-linux" if missing else "run as root: unshare: Operation not permitted") in line

    def test_a_relay_that_fails_is_1_and_what_it_has_carried_is_written(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        path, result = tmp_path / "links.toml", tmp_path / "r.json"
        path.write_text(UDP)

        def fail(*_: object) -> None:
            raise OSError("gone")

        monkeypatch.setattr(Relay, "turn", fail)
        assert main(["run", str(path), "--json", str(result)]) == 1
        assert capsys.readouterr().err.splitlines()[1:] == ["network: the relay failed: gone"]
        assert json.loads(result.read_text())["links"]["l"]["there"]["packets"] == 0

    @pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 0)])
    def test_an_interrupt_is_130_and_an_end_that_was_asked_for_is_0(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, code: int
    ) -> None:
        path, result = tmp_path / "links.toml", tmp_path / "r.json"
        path.write_text(UDP)
        monkeypatch.setattr(Relay, "turn", lambda *_: signal.raise_signal(number))
        assert main(["run", str(path), "--json", str(result)]) == code
        assert result.exists()


@pytest.mark.slow
def test_the_command_is_told_changes_over_its_socket_and_leaves_nothing_behind(tmp_path: Path) -> None:
    (tmp_path / "l.toml").write_text(
        '[[links]]\nname = "l"\nkind = "udp"\nleft = "127.0.0.1:0"\nright = "127.0.0.1:9"\n'
    )
    control, mine = tmp_path / "c.sock", tmp_path / "me.sock"
    command = [sys.executable, "-m", "sim_hil.network", "run", str(tmp_path / "l.toml"), "--control", str(control)]
    with subprocess.Popen([*command, "--json", str(tmp_path / "r.json")], cwd=REPOSITORY, stderr=subprocess.PIPE) as it:
        assert it.stderr is not None and b"ready" in it.stderr.readline()
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as asker:
            asker.bind(str(mine))
            asker.settimeout(10)
            answers = []
            for line in (b'{"link": "l", "cut": true}', b"nonsense"):
                asker.sendto(line, str(control))
                answers.append(json.loads(asker.recv(1000)))
        it.terminate()
        assert it.wait(10) == 0
    assert answers[0]["links"] == ["l"] and "expected" in answers[1]["error"]
    assert not control.exists()
    assert json.loads((tmp_path / "r.json").read_text())["links"]["l"]["there"]["packets"] == 0
