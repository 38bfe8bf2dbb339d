"""The commands of docs/robot.md in their order, and what each of them must answer on the emulated board."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

HOME: Final = "/opt/tic-vla-edge"
CURRENT: Final = f"{HOME}/current"
BIN: Final = "/usr/local/bin"  # links to the current release's programs
PYTHON: Final = f"{CURRENT}/venv/bin/python"
INPUT: Final = "/root/input"  # what a user copies to the board
INSTALLER: Final = "/root/installer"
ROBOT_FILE: Final = "/etc/tic-vla-edge/go2.toml"
QUIET: Final = ("cpuinfo", "cpuid_info")  # ONNX Runtime about the emulated processor
_IMPORT: Final = re.compile(r"import time:\s+(\d+) \|\s+\d+ \|\s+(\S+)")
_MOST: Final = 10


@dataclass(frozen=True)
class Command:
    """One command inside the root, and its expected end."""

    name: str
    words: tuple[str, ...]
    prints: str = ""
    """Text that the output must contain."""
    never_prints: str = ""
    """Text that the output must not contain; empty for none."""
    code: int = 0
    current: int | None = None
    """Release that must be current afterwards; None: any, or none."""

    def fault(self, code: int, output: str, current: int | None) -> str | None:
        """Return what is not as expected, in one line; None if everything is."""
        if code != self.code:
            lines = output.strip().splitlines() or ["no output"]
            return f"expected exit code {self.code}, found {code}: {lines[-1]}"
        if self.prints not in output:
            return f"expected {self.prints!r} in the output"
        if self.never_prints and self.never_prints in output:
            return f"expected no {self.never_prints!r} in the output"
        if self.current is not None and current != self.current:
            return f"expected release {self.current} to be current, found {current}"
        return None


def current_release(root: Path) -> int | None:
    """Return the release that the link `current` leads to; None without one."""
    link = root / CURRENT.lstrip("/")
    return int(link.readlink().name) if link.is_symlink() else None


def installation(wheel: str) -> tuple[Command, ...]:
    """Commands from a bare board to its first release, which is current at the end."""
    pip = (f"{INSTALLER}/bin/pip", "--disable-pip-version-check")
    base = f"{INSTALLER}/lib/python3.11/site-packages"
    return (
        Command("an interpreter that does nothing", ("python3", "-c", "pass")),
        Command("make the installer's environment", ("python3", "-m", "venv", INSTALLER)),
        Command(
            "install the wheel without extras",
            (*pip, "install", "-q", "-c", f"{INPUT}/constraints.txt", f"{INPUT}/{wheel}"),
        ),
        Command("packages of the base install", (*pip, "list")),
        Command("MB of each package", ("sh", "-c", f"du -m --max-depth=1 {base} | sort -rn | head -20")),
        Command("edge-install board --dry-run", (*board(wheel, INSTALLER), "--dry-run"), "nothing was changed"),
        Command("the dry run has made nothing", ("test", "!", "-e", HOME)),
        Command("edge-install board", board(wheel, INSTALLER), prints="current is release 1", current=1),
        Command("link its programs", ("sh", "-c", f"ln -sf {CURRENT}/venv/bin/edge-* {BIN}/")),
        Command("MB of the installer and the release", ("du", "-sm", INSTALLER, f"{HOME}/releases/1")),
        Command("delete the installer", ("rm", "-r", INSTALLER)),
        Command("edge-install board, again", board(wheel), "current is release 1", never_prints="step ", current=1),
        Command("edge-install dds in the release", (f"{BIN}/edge-install", "dds"), prints="nothing to do"),
    )


def use(replay_to_s: float) -> tuple[Command, ...]:
    """Commands that check the current release and run its graphs."""
    artifacts = ("--artifacts", f"{CURRENT}/artifacts")
    return (
        Command("edge-run --help", (f"{BIN}/edge-run", "--help"), prints="usage: edge-run"),
        Command("imports of edge-run --help", (PYTHON, "-X", "importtime", f"{BIN}/edge-run", "--help")),
        Command("edge-doctor", (f"{BIN}/edge-doctor", *artifacts, "--ticks", "0")),
        Command("edge-export verify", (f"{BIN}/edge-export", "verify", f"{CURRENT}/artifacts")),
        Command(
            "edge-replay",
            (f"{BIN}/edge-replay", f"{INPUT}/flight.mcap", *artifacts, "--to", f"{replay_to_s:g}", "--json", "-"),
        ),
    )


def update(next_wheel: str) -> tuple[Command, ...]:
    """Commands that update the board to a second release, go back, go forth and undo everything."""
    install = f"{BIN}/edge-install"
    return (
        Command("edge-install board --dry-run, second wheel", (*board(next_wheel), "--dry-run"), current=1),
        Command("edge-install board, second wheel", board(next_wheel), prints="current is release 2", current=2),
        Command("edge-run --help of release 2", (f"{BIN}/edge-run", "--help"), prints="usage: edge-run"),
        Command("edge-install rollback --dry-run", (install, "rollback", "--dry-run"), "releases/1", current=2),
        Command("edge-install rollback", (install, "rollback"), prints="current is release 1", current=1),
        Command("edge-run --help of release 1", (f"{BIN}/edge-run", "--help"), prints="usage: edge-run"),
        Command(
            "edge-install rollback --to 3", (install, "rollback", "--to", "3"), "no such release", code=1, current=1
        ),
        Command("edge-install rollback --to 2", (install, "rollback", "--to", "2"), current=2),
        Command("edge-install releases", (install, "releases"), prints="release 2"),
        Command("MB of both releases", ("du", "-sm", HOME)),
        Command("edge-install remove --dry-run", (install, "remove", "--dry-run"), "nothing was changed", current=2),
        Command("edge-install remove", (install, "remove")),
        Command("nothing is left", ("test", "!", "-e", HOME)),
    )


def board(wheel: str, environment: str = "/usr/local") -> tuple[str, ...]:
    """Return the words of an environment's `edge-install board` for a wheel and the copied artifacts."""
    return (
        *(f"{environment}/bin/edge-install", "board", "--wheel", f"{INPUT}/{wheel}"),
        *("--artifacts", f"{INPUT}/artifacts"),
        *("--extras", "cpu,unitree", "--constraints", f"{INPUT}/constraints.txt"),
    )


def import_times(output: str) -> dict[str, Any]:
    """Return from `python -X importtime` the modules' number, their time in ms, and the slowest packages."""
    found = [(int(line[1]), line[2]) for line in _IMPORT.finditer(output)]
    packages: dict[str, int] = {}
    for own_us, module in found:
        package = module.split(".")[0]
        packages[package] = packages.get(package, 0) + own_us
    slowest = sorted(packages.items(), key=lambda item: -item[1])[:_MOST]
    return {
        "modules": len(found),
        "total_ms": round(sum(own_us for own_us, _ in found) / 1000),
        "slowest_ms": {package: round(own_us / 1000) for package, own_us in slowest},
    }
