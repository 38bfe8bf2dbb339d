"""Progress: on standard error, redrawn on a terminal, lines elsewhere; a build's remaining time."""

from __future__ import annotations

import io

import pytest

from reporting import progress as module
from reporting.progress import BuildProgress, Progress, Stage, duration

STAGES = [Stage("weights", 10.0), Stage("graph", 30.0), Stage("gate", 20.0)]


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    now = [0]
    monkeypatch.setattr(module.time, "monotonic_ns", lambda: now[0])
    return now


def after(clock: list[int], seconds: float) -> None:
    clock[0] += int(seconds * 1e9)


def test_every_stage_gets_a_line_when_it_begins_and_one_when_it_is_done(clock: list[int]) -> None:
    out = io.StringIO()
    with BuildProgress("edge-export", STAGES, out) as progress:
        for stage in STAGES:
            with progress.stage(stage.name):
                after(clock, 1)
    lines = out.getvalue().splitlines()
    assert len(lines) == 6
    assert lines[2].startswith("edge-export: [2/3] graph · 1 s so far, ")
    assert "to go · peak " in lines[2]
    assert lines[3] == "edge-export: [2/3] graph: done, 1.0 s"


def test_a_long_stage_reports_its_progress_now_and_then(clock: list[int]) -> None:
    out = io.StringIO()
    with BuildProgress("edge-export", STAGES, out) as progress, progress.stage("graph"):
        for step in range(60):
            after(clock, 1)
            progress.detail(f"step {step}")
    details = [line for line in out.getvalue().splitlines() if "step" in line]
    assert [line.rpartition(" · ")[2] for line in details] == ["step 14", "step 29", "step 44", "step 59"]


def test_nothing_is_written_to_standard_output(capsys: pytest.CaptureFixture[str]) -> None:
    with BuildProgress("edge-export", STAGES) as progress, progress.stage("weights"):
        progress.log("a note")
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "edge-export: a note" in captured.err


def test_the_remaining_time_follows_the_measured_speed(clock: list[int]) -> None:
    with BuildProgress("x", STAGES, io.StringIO()) as progress:
        with progress.stage("weights"):
            after(clock, 20)  # twice what was expected
        with progress.stage("graph"):
            after(clock, 15)
            assert progress.remaining_s() == pytest.approx(45 + 40)


def test_a_cached_stage_does_not_change_the_measured_speed(clock: list[int]) -> None:
    with BuildProgress("x", STAGES, io.StringIO()) as progress:
        with progress.stage("weights") as watch:
            watch.from_cache()
        with progress.stage("graph"):
            assert progress.remaining_s() == 50.0
        assert progress.built_s == {"graph": 0.0}


def test_the_remaining_time_begins_with_the_expected_one_and_is_never_negative(clock: list[int]) -> None:
    with BuildProgress("x", STAGES, io.StringIO()) as progress:
        assert progress.remaining_s() == 60.0
        with progress.stage("gate"):
            after(clock, 1000)
            assert progress.remaining_s() == 0.0


@pytest.mark.parametrize(("seconds", "shown"), [(7.6, "8 s"), (125, "2 min 05 s"), (3720, "1 h 02 min")])
def test_durations_are_readable(seconds: float, shown: str) -> None:
    assert duration(seconds) == shown


def test_text_in_brackets_and_colons_is_printed_as_it_is() -> None:
    out = io.StringIO()
    Progress("x: ", stream=out).log("found [1, 30, 3] in [bold]name[/bold] :smile:")
    assert out.getvalue() == "x: found [1, 30, 3] in [bold]name[/bold] :smile:\n"


def test_elsewhere_than_on_a_terminal_a_status_is_a_line_a_few_times_a_minute(clock: list[int]) -> None:
    out = io.StringIO()
    with Progress("x: ", lambda: f"{clock[0] / 1e9:.0f} s", stream=out) as progress:
        for _ in range(61):
            progress.tick()
            after(clock, 1)
    assert out.getvalue().splitlines() == ["x: 0 s", "x: 15 s", "x: 30 s", "x: 45 s", "x: 60 s"]


def test_the_end_of_every_part_is_a_line_with_its_rate(clock: list[int]) -> None:
    out = io.StringIO()
    with Progress("x: ", bar=True, period_s=1e9, stream=out) as progress:
        for done in (1, 2, 3, 4, 4, 4):
            progress.show("loss 0.5", done, 4)
            after(clock, 0.5)
        progress.show("", 1, 9)
        after(clock, 2)
        progress.show("", 9, 9)
    assert out.getvalue().splitlines() == ["x: 4 of 4 (2 /s), loss 0.5", "x: 9 of 9 (4 /s)"]


def test_a_line_names_the_remaining_time(clock: list[int]) -> None:
    out = io.StringIO()
    with Progress("x: ", bar=True, period_s=10.0, stream=out) as progress:
        progress.show("", 0, 100)
        after(clock, 10)
        progress.show("", 20, 100)
    assert out.getvalue() == "x: 20 of 100 (2 /s, 40 s to go)\n"


def test_without_a_period_only_lines_are_printed() -> None:
    out = io.StringIO()
    with Progress("", bar=True, period_s=None, stream=out) as progress:
        progress.show("a status", 1, 1)
        progress.log("a line")
    assert out.getvalue() == "a line\n"


def test_a_terminal_shows_the_status_and_lines_above_it() -> None:
    out = Terminal()
    with BuildProgress("edge-export", STAGES, out) as build, build.stage("graph"):
        build.log("a note")
    assert "edge-export: a note\n" in out.getvalue() and "[2/3] graph" in out.getvalue()


def test_a_terminal_shows_one_bar_for_all_parts() -> None:
    out = Terminal()
    with Progress("x: ", bar=True, stream=out) as progress:
        progress.show("loss 0.5", 1, 4)
        progress.log("a line")
        progress.show("", 9, 9)
    assert "x: a line\n" in out.getvalue() and "9/9" in out.getvalue()
