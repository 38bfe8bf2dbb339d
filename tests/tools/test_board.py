"""The proof on an emulated board: what its judges say of a command's end and of a simulated robot's trace."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tools.board.drive import DriveError, judge
from tools.board.journey import Command, current_release, import_times

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


@pytest.mark.parametrize(
    ("code", "output", "current", "fault"),
    [
        (0, "current is release 1\n", 1, None),
        (1, "step 1\nthe disk is full\n", 1, "expected exit code 0, found 1: the disk is full"),
        (1, "", 1, "expected exit code 0, found 1: no output"),
        (0, "nothing\n", 1, "expected 'current is release 1' in the output"),
        (0, "step 1 of 4\ncurrent is release 1\n", 1, "expected no 'step ' in the output"),
        (0, "current is release 1\n", None, "expected release 1 to be current, found None"),
    ],
)
def test_a_command_passes_only_as_expected(code: int, output: str, current: int | None, fault: str | None) -> None:
    command = Command("again", ("true",), "current is release 1", never_prints="step ", current=1)
    assert command.fault(code, output, current) == fault


def test_the_current_release_is_where_the_link_leads(tmp_path: Path) -> None:
    home = tmp_path / "opt/tic-vla-edge"
    home.mkdir(parents=True)
    assert current_release(tmp_path) is None
    (home / "current").symlink_to("releases/2")
    assert current_release(tmp_path) == 2


def test_import_times_add_up_by_package() -> None:
    lines = [
        "import time: self [us] | cumulative | imported package",
        "import time:      2000 |       2000 |   numpy._core",
    ]
    lines += [
        "import time:      1000 |       3000 | numpy",
        "import time:       500 |        500 | json",
        "usage: edge-run",
    ]
    found = import_times("\n".join(lines))
    assert found == {"modules": 3, "total_ms": 4, "slowest_ms": {"numpy": 3, "json": 0}}
