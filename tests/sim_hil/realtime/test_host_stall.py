"""Stalls of a shared machine: what the watching process writes, and how long a window was stalled."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_hil.realtime.host_stall import HostStall, read_stalls, stalled_ns

times = st.integers(0, 1000)


def write(path: Path, stalls: list[tuple[int, int]], *, real_time: bool = True) -> Path:
    lines = [{"real_time": real_time}, *({"cpu": 0, "due_ns": due, "woken_ns": woken} for due, woken in stalls)]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return path


class TestFile:
    def test_overlapping_stalls_of_two_processors_are_one(self, tmp_path: Path) -> None:
        path = write(tmp_path / "stalls.jsonl", [(50, 60), (10, 30), (20, 35), (35, 40)])
        assert read_stalls(path).tolist() == [[10, 40], [50, 60]]

    def test_without_a_real_time_priority_late_sleeps_show_nothing(self, tmp_path: Path) -> None:
        """Any program may then have delayed the process."""
        assert read_stalls(write(tmp_path / "stalls.jsonl", [(10, 30)], real_time=False)).shape == (0, 2)

    def test_no_file_is_no_stall(self, tmp_path: Path) -> None:
        assert read_stalls(tmp_path / "stalls.jsonl").shape == (0, 2)

    def test_an_unfinished_line_is_left_out(self, tmp_path: Path) -> None:
        path = write(tmp_path / "stalls.jsonl", [(10, 30)])
        with path.open("a") as file:
            file.write('{"cpu": 1, "due_')
        assert read_stalls(path).tolist() == [[10, 30]]


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
    assert host.between_ns(20, 55) == pytest.approx(15)
