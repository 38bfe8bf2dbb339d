"""`tools.can_trace`: a short drive over both kinds of bus, judged by the independent script."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.processes import REPOSITORY
from tools.can_trace.check import main

pytestmark = [pytest.mark.process, pytest.mark.slow]
DRIVES = 3
"""A computer that stands still for 0.4 s loses frames between the processes: one of this many drives must be whole."""


@pytest.mark.parametrize("interface", ["serial", "udp_multicast"])
def test_bridge_and_base_make_no_wrong_crc_or_counter(
    interface: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for drive in range(DRIVES):
        out = tmp_path / str(drive)
        command = [sys.executable, "-m", "tools.can_trace.record", "--interface", interface, "--duration", "6"]
        done = subprocess.run([*command, "--out", out], cwd=REPOSITORY, capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        code = main([str(out / "trace.log"), "--duration", "5.5"])
        judged = json.loads(capsys.readouterr().out)
        assert judged["wrong"] | {"counter": 0} == dict.fromkeys(judged["wrong"], 0)
        if code == 0:
            break
    assert code == 0, judged
    assert judged["moving_commands"] > 50
    assert json.loads((out / "edge-hil.json").read_text(encoding="utf-8"))["path_m"] > 0.2
