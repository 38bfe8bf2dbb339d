"""Flight recorder: nothing before the run begins, nobody else's file, no part while the disk is nearly full."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from edge.flightlog.reader import parts
from edge.flightlog.recorder import Recorder, RecorderLimits
from edge.run.result import close_log
from tests.edge.flightlog.test_recorder import ticks, wait_for

SECOND_NS = 1_000_000_000
FIVE_MINUTES_NS = 300 * SECOND_NS


class Disk:
    """A clock that moves in steps, and a disk with 1,000 bytes."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_ns, self.free, self.looks = 0, 1_000, 0
        monkeypatch.setattr("edge.flightlog.recorder.time", SimpleNamespace(monotonic_ns=lambda: self.now_ns))
        monkeypatch.setattr("edge.flightlog.recorder._free", self._look)

    def _look(self, _path: Path) -> tuple[int, int]:
        self.looks += 1
        return self.free, 1_000

    def pass_time(self, step_ns: int, free: int) -> None:
        """Let that much time pass, with that much free space, and again until the writer has acted on it."""
        self.free, looks = free, self.looks

        def has_acted() -> bool:
            if self.looks >= looks + 2:  # at the second look it has acted on the first
                return True
            self.now_ns += step_ns
            return False

        assert wait_for(has_acted, 20)


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Iterator[Disk]:
    yield Disk(monkeypatch)


def test_a_recording_begins_with_its_run_however_long_the_robot_waits(tmp_path: Path, disk: Disk) -> None:
    path = tmp_path / "flight.mcap"
    recorder = Recorder(path, RecorderLimits(free_bytes=200), from_run=True)
    for _ in range(3):
        recorder.put("/power", 1, {"power_w": 9.0})
        disk.pass_time(FIVE_MINUTES_NS, free=1_000)
    disk.pass_time(SECOND_NS, free=1_000)
    recorder.put("/run", 2, {"instruction": "go"})
    recorder.put("/tick", 3, {"tick": 0})
    assert recorder.close() and recorder.dropped == {}
    assert parts(path) == [path] and ticks(path) == [0]


def test_while_it_is_paused_no_part_is_made_that_a_full_disk_could_not_take(
    tmp_path: Path, disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **_named: object) -> None:
        raise OSError(28, "No space left on device")

    path, said = tmp_path / "flight.mcap", []
    recorder = Recorder(path, RecorderLimits(free_bytes=200), say=said.append)
    recorder.put("/tick", 1, {"tick": 0})
    assert wait_for(lambda: not recorder._queue)
    disk.pass_time(SECOND_NS, free=0)
    with monkeypatch.context() as full:
        full.setattr("edge.flightlog.recorder.PartFile", refuse)
        recorder.put("/tick", 2, {"tick": 1})
        disk.pass_time(FIVE_MINUTES_NS, free=0)
        disk.pass_time(SECOND_NS, free=0)
        disk.pass_time(SECOND_NS, free=1_000)
    assert recorder.error is None
    recorder.put("/tick", 3, {"tick": 2})
    assert ticks(path) == [0] and parts(path) == [path]
    line = close_log(recorder, None, began=True, left_s=5.0)
    assert [("is paused" in each, each.endswith("goes on")) for each in said] == [(True, False), (False, True)]
    assert line == "the flight log lacks 1 records: its disk was nearly full; delete old logs"


def test_a_log_that_another_runner_began_meanwhile_is_neither_emptied_nor_deleted(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    first = Recorder(path)
    first.put("/tick", 1, {"tick": 0})
    second = Recorder(path)
    assert "File exists" in (second.error or "")
    assert close_log(second, None, began=False, left_s=5.0) is None
    assert first.close() and ticks(path) == [0]


def test_a_log_that_another_runner_began_under_a_removed_name_is_not_deleted(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    waits = Recorder(path)
    path.unlink()
    drives = Recorder(path)
    drives.put("/tick", 1, {"tick": 0})
    close_log(waits, None, began=False, left_s=5.0)
    assert drives.close() and ticks(path) == [0]


def test_a_link_leads_to_the_log_that_is_made(tmp_path: Path) -> None:
    (tmp_path / "latest.mcap").symlink_to(tmp_path / "flight.mcap")
    recorder = Recorder(tmp_path / "latest.mcap")
    recorder.put("/tick", 1, {"tick": 0})
    assert recorder.close() and ticks(tmp_path / "flight.mcap") == [0]


def test_a_device_can_be_recorded_to_and_is_never_deleted(monkeypatch: pytest.MonkeyPatch) -> None:
    removed: list[Path] = []
    monkeypatch.setattr(Path, "unlink", lambda path, **_: removed.append(path))
    recorder = Recorder("/dev/null")
    recorder.put("/tick", 1, {"tick": 0})
    assert recorder.close()
    recorder.discard()
    assert not removed
