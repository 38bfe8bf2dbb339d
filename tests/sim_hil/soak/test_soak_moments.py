"""Pictures of a leg's remarkable moments, from the flight logs of its runs and all their parts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from edge.flightlog.part import LogPart, PartFile
from sim_hil.soak import analysis
from tests.support.runner import synthetic_run
from tests.support.runner.explained_flights import at


def write(path: Path, seconds: list[float], number: int) -> None:
    part = LogPart(PartFile(path, new=False), number)
    for second in seconds:
        part.add("/camera", at(second), synthetic_run.jpeg(second))
    part.finish()
    part.file.close()


def test_pictures_around_each_moment_come_from_every_part_which_is_read_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tenths = [k / 10 for k in range(200)]
    write(tmp_path / "flight-1.mcap", tenths[:100], 1)
    write(tmp_path / "flight-1.002.mcap", tenths[100:], 2)
    read: list[Path] = []

    def counted(path: Path) -> Any:
        read.append(path)
        return read_messages(path)

    read_messages = analysis.read_messages
    monkeypatch.setattr(analysis, "read_messages", counted)
    lives = [{"tick_ns": [at(5.0)], "tick_ms": [80.0]}]
    measured = {"lives": lives, "life_ends": [], "contacts": [], "nearest_person": (at(15.0), 0.8)}
    analysis.keep_moments(tmp_path, measured)
    moments = analysis.read_moments(tmp_path)
    assert [moment.kind for moment in moments] == ["worst tick", "nearest person"]
    assert all((tmp_path / moment.gif).stat().st_size > 1000 for moment in moments)
    assert read == [tmp_path / "flight-1.mcap"]
