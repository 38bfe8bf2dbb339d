"""Stalls of a shared machine: what the watching process writes, and how long a window was stalled."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_hil.realtime import host_stall
from sim_hil.realtime.host_stall import HostStall, read_stalls, stalled_ns, watch_sleeps
from tests.support.processes import wait_for

times = st.integers(0, 1000)


def write(path: Path, stalls: list[tuple[int, int]], real_time: tuple[bool, ...] = (True, True)) -> Path:
    lines: list[dict[str, Any]] = [{"cpu": cpu, "real_time": one} for cpu, one in enumerate(real_time)]
    lines += [{"cpu": 0, "due_ns": due, "woken_ns": woken} for due, woken in stalls]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return path


class TestFile:
    def test_overlapping_stalls_of_two_processors_are_one(self, tmp_path: Path) -> None:
        found = read_stalls(write(tmp_path / "stalls.jsonl", [(50, 60), (10, 30), (20, 35), (35, 40)]))
        assert found is not None and found.tolist() == [[10, 40], [50, 60]]

    @pytest.mark.parametrize("real_time", [(False, False), (True, False), ()])
    def test_without_a_real_time_priority_late_sleeps_show_nothing(
        self, real_time: tuple[bool, ...], tmp_path: Path
    ) -> None:
        """Any program may then have delayed the process."""
        assert read_stalls(write(tmp_path / "stalls.jsonl", [(10, 30)], real_time)) is None

    def test_no_file_is_no_measurement(self, tmp_path: Path) -> None:
        assert read_stalls(tmp_path / "stalls.jsonl") is None

    def test_an_unfinished_line_is_left_out(self, tmp_path: Path) -> None:
        path = write(tmp_path / "stalls.jsonl", [(10, 30)])
        with path.open("a") as file:
            file.write('{"cpu": 1, "due_')
        found = read_stalls(path)
        assert found is not None and found.tolist() == [[10, 30]]


def test_a_sleep_that_ends_5_ms_late_is_a_stall(monkeypatch: pytest.MonkeyPatch) -> None:
    late_ns = iter((0, 4_900_000, 5_100_000, 0))
    clock = SimpleNamespace(now_ns=0)

    def sleep(seconds: float) -> None:
        clock.now_ns += round(seconds * 1e9) + next(late_ns)

    monkeypatch.setattr(host_stall, "time", SimpleNamespace(monotonic_ns=lambda: clock.now_ns, sleep=sleep))
    found: list[tuple[int, int]] = []
    left = iter((False, False, False, False, True))
    watch_sleeps(lambda: next(left), lambda due_ns, woken_ns: found.append((due_ns, woken_ns)), sleep_s=0.001)
    assert found == [(7_900_000, 13_000_000)]


@pytest.mark.process
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_process_says_for_each_processor_whether_it_has_its_priority(
    number: signal.Signals, tmp_path: Path
) -> None:
    path = tmp_path / "stalls.jsonl"
    process = subprocess.Popen([sys.executable, "-m", "sim_hil.realtime.host_stall", str(path)])
    cpus = sorted(os.sched_getaffinity(process.pid))
    try:
        wait_for(lambda: path.exists() and len(path.read_text().splitlines()) >= len(cpus), 20.0, "its lines")
        process.send_signal(number)
        assert process.wait(10.0) == 0
    finally:
        process.kill()
        process.wait()
    begins = [line for line in map(json.loads, path.read_text().splitlines()) if "real_time" in line]
    assert sorted(line["cpu"] for line in begins) == cpus and not any(line["real_time"] for line in begins)


@given(st.lists(st.tuples(times, times).map(sorted), max_size=8), times, times)
def test_a_window_is_stalled_as_long_as_a_sum_over_its_stalls(spans: list[list[int]], a: int, b: int) -> None:
    begin, end = sorted((a, b))
    ticks = np.zeros(1001, bool)
    for due, woken in spans:
        ticks[due:woken] = True
    edges = np.flatnonzero(np.diff(np.concatenate(([False], ticks, [False])).astype(int)))
    apart = edges.reshape(-1, 2).astype(np.int64)
    assert stalled_ns(apart, np.array([begin]), np.array([end])).tolist() == [int(ticks[begin:end].sum())]


def test_a_harness_sums_the_stalls_inside_a_window() -> None:
    host = HostStall()
    host.add(10, 30)
    host.add(50, 60)
    assert host.between_ns(20, 55) == 15


def test_a_harness_counts_the_time_once_in_which_two_processors_stalled() -> None:
    host = HostStall()
    host.add(10, 30)
    host.add(15, 40)
    assert host.between_ns(0, 100) == 30


def test_a_harness_watches_on_each_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stall of one processor holds what runs there, and a sleep that moves to the other one ends in time."""
    watched: list[set[int]] = []
    monkeypatch.setattr(host_stall, "watch_sleeps", lambda *_: watched.append(os.sched_getaffinity(0)))
    with HostStall():
        pass
    assert sorted(watched, key=min) == [{cpu} for cpu in sorted(os.sched_getaffinity(0))]
