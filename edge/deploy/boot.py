"""`edge-install boot`: what the robot's computer shall do by itself at its next start: hardware watchdog, power mode.

systemd feeds the watchdog of the processor; a kernel that hangs is then reset, and the installed services start again.
A Jetson starts in the power mode that `nvpmodel` has stored.
"""

from __future__ import annotations

import argparse
import re
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from edge.core.cli import EXIT_BAD_INPUT, EXIT_CHECK_FAILED, EXIT_DONE, write_whole
from edge.deploy.unit_check import run_command

ROOT: Final = Path("/")
WATCHDOG_FILE: Final = Path("etc/systemd/system.conf.d/tic-vla-edge-watchdog.conf")
STORED_MODE: Final = Path("var/lib/nvpmodel/status")
"""Mode of the next start, as `nvpmodel -m` stores it: `pmode:0002`."""
_CONF: Final = Path("etc/nvpmodel.conf")
_WATCHDOG_S: Final = (5, 120)
Run = Callable[[Sequence[str]], tuple[int, str]]


class BootError(ValueError):
    """Arguments or a machine that this cannot be set for; one line."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `edge-install boot`."""
    parser.add_argument("--watchdog", type=int, metavar="S", help="reset a kernel that hangs for S seconds, e.g. 30")
    parser.add_argument("--power-mode", metavar="NAME", help="start a Jetson in this mode, e.g. 40W (nvpmodel)")
    parser.add_argument("--dry-run", action="store_true", help="print what would be set only")


def run(args: argparse.Namespace, say: Callable[[str], None], root: Path = ROOT, command: Run | None = None) -> int:
    """Set what was asked for; returns the exit code."""
    try:
        return _set(args, say, root, command or run_command)
    except BootError as error:
        say(str(error))
        return EXIT_BAD_INPUT
    except OSError as error:
        say(f"{error.filename or root / WATCHDOG_FILE}: {error.strerror or error}; run it with sudo")
        return EXIT_BAD_INPUT


def _set(args: argparse.Namespace, say: Callable[[str], None], root: Path, command: Run) -> int:
    if args.watchdog is None and args.power_mode is None:
        raise BootError("expected --watchdog S, --power-mode NAME, or both")
    mode = None if args.power_mode is None else mode_number(_conf(root), args.power_mode)
    if args.watchdog is not None:
        if not _WATCHDOG_S[0] <= args.watchdog <= _WATCHDOG_S[1]:
            raise BootError(f"--watchdog {args.watchdog}: expected {_WATCHDOG_S[0]} to {_WATCHDOG_S[1]} s")
        if not (root / "dev/watchdog0").exists():
            device = root / "dev/watchdog0"
            raise BootError(f"{device}: this machine has no hardware watchdog, or its driver is not loaded")
        say(f"write {root / WATCHDOG_FILE}: reset after {args.watchdog} s, from the next start on")
        if not args.dry_run:
            (root / WATCHDOG_FILE).parent.mkdir(parents=True, exist_ok=True)
            write_whole(root / WATCHDOG_FILE, watchdog_text(args.watchdog))
    if mode is not None:
        words = ["nvpmodel", "-m", str(mode)]
        say(f"{' '.join(words)}: power mode {args.power_mode}, stored for every start")
        if not args.dry_run:
            try:
                code, output = command(words)
            except subprocess.TimeoutExpired as error:
                say(f"{' '.join(words)}: expected an answer within {error.timeout:g} s, found none; restart the Jetson")
                return EXIT_CHECK_FAILED
            if code != 0:
                say(f"{' '.join(words)}: failed: {output.strip() or f'exit code {code}'}")
                return EXIT_CHECK_FAILED
    say("nothing was changed (--dry-run)" if args.dry_run else "done; check it after a restart with edge-doctor")
    return EXIT_DONE


def watchdog_text(seconds: int) -> str:
    """Return the drop-in of systemd's own configuration (systemd-system.conf(5))."""
    return (
        "# Made by edge-install boot: systemd feeds the hardware watchdog, which resets a kernel that hangs.\n"
        f"[Manager]\nRuntimeWatchdogSec={seconds}\n"
    )


def mode_number(conf: str, name: str) -> int:
    """Return the number of a power mode in an nvpmodel configuration. Raises BootError."""
    modes = {found: int(number) for number, found in _MODE.findall(conf)}
    if name not in modes:
        known = ", ".join(modes) or "none: this is no Jetson"
        raise BootError(f"--power-mode {name}: expected a mode of /{_CONF}: {known}")
    return modes[name]


def stored_mode(root: Path) -> str | None:
    """Return the name of the power mode of the next start; None where no Jetson tells."""
    try:
        found = re.search(r"pmode:(\d+)", (root / STORED_MODE).read_text(encoding="ascii", errors="replace"))
    except OSError:
        return None
    names: dict[int, Any] = {int(number): name for number, name in _MODE.findall(_conf(root))}
    return None if found is None else names.get(int(found[1]))


_MODE: Final = re.compile(r"<\s*POWER_MODEL\s+ID=(\d+)\s+NAME=(\S+?)\s*>")


def _conf(root: Path) -> str:
    try:
        return (root / _CONF).read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""
