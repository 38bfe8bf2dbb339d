"""systemd's own verdict on unit files: `systemd-analyze verify` and `security --offline`; nothing is started."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

MAX_EXPOSURE: Final = 3.0
"""0 is best, 10 worst; systemd calls up to 4.9 "OK" or better."""
_TIMEOUT_S: Final = 60.0
_OVERALL = re.compile(r"Overall exposure level for (\S+): ([\d.]+) ")
_VERSION = re.compile(r"systemd (\d+)")
_NAMES_A_UNIT = re.compile(r"(?:^|/)([A-Za-z0-9@:_.\\-]+\.(?:service|socket|target|mount|timer|slice|path))\b")

Runner = Callable[[Sequence[str]], tuple[int, str]]
"""Runs a command; returns its exit status and the text of both outputs."""


@dataclass(frozen=True)
class UnitVerdict:
    """Findings about a set of units."""

    complaints: tuple[str, ...]
    """Lines of `verify` about these units."""
    others: tuple[str, ...]
    """Lines of `verify` about other units of this machine."""
    exposure: dict[str, float]
    """Score of each service."""
    not_checked: tuple[str, ...]
    """Checks that were not possible, for the operator."""

    @property
    def good(self) -> bool:
        """Whether there is no complaint, and no service is more exposed than MAX_EXPOSURE."""
        return not self.complaints and all(score <= MAX_EXPOSURE for score in self.exposure.values())


def run_command(command: Sequence[str]) -> tuple[int, str]:
    """Run a command without a terminal or a shell; raises OSError or subprocess.TimeoutExpired."""
    done = subprocess.run(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=_TIMEOUT_S
    )
    return done.returncode, done.stdout.decode("utf-8", "replace")


def systemd_version(run: Runner = run_command, which: Callable[[str], str | None] = shutil.which) -> int | None:
    """Return the version of this machine's systemd; None without systemd or a reported version."""
    tool = which("systemd-analyze")
    if tool is None:
        return None
    try:
        found = _VERSION.match(run([tool, "--version"])[1])
    except (OSError, subprocess.TimeoutExpired):
        return None
    return None if found is None else int(found[1])


def check_units(
    paths: Sequence[Path], run: Runner = run_command, which: Callable[[str], str | None] = shutil.which
) -> UnitVerdict:
    """Verify unit files and score them; raises OSError when the tool does not run."""
    tool = which("systemd-analyze")
    if tool is None:
        return UnitVerdict((), (), {}, ("systemd-analyze is not on this machine: the units were not checked",))
    try:
        return _check(tool, paths, run)
    except subprocess.TimeoutExpired:
        return UnitVerdict((f"systemd-analyze did not answer within {_TIMEOUT_S:.0f} s; try again",), (), {}, ())


def _check(tool: str, paths: Sequence[Path], run: Runner) -> UnitVerdict:
    complaints, others = _verify(tool, paths, run)
    exposure: dict[str, float] = {}
    not_checked: list[str] = []
    for path in paths:
        _, text = run([tool, "security", "--offline=true", "--no-pager", str(path)])
        found = _OVERALL.search(text)
        if found is not None:
            exposure[path.name] = float(found[2])
        else:
            reason = next((line.strip() for line in text.splitlines() if line.strip()), "nothing")
            not_checked.append(f"{path.name}: no score of its exposure ({reason}); systemd 250 and later score files")
    return UnitVerdict(tuple(complaints), tuple(others), exposure, tuple(not_checked))


def _verify(tool: str, paths: Sequence[Path], run: Runner) -> tuple[list[str], list[str]]:
    """Return the lines about these units, and about others. An unknown key is a line, with status 0."""
    status, text = run([tool, "verify", "--man=no", *(str(path) for path in paths)])
    ours = {path.name for path in paths}
    complaints: list[str] = []
    others: list[str] = []
    for line in text.splitlines():
        named = set(_NAMES_A_UNIT.findall(line))
        if line.strip():
            (others if named and not named & ours else complaints).append(line.strip())
    if status != 0 and not complaints:
        complaints.append(f"systemd-analyze verify ended with {status}" + (f" ({others[0]})" if others else ""))
    return complaints, others
