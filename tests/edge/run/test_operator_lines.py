"""The operator's lines: a terminal that takes nothing holds up neither the run nor the end of the process."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from edge.run.service import operator_lines

CHATTERS = (
    "from edge.run.service import operator_lines\n"
    "lines = operator_lines('edge-run')\n"
    "for number in range(2000):\n"
    "    lines.write('x' * 200)\n"
    "lines.close(0.1)\n"
)


def test_lines_reach_the_descriptor_in_order() -> None:
    reader, writer = os.pipe()
    lines = operator_lines("edge-run", writer)
    for line in ("armed", "it is 70 °C"):
        lines.write(line)
    lines.close(5.0)
    os.close(writer)
    with os.fdopen(reader, encoding="utf-8") as text:
        assert text.read() == "edge-run: armed\nedge-run: it is 70 °C\n"


@pytest.mark.parametrize("broken", [False, True], ids=["nobody reads", "broken"])
def test_a_pipe_that_takes_nothing_does_not_keep_the_process_from_ending(broken: bool) -> None:
    reader, writer = os.pipe()
    if broken:
        os.close(reader)
    try:
        assert subprocess.run([sys.executable, "-c", CHATTERS], stderr=writer, timeout=300, check=False).returncode == 0
    finally:
        os.close(writer)
        if not broken:
            os.close(reader)
