"""Lines of a command on a terminal."""

from __future__ import annotations

import errno
import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from edge.core.cli import EXIT_CHECK_FAILED, command_line, describe_os_error, messages
from firmware_bridge.system.terminal import one_line


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("\x1b]0;title\x07weights", r"\x1b]0;title\x07weights"),
        ("a\x9b2Jb", r"a\x9b2Jb"),
        ("\ud800", r"\ud800"),
        ("cosine ≥ 0.99, 90°\n\tnext", r"cosine ≥ 0.99, 90°\n\tnext"),
    ],
)
def test_control_characters_of_a_name_never_reach_the_terminal(
    text: str, shown: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert one_line(text) == shown
    messages("edge-x")(text)
    assert capsys.readouterr().err == f"edge-x: {shown}\n"


def test_a_full_disk_names_what_was_written(capsys: pytest.CaptureFixture[str]) -> None:
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert describe_os_error(full, "out/nano") == "out/nano: No space left on device"
    full.filename = "out/nano/report.json"
    assert describe_os_error(full, "out/nano") == "[Errno 28] No space left on device: 'out/nano/report.json'"

    @command_line("edge-x")
    def main() -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    assert main() == EXIT_CHECK_FAILED
    assert capsys.readouterr().err == "edge-x: an output: No space left on device\n"


@pytest.mark.slow
def test_an_export_that_meets_the_largest_size_of_a_file_names_its_directory(tmp_path: Path) -> None:
    out = tmp_path / "nano"
    done = subprocess.run(
        [sys.executable, "-m", "export.cli", "--no-cache", "--random-weights", "0", "--out", str(out)],
        capture_output=True,
        text=True,
        # Python leaves a .pyc that was cut off by the limit, and every later import of it fails.
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000)),
        check=False,
    )
    assert done.returncode == 2
    line = done.stderr.splitlines()[-1]
    assert str(tmp_path) in line and "File too large" in line
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []
