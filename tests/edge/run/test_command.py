"""What `edge-run` refuses before it looks at the robot or the artifacts."""

from __future__ import annotations

from pathlib import Path

import pytest

from edge.core.cli import EXIT_BAD_INPUT
from edge.run.command import main
from tests.support.processes import GO2_SIM


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("--instruction", " "), "instruction is empty"),
        (("--duration", "-3"), "--duration"),
        (("--release-delay", "soon"), "release delay"),
        (("--robot", "no-such-robot.toml"), "no-such-robot.toml"),
        (("--json", "."), "--json"),
        (("--record", str(GO2_SIM)), "never overwritten"),
        (("--record", "no-such-folder/flight.mcap"), "no-such-folder"),
        (("--require-operator",), "safety.operator_arm: expected true, found false"),
    ],
)
def test_bad_input_gets_one_line_and_exit_code_2(
    change: tuple[str, ...], message: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--artifacts", str(tmp_path), "--robot", str(GO2_SIM), "--instruction", "walk to the door"]
    assert main([*arguments, *change]) == EXIT_BAD_INPUT
    told = capfd.readouterr().err
    assert message in told and told.count("\n") == 1
