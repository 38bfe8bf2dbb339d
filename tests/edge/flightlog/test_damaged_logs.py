"""Damaged flight logs: what is whole is read, and each command says in one line from when on records are missing."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from edge.core.cli import EXIT_BAD_INPUT, EXIT_DONE
from edge.flightlog.explain import command, video
from edge.flightlog.part import LogPart, PartFile
from edge.flightlog.reader import Damage, read_messages
from edge.flightlog.replay import command as replay
from edge.flightlog.replay.policy import Comparison
from tests.edge.flightlog.test_log_schemas import SAMPLES
from tests.support.runner import synthetic_run
from tests.support.runner.explained_flights import at
from tools.report import explain_page

ZSTD = b"\x28\xb5\x2f\xfd"
"""First bytes of a chunk's data."""
LENGTH_BEFORE = 48
"""Bytes from the length of a chunk's record to the chunk's data."""
Change = Callable[[bytearray, int], None]
"""Damages the bytes of a log, whose middle chunk's data begins at an offset."""


def flip(data: bytearray, offset: int) -> None:
    data[offset] ^= 0x40


def cut(data: bytearray, offset: int) -> None:
    del data[offset + 10 :]


def in_chunk(data: bytearray, chunk: int) -> None:
    flip(data, chunk + 10)


def in_length(data: bytearray, chunk: int) -> None:
    flip(data, chunk - LENGTH_BEFORE + 2)


def write(path: Path, change: Change) -> Path:
    """Write a log of 3 chunks, each with a tick and a picture, and change its bytes."""
    part = LogPart(PartFile(path, new=False), 1)
    part.add("/run", at(0.0), SAMPLES["/run"])
    for second in range(3):
        part.add("/tick", at(second), {**SAMPLES["/tick"], "tick": second, "now_ns": at(second)})
        part.add("/camera", at(second), synthetic_run.jpeg(second))
        part.flush()
    part.finish()
    part.file.close()
    data = bytearray(path.read_bytes())
    change(data, data.index(ZSTD, data.index(ZSTD) + 1))
    path.write_bytes(data)
    return path


@pytest.mark.parametrize(
    ("change", "ticks", "ends"),
    [(in_chunk, [0, 2], [False]), (in_length, [0], [True]), (cut, [0], [])],
    ids=["in a chunk", "in a length", "killed while writing"],
)
def test_wrong_bytes_are_damage_and_a_missing_end_is_none(
    change: Change, ticks: list[int], ends: list[bool], tmp_path: Path
) -> None:
    path, damages = write(tmp_path / "flight.mcap", change), list[Damage]()
    found = [payload["tick"] for topic, _, payload in read_messages(path, damages) if topic == "/tick"]
    assert found == ticks
    assert [(each.path, each.after_ns, each.ends) for each in damages] == [(path, at(0.0), end) for end in ends]


def test_a_part_without_its_end_before_another_part_is_damaged(tmp_path: Path) -> None:
    path, damages = write(tmp_path / "flight.mcap", cut), list[Damage]()
    write(tmp_path / "flight.002.mcap", lambda *_: None)
    assert len([topic for topic, *_ in read_messages(path, damages) if topic == "/tick"]) == 1 + 3
    assert [(each.path, each.ends) for each in damages] == [(path, True)]


Damaged = Callable[[Path, Path], int]


def explained(log: Path, out: Path) -> int:
    return command.main([str(log), "--json", str(out)])


def replayed(log: Path, out: Path) -> int:
    replay.main([str(log), "--artifacts", "x", "--json", str(out)])
    return EXIT_DONE  # nothing is compared here


def filmed(log: Path, _out: Path) -> int:
    return video.main([str(log), "--out", str(log.with_name("film.mp4"))])


@pytest.fixture
def nothing_runs_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let `edge-replay` read a log without artifacts."""
    monkeypatch.setattr(replay, "_open", lambda *_: (None, True))
    monkeypatch.setattr(replay, "open_proven", lambda _: SimpleNamespace(policy=None, language=None))
    replayer = SimpleNamespace(step=lambda _: None, comparison=Comparison())
    monkeypatch.setattr(replay, "Replayer", lambda *_, **__: replayer)


@pytest.mark.usefixtures("nothing_runs_again")
@pytest.mark.parametrize("main", [explained, filmed, replayed])
@pytest.mark.parametrize(
    ("change", "lost"),
    [(in_chunk, "some of the later records are missing"), (in_length, "the rest was not read"), (cut, "")],
)
def test_a_command_tells_of_damage_once(
    main: Damaged, change: Change, lost: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = write(tmp_path / "flight.mcap", change)
    assert main(log, tmp_path / "result.json") == EXIT_DONE
    told = [line for line in capsys.readouterr().err.splitlines() if "damaged" in line]
    assert len(told) == (1 if lost else 0)
    assert all(f"{log}: damaged after 0.0 s (" in line and line.endswith(f"; {lost}") for line in told)


@pytest.mark.usefixtures("nothing_runs_again")
@pytest.mark.parametrize("main", [explained, replayed])
@pytest.mark.parametrize(("change", "damaged"), [(in_chunk, True), (cut, False)])
def test_a_result_names_the_damage_and_none_of_a_whole_log(
    main: Damaged, change: Change, damaged: bool, tmp_path: Path
) -> None:
    log, out = write(tmp_path / "flight.mcap", change), tmp_path / "result.json"
    main(log, out)
    damage = json.loads(out.read_text())["damage"]
    assert (f"{log}: damaged after 0.0 s" in damage) if damaged else damage is None


def test_the_page_names_the_damage(tmp_path: Path) -> None:
    log, page = write(tmp_path / "flight.mcap", in_chunk), tmp_path / "why.html"
    assert explain_page.main([str(log), "--page", str(page)]) == EXIT_DONE
    assert f"{log}: damaged after 0.0 s" in page.read_text()


@pytest.mark.parametrize(
    ("name", "found"), [("absent.mcap", "no such file"), ("", "a folder")], ids=["no file", "folder"]
)
@pytest.mark.parametrize(
    ("main", "options"),
    [(command.main, []), (video.main, ["--out", "x.mp4"]), (replay.main, ["--artifacts", "x"])],
    ids=["explain", "video", "replay"],
)
def test_a_file_that_is_none_is_named_with_what_was_expected(
    main: Any, options: list[str], name: str, found: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / name
    assert main([str(log), *options]) == EXIT_BAD_INPUT
    assert f"{log}: cannot be read: expected a flight log (.mcap), found: {found}\n" in capsys.readouterr().err
