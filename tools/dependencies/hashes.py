"""Writes `constraints.txt` again with the hashes that pip finds for each platform and version of Python.

pip refuses a package whose file has another hash, also where the file comes from a mirror or a folder of wheels.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from packaging.markers import default_environment
from packaging.requirements import InvalidRequirement, Requirement
from packaging.utils import canonicalize_name

from edge.deploy.pins import EXTRAS, PLATFORMS
from firmware_bridge.system.input_file import read_toml
from tools.dependencies.licences import BASE, POLICY, LicenceError, Package

Hashes = dict[tuple[str, str], set[str]]
"""(name, version) of a package -> SHA-256 of its files."""
Run = Callable[[Sequence[str]], tuple[int, str]]
HEAD: Final = """\
# constraints.txt with the hashes of the packages that a robot's computer installs; tools/dependencies/policy.toml has
# the platforms. Made by `python -m tools.dependencies hashes`; do not edit it. The wheel contains this file.
"""


@dataclass(frozen=True)
class Platform:
    """A kind of machine: pip's tags, and the extras that it installs."""

    tags: tuple[str, ...]
    machine: str
    python: str
    extras: tuple[str, ...]

    def environment(self, extra: str) -> dict[str, str]:
        """Return the variables of requirement markers on this platform."""
        here = {key: str(value) for key, value in default_environment().items()}
        return {
            **here, "platform_machine": self.machine, "python_version": self.python,
            "python_full_version": f"{self.python}.0", "extra": extra,
        }  # fmt: skip


def platforms(policy: Path = POLICY) -> list[Platform]:
    """Return the platforms of the policy, one for each version of Python. Raises OSError or ValueError."""
    try:
        return [
            Platform(tuple(each["tags"]), each["machine"], python, tuple(each["extras"]))
            for each in read_toml(policy)["platforms"]
            for python in each["pythons"]
        ]
    except (KeyError, TypeError) as error:
        raise LicenceError(f"{policy}: expected platforms with tags, machine, pythons and extras: {error}") from error


def extras_of(name: str, packages: Sequence[Package]) -> frozenset[str]:
    """Return the extras that need a package; BASE for a package that only another version of Python needs.

    The packages of another version of Python are not installed here, so that their extras are not known.
    """
    found = [each.extras for each in packages if canonicalize_name(each.name) == canonicalize_name(name)]
    return frozenset(*found) if found else frozenset([BASE])


def pinned_for(platform: Platform, packages: Sequence[Package], constraints: Path) -> list[str]:
    """Return the pins of the packages that a platform's extras need, without markers."""
    return [
        f"{requirement.name}{requirement.specifier}"
        for _, requirement in _lines(constraints)
        if requirement is not None
        and _holds(requirement, platform)
        and {BASE, *platform.extras} & extras_of(requirement.name, packages)
    ]


def hashes_of(platform: Platform, pins: Sequence[str], run: Run) -> Hashes:
    """Ask pip for the files of pinned packages. Raises LicenceError with pip's last error."""
    with tempfile.TemporaryDirectory(prefix="tic-") as folder:
        report = Path(folder) / "report.json"
        command = [
            sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--quiet", "--dry-run", "--no-deps",
            "--ignore-installed", "--only-binary", ":all:", "--python-version", platform.python,
            *(word for tag in platform.tags for word in ("--platform", tag)), "--target", folder,
            "--report", str(report), *pins,
        ]  # fmt: skip
        code, output = run(command)
        if code != 0:
            errors = [line for line in output.splitlines() if line.startswith("ERROR")] or ["no output"]
            raise LicenceError(f"pip finds no packages for {platform.machine}, Python {platform.python}: {errors[-1]}")
        found: Hashes = {}
        for each in json.loads(report.read_text(encoding="utf-8"))["install"]:
            key = canonicalize_name(each["metadata"]["name"]), each["metadata"]["version"]
            found.setdefault(key, set()).add(each["download_info"]["archive_info"]["hashes"]["sha256"])
        return found


def with_hashes(constraints: Path, found: Hashes, packages: Sequence[Package], known: Sequence[Platform]) -> str:
    """Return the constraints of the packages whose hashes are known, in pip's form.

    A comment before each names the extras that need it; the last one of the head names the platforms. `edge-install
    board` reads both.
    """
    names = " ".join(f"{each.machine}-{each.python}" for each in known)
    lines = [f"{HEAD}{PLATFORMS}{names}"]
    for text, requirement in _lines(constraints):
        if requirement is None:
            continue
        version = next(iter(requirement.specifier)).version
        if hashes := found.get((canonicalize_name(requirement.name), version)):
            lines.append(f"{EXTRAS}{' '.join(sorted(extras_of(requirement.name, packages)))}")
            lines.append(" \\\n".join([text, *(f"    --hash=sha256:{each}" for each in sorted(hashes))]))
    return "\n".join(lines) + "\n"


def run_pip(command: Sequence[str]) -> tuple[int, str]:
    """Run pip; return its exit code and output."""
    done = subprocess.run(
        list(command), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        errors="replace", check=False,
    )  # fmt: skip
    return done.returncode, done.stdout


def _lines(constraints: Path) -> Iterator[tuple[str, Requirement | None]]:
    for line in constraints.read_text(encoding="utf-8").splitlines():
        text = line.partition("#")[0].strip()
        try:
            yield text, Requirement(text) if text else None
        except InvalidRequirement as error:
            raise LicenceError(f"{constraints}: {error}") from error


def _holds(requirement: Requirement, platform: Platform) -> bool:
    return requirement.marker is None or requirement.marker.evaluate(platform.environment(""))
