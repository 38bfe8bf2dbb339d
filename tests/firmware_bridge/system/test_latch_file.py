"""The file that keeps an emergency stop: its existence is the latch, and nothing waits for the disk."""

from __future__ import annotations

import errno
import os
import threading
import time
from pathlib import Path

import pytest

from firmware_bridge.system.latch_file import LatchFile, read_latch
from tests.support.processes import wait_for


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "bridge.sock.latch"


def kept(path: Path, *reasons: str) -> list[str]:
    """Keep each reason in turn; the lines for the operator."""
    lines: list[str] = []
    file = LatchFile(path, lines.append)
    for reason in reasons:
        file.keep(reason, 0)
    file.close(5)
    return lines


def test_without_a_file_nothing_is_latched(path: Path) -> None:
    assert read_latch(path) == "" and read_latch(path / "of a missing folder") == ""


def test_the_reason_survives_the_process(path: Path) -> None:
    assert kept(path, "emergency stop by an operator") == []
    assert read_latch(path) == "emergency stop by an operator"
    assert kept(path, "") == []
    assert not path.exists()


@pytest.mark.parametrize("content", [b"", b"\0" * 400, b"\xff\xfe\x00junk", b"\n\n", b"x" * 10_000])
def test_a_file_with_any_content_is_a_latch_with_a_printable_reason(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    reason = read_latch(path)
    assert reason and reason.isprintable() and len(reason) <= 400


@pytest.mark.parametrize("make", [Path.mkdir, os.mkfifo, lambda path: path.symlink_to(path)])
def test_an_unreadable_file_is_a_latch_and_is_left_alone(path: Path, make) -> None:
    make(path)
    assert "reason unreadable" in read_latch(path)
    (line,) = kept(path, "")
    assert "cannot be removed" in line and path.is_symlink() | path.exists()


def test_a_device_node_is_a_latch() -> None:
    assert "not a regular file" in read_latch(Path("/dev/null"))


def test_a_folder_that_cannot_be_written_is_reported_in_one_line(path: Path) -> None:
    (line,) = kept(path / "missing folder" / "latch", "emergency stop by an operator")
    assert "cannot be written" in line and "may not survive a restart" in line and "\n" not in line


def test_a_full_disk_is_reported_in_one_line_and_the_latch_still_holds(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "write", full)
    (line,) = kept(path, "emergency stop by an operator")
    assert "No space left on device" in line
    assert read_latch(path) == "emergency stop of an earlier bridge"


def test_a_disk_that_hangs_delays_neither_the_caller_nor_the_latch(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A bridge that is killed while its disk still works on the reason has left a latch."""
    hangs = threading.Event()
    monkeypatch.setattr(os, "fsync", lambda _: hangs.wait(20))
    file = LatchFile(path, lambda _: None)
    since_s = time.monotonic()
    file.keep("emergency stop by an operator", 0)
    assert time.monotonic() - since_s < 0.5
    wait_for(lambda: read_latch(path) == "emergency stop by an operator", 5, "the latch")
    hangs.set()
    file.close(5)


def test_it_counts_as_kept_once_a_kill_would_leave_it(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opens, real = threading.Event(), os.open
    monkeypatch.setattr(os, "open", lambda *given: (opens.wait(20), real(*given))[1])
    file = LatchFile(path, lambda _: None)
    assert file.keep("", 0)
    assert not file.keep("emergency stop by an operator", 1000)
    assert not path.exists()
    opens.set()
    wait_for(lambda: file.keep("emergency stop by an operator", 1000), 5, "the latch")
    assert path.exists()
    file.close(5)


def test_a_disk_that_hangs_does_not_delay_the_report_of_a_stop(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    hangs, real = threading.Event(), os.open
    file = LatchFile(path, lambda _: None)
    monkeypatch.setattr(os, "open", lambda *given: (hangs.wait(20), real(*given))[1])
    assert not file.keep("emergency stop by an operator", 10**9)
    assert not file.keep("emergency stop by an operator", 10**9 + 200_000_000)
    assert file.keep("emergency stop by an operator", 10**9 + 200_000_001) and file.is_late
    monkeypatch.undo()
    hangs.set()
    wait_for(lambda: not file.is_late, 5, "the latch")
    file.close(5)
