"""Old flight logs: all of them together stay bounded, and the newest are never deleted."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from edge.core.cli import EXIT_BAD_INPUT, EXIT_DONE
from edge.flightlog import cleanup
from edge.flightlog.cleanup import KEEP_RUNS, ORDER, clean, main

HUGE = 1 << 60


def log(folder: Path, name: str, size: int, at_s: int) -> Path:
    path = folder / name
    path.write_bytes(b"x" * size)
    os.utime(path, (at_s, at_s))
    return path


@pytest.fixture(autouse=True)
def small_logs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cleanup, "EMPTY_BYTES", 10)


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()} - {ORDER}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for number in range(5):
        log(tmp_path, f"flight-{number}.mcap", 60, 10 * number)
        log(tmp_path, f"flight-{number}.002.mcap", 40, 10 * number + 1)
    return tmp_path


def test_the_oldest_runs_are_deleted_as_a_whole_when_the_limit_is_exceeded(folder: Path) -> None:
    assert clean(folder, 500) == ([], 500)
    assert len(names(folder)) == 10
    deleted, left = clean(folder, 350)
    assert {path.name for path in deleted} == {f"flight-{n}{p}.mcap" for n in (0, 1) for p in ("", ".002")}
    assert left == 300
    assert "flight-2.mcap" in names(folder)


def test_a_run_is_as_old_as_its_newest_part(folder: Path) -> None:
    log(folder, "flight-0.003.mcap", 1, 1000)
    clean(folder, 0)
    assert {"flight-0.mcap", "flight-4.mcap"} <= names(folder)
    assert "flight-3.mcap" not in names(folder)


def test_runs_without_records_do_not_take_the_places_of_the_newest(folder: Path) -> None:
    for number in (7, 8, 9):  # killed while they waited to be armed
        log(folder, f"flight-{number}.mcap", 9, 10 * number)
    clean(folder, 0)
    assert {f"flight-{number}.mcap" for number in (3, 4, 7, 8, 9)} <= names(folder)
    assert "flight-2.mcap" not in names(folder)


def test_a_board_without_a_clock_keeps_its_newest_runs(tmp_path: Path) -> None:
    for name, minutes in (("monday", 180), ("tuesday", 170), ("wednesday", 5)):  # every boot begins at the same date
        log(tmp_path, f"flight-{name}.mcap", 100, 60 * minutes)
        clean(tmp_path, HUGE)
    clean(tmp_path, 0)
    assert names(tmp_path) == {"flight-tuesday.mcap", "flight-wednesday.mcap"}


@pytest.mark.parametrize("content", [b"", b"\xff\xfe", b"flight-9 flight-3\n\0"], ids=["empty", "no text", "foreign"])
def test_a_damaged_order_is_replaced_by_the_times_of_the_files(folder: Path, content: bytes) -> None:
    (folder / ORDER).write_bytes(content)
    clean(folder, 350)
    assert "flight-4.mcap" in names(folder) and (folder / ORDER).read_text().split()[-1] == "flight-4"


def test_an_order_that_cannot_be_written_keeps_nothing_from_being_deleted(folder: Path) -> None:
    (folder / ORDER).mkdir()
    _, left = clean(folder, 0)
    assert left == 100 * KEEP_RUNS


def test_the_newest_runs_stay_at_any_size(folder: Path) -> None:
    _, left = clean(folder, 0)
    assert left == 100 * KEEP_RUNS
    assert names(folder) == {f"flight-{n}{p}.mcap" for n in (3, 4) for p in ("", ".002")}


def test_a_small_old_run_is_not_kept_in_the_place_of_a_large_newer_one(tmp_path: Path) -> None:
    for number, size in enumerate((1, 300, 10, 10)):
        log(tmp_path, f"flight-{number}.mcap", size, number)
    clean(tmp_path, 100)
    assert names(tmp_path) == {"flight-2.mcap", "flight-3.mcap"}


def test_nothing_else_is_touched(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    outside = log(tmp_path_factory.mktemp("outside"), "flight-x.mcap", 5, 0)
    others = {"release.json", "my flight.mcap", "flight.mcap", "flight-a.txt", "flight-a.2.mcap"}
    for name in others:
        log(folder, name, 1000, 0)
    (folder / "flight-b.mcap").mkdir()
    (folder / "flight-c.mcap").symlink_to(outside)
    clean(folder, 0)
    assert others | {"flight-b.mcap", "flight-c.mcap"} <= names(folder)
    assert outside.exists()


def test_on_a_small_file_system_less_is_kept(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(folder)], total_bytes=lambda _path: 1200) == EXIT_DONE
    assert len(names(folder)) == 6
    assert "4 files of old runs deleted" in capsys.readouterr().err
    assert main([str(folder)], total_bytes=lambda _path: HUGE) == EXIT_DONE
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("words", [["none"], [".", "--keep-bytes", "-1"]])
def test_bad_input_is_one_line(words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path / words[0]), *words[1:]]) == EXIT_BAD_INPUT
    assert capsys.readouterr().err.count("\n") == 1
