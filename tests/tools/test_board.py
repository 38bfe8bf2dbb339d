"""The proof on an emulated board: what its judge says of a simulated robot's trace."""

from __future__ import annotations

import json

import pytest

from tools.board.drive import DriveError, judge

SILENT_NS = 10_000_000_000


def trace(speeds_mps: list[float], path_m: float = 2.5, zero: bool = True) -> str:
    """A trace with one pose every 20 ms from the last command on."""
    poses = [
        {"t_ns": SILENT_NS + (k + 1) * 20_000_000, "kind": "pose", "vx": speed, "vy": 0.0}
        for k, speed in enumerate(speeds_mps)
    ]
    wire = {"commands": 100, "malformed": 0, "last_command_zero": zero}
    return "\n".join(json.dumps(line) for line in [*poses, {"kind": "end", "path_m": path_m, "wire": wire}])


def test_a_robot_that_stops_is_at_rest_from_its_last_fast_pose_on() -> None:
    found = judge(trace([0.4] * 10 + [0.0] * 10), SILENT_NS)
    assert found["at_rest"] and found["silence_to_rest_ms"] == 200.0 and found["last_command_is_zero"]


def test_a_robot_that_still_moves_is_not_at_rest() -> None:
    assert not judge(trace([0.4] * 20, zero=False), SILENT_NS)["at_rest"]


def test_a_robot_that_never_walked_proves_nothing() -> None:
    with pytest.raises(DriveError, match="has not walked"):
        judge(trace([0.0] * 20, path_m=0.1), SILENT_NS)


def test_a_trace_without_an_end_proves_nothing() -> None:
    with pytest.raises(DriveError, match="has not walked"):
        judge(trace([0.0]).splitlines()[0], SILENT_NS)
