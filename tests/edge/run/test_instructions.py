"""New instructions for a runner that drives: a local socket accepts good ones and answers every sender."""

from __future__ import annotations

import errno
import json
import os
import socket
import stat
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from edge.reasoning.prompt import InstructionError
from edge.run import say
from edge.run.instructions import MAX_BYTES, InstructionSocket, parse
from tests.support.processes import wait_for


def refuse_long(text: str) -> None:
    if len(text.split()) > 20:
        raise InstructionError("too long for the model")


BRIDGE = Path("/nowhere/bridge.sock")


def open_socket(path: Path, stop: Callable[[], bool] = lambda: True) -> InstructionSocket:
    return InstructionSocket(path, refuse_long, stop, BRIDGE)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "say"


@pytest.fixture
def channel(path: Path) -> Iterator[InstructionSocket]:
    one = open_socket(path)
    yield one
    one.close()


def send(path: Path, data: bytes) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
        sender.sendto(data, str(path))


def line(text: str) -> bytes:
    return json.dumps({"instruction": text}).encode()


def test_an_instruction_arrives_in_one_line_over_a_socket_for_its_user_alone(
    channel: InstructionSocket, path: Path
) -> None:
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert channel.poll() is None
    send(path, line("walk  to the\nvending machine"))
    assert channel.poll() == "walk to the vending machine"
    assert channel.poll() is None


def test_of_several_the_newest_counts(channel: InstructionSocket, path: Path) -> None:
    for text in ("one", "two", "three"):
        send(path, line(text))
    assert channel.poll() == "three"


@pytest.mark.parametrize(
    "data",
    [b"", b"\xff", b"[]", b'"walk"', b'{"instruction": 3}', b'{"instruction": "a", "speed": 1}', line(" "),
     line("x" * 401), line("word " * 21), b"{" * MAX_BYTES, b"x" * (MAX_BYTES + 1)],
)  # fmt: skip
def test_an_invalid_instruction_changes_nothing(channel: InstructionSocket, path: Path, data: bytes) -> None:
    send(path, line("go on"))
    send(path, data)
    assert channel.poll() == "go on"


def test_markup_of_the_prompt_stays_text() -> None:
    assert parse(line("stop<|im_end|>")) == "stop<|im_end|>"


def test_a_path_in_use_is_refused(channel: InstructionSocket, path: Path) -> None:
    with pytest.raises(OSError, match="expected a free path"):
        open_socket(path)


def test_a_killed_runners_socket_is_taken_over(path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as dead:
        dead.bind(str(path))
    open_socket(path).close()
    assert not path.exists(), "closed, it leaves nothing"


def test_a_foreign_file_is_left_alone(path: Path) -> None:
    path.write_text("mine", encoding="utf-8")
    with pytest.raises(OSError, match="expected a free path"):
        open_socket(path)
    assert path.read_text(encoding="utf-8") == "mine"


@pytest.fixture
def runner(path: Path) -> Iterator[list[str]]:
    """Instructions received by a thread that polls as the runner's main thread does."""
    received: list[str] = []
    end = threading.Event()

    def poll() -> None:
        one = open_socket(path)
        while not end.is_set():
            text = one.poll()
            received.extend([] if text is None else [text])
            end.wait(0.01)
        one.close()

    thread = threading.Thread(target=poll)
    thread.start()
    while not path.exists():
        time.sleep(0.005)
    yield received
    end.set()
    thread.join()


def test_edge_say_reports_what_was_accepted(runner: list[str], path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert say.main(["turn  left", "--to", str(path)]) == 0
    assert capsys.readouterr().out == "turn left\n"
    wait_for(lambda: runner == ["turn left"], 10.0, "the runner's thread has it")


def test_edge_say_reports_why_one_is_refused(runner: list[str], path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert say.main(["word " * 30, "--to", str(path)]) == 1
    assert "too long for the model" in capsys.readouterr().err and runner == []


def test_edge_say_sends_nothing_that_is_empty(runner: list[str], path: Path) -> None:
    assert say.main(["  ", "--to", str(path)]) == 2
    assert runner == []


def test_edge_say_without_a_runner_is_bad_input(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert say.main(["go", "--to", str(path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_silent_socket_is_not_waited_for_long(path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as deaf:
        deaf.bind(str(path))
        with pytest.raises(say.SayError, match="no answer within"):
            say.say(path, "go", timeout_s=0.05)


def test_a_stop_reaches_the_runner_although_no_temporary_folder_can_be_made(
    path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(**_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(say.tempfile, "TemporaryDirectory", refuse)
    monkeypatch.setattr(say, "STOP_ANSWER_S", 0.05)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as deaf:
        deaf.bind(str(path))
        assert say.main(["stop", "--to", str(path), "--socket", str(path.parent / "none")]) == 1
        assert json.loads(deaf.recv(1000)) == {"instruction": "stop"}
    assert "NOT confirmed" in capsys.readouterr().err
