"""Pinned packages of a release: the versions and hashes that the package's wheel carries for a board.

`pip install` of the wheel alone takes the newest packages that fit. A board takes what was tested, and pip refuses a
file with another hash, wherever it comes from.
"""

from __future__ import annotations

import lzma
import sys
import zipfile
import zlib
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from email.parser import Parser
from pathlib import Path
from typing import Final

from edge.deploy.steps import Run, Step, command_step
from firmware_bridge.system.input_file import open_regular

FILE: Final = "edge/deploy/constraints-hashed.txt"
"""Name in the wheel; `setup.py` copies the repository's `constraints-hashed.txt` there."""
PLATFORMS: Final = "# platforms: "
EXTRAS: Final = "# extras: "
BASE: Final = "base"
_MAX_BYTES: Final = 1_000_000
"""Largest text file that is read from a wheel, bytes: its pins have 0.2 MB."""
_MAX_UNPACKED: Final = 200_000_000
"""Largest wheel once unpacked, bytes: a small file may expand to gigabytes. Ours has a few MB."""
_DAMAGED: Final = (zipfile.BadZipFile, EOFError, zlib.error, lzma.LZMAError, UnicodeDecodeError, RuntimeError)
"""Errors of a zip file that is cut, damaged, encrypted or compressed by a method that wheels do not have."""


class PinsError(ValueError):
    """A wheel or its pins that cannot be read; one line."""


@dataclass(frozen=True)
class Pins:
    """The pins of one release: platforms whose hashes are known, and (extras, lines) of each package."""

    platforms: frozenset[str]
    entries: tuple[tuple[frozenset[str], str], ...]

    def for_board(self, machine: str, python: tuple[int, int], extras: Collection[str]) -> str | None:
        """Return the text of a pip requirements file with hashes; None for a platform whose hashes are not known."""
        if f"{machine}-{python[0]}.{python[1]}" not in self.platforms:
            return None
        wanted = {BASE, *extras}
        return "\n".join(lines for needed, lines in self.entries if needed & wanted) + "\n"


def read_pins(wheel: Path) -> Pins | None:
    """Return the pins in a wheel; None for a wheel without them. Raises PinsError or OSError."""
    try:
        with open_regular(wheel) as file, zipfile.ZipFile(file) as archive:
            if FILE not in archive.namelist():
                return None
            if archive.getinfo(FILE).file_size > _MAX_BYTES:
                raise PinsError(f"{wheel}: {FILE} is larger than {_MAX_BYTES} bytes")
            return parse_pins(archive.read(FILE).decode("utf-8"))
    except _DAMAGED as error:
        raise PinsError(f"{wheel}: not a whole wheel ({error}); copy it again") from error


def parse_pins(text: str) -> Pins:
    """Parse the file that `python -m tools.dependencies hashes` writes. Raises PinsError."""
    platforms: frozenset[str] = frozenset()
    entries: list[tuple[frozenset[str], list[str]]] = []
    for line in text.splitlines():
        if line.startswith(PLATFORMS):
            platforms = frozenset(line.removeprefix(PLATFORMS).split())
        elif line.startswith(EXTRAS):
            entries.append((frozenset(line.removeprefix(EXTRAS).split()), []))
        elif line.startswith("#") or not line.strip():
            continue
        elif not entries:
            raise PinsError(f"{FILE}: expected a line {EXTRAS.strip()!r} before {line[:60]!r}")
        else:
            entries[-1][1].append(line)
    if not platforms or not all(lines and "--hash=sha256:" in lines[-1] for _, lines in entries):
        raise PinsError(f"{FILE}: expected platforms, and hashes of every package")
    return Pins(platforms, tuple((extras, "\n".join(lines)) for extras, lines in entries))


def pins_of(wheel: Path, extras: Collection[str], machine: str) -> tuple[str | None, str]:
    """Return the pins that a wheel has for this board, or None and why it has none. Raises PinsError or OSError."""
    found = read_pins(wheel)
    if found is None:
        return None, "the wheel has no pinned packages"
    # arm64 gets the DDS binding by `edge-install dds`.
    own = [extra for extra in extras if extra != "unitree" or machine == "x86_64"]
    python = sys.version_info[:2]
    pins = found.for_board(machine, python, own)
    return pins, "" if pins else f"the wheel has no pinned packages for {machine}, Python {python[0]}.{python[1]}"


def pinned_steps(
    file: Path, pins: str, pip: Sequence[str], wheel: Path, others: Sequence[str], command: Run
) -> list[Step]:
    """Return the steps that install pins, each file by its hash, then the wheel itself, then `others`.

    `pip`: the command to install, with its options. In one call, pip before 23.1 would ask for the hashes of what the
    wheel requires too.
    """
    title = f"write {pins.count('==')} pinned packages with their hashes to {file}"
    steps = [
        Step(title, lambda disk: disk.write(file, pins)),
        command_step("install", [*pip, "--no-deps", "--require-hashes", "-r", str(file)], command),
        command_step("install", [*pip, "--no-deps", str(wheel)], command),
    ]
    if others:
        steps.append(command_step("install", [*pip, *others], command))
    return [*steps, command_step("check the installed packages", [*pip[:3], "check"], command)]


def wheel_extras(wheel: Path) -> frozenset[str]:
    """Return the extras of this package's wheel. Raises PinsError for another file, or for a part of one."""
    try:
        with open_regular(wheel) as file, zipfile.ZipFile(file) as archive:
            names = [name for name in archive.namelist() if name.endswith(".dist-info/METADATA")]
            unpacked = sum(entry.file_size for entry in archive.infolist())
            if unpacked > _MAX_UNPACKED or any(archive.getinfo(name).file_size > _MAX_BYTES for name in names):
                raise PinsError(
                    f"{wheel}: {unpacked} bytes once unpacked, expected at most {_MAX_UNPACKED}, and {_MAX_BYTES} of "
                    f"METADATA; build the wheel again"
                )
            broken = archive.testzip()
            if broken is not None or not names:
                raise PinsError(f"{wheel}: not a whole wheel ({broken or 'no METADATA'}); copy it again")
            metadata = Parser().parsestr(archive.read(names[0]).decode())
    except _DAMAGED as error:
        raise PinsError(f"{wheel}: not a whole wheel ({error}); copy it again") from error
    if metadata["Name"] != "tic-vla-edge":
        raise PinsError(f"{wheel}: expected a wheel of tic-vla-edge, found {metadata['Name']}")
    return frozenset(metadata.get_all("Provides-Extra") or ())
