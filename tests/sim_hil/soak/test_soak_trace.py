"""What a soak reads from the trace of the robot's side."""

import json
from pathlib import Path

from sim_hil.soak.analysis import read_trace

_PERIOD_NS = 20_000_000


def _trace(file: Path, commands: list[tuple[str, int]]) -> Path:
    lines = (
        {"kind": "wire", "t_ns": sent_ns, "name": name, "request_id": sent_ns, "velocity": [0.0, 0.0, 0.0]}
        for name, sent_ns in commands
    )
    file.write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")
    return file


def test_the_wait_for_the_robot_after_a_stop_request_is_no_gap_between_commands(tmp_path: Path) -> None:
    first = 1_000_000_000
    moves = [("Move", first + 7 * _PERIOD_NS + number * _PERIOD_NS) for number in range(3)]
    assert read_trace(_trace(tmp_path / "t", [("StopMove", first), *moves])).command_gap_ms.tolist() == [20.0, 20.0]


def test_a_long_silence_of_the_bridge_is_a_gap_unless_a_new_bridge_was_started_in_it(tmp_path: Path) -> None:
    first = 1_000_000_000
    file = _trace(tmp_path / "t", [("Move", first), ("Move", first + 2_000_000_000)])
    assert read_trace(file, [first - 1]).command_gap_ms.tolist() == [2000.0]
    assert read_trace(file, [first - 1, first + 1]).command_gap_ms.tolist() == []


def test_a_late_stop_request_is_a_gap(tmp_path: Path) -> None:
    first = 1_000_000_000
    commands = [("Move", first), ("StopMove", first + 7 * _PERIOD_NS), ("Move", first + 8 * _PERIOD_NS)]
    trace = read_trace(_trace(tmp_path / "t", commands))
    assert trace.command_gap_ms.tolist() == [140.0]
    assert trace.command_ns.tolist() == [first + 7 * _PERIOD_NS]
