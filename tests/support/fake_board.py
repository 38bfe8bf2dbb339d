"""A board without pip: `python -m venv` and pip are shell scripts, everything on the disk is the product's own."""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import zipfile
from collections.abc import Sequence
from pathlib import Path

from edge.deploy import board as board_command
from edge.deploy.board import Board

ENVIRONMENT_FILES = 6
"""Files that the made-up installer writes, each with its checksum in a list."""

PYTHON = """#!/bin/sh
# python -m venv FOLDER: an environment with a python that installs a program that checks its own files.
set -e
mkdir -p "$3/bin" "$3/lib"
cat > "$3/bin/python" <<'PIP'
%sPIP
chmod +x "$3/bin/python"
"""
PIP = """#!/bin/sh
# python -m pip ... install WHEEL, and python -I -c ... as a check.
set -e
[ "$1" = -m ] || exit 0
bin=$(cd "$(dirname "$0")" && pwd)
for wheel in "$@"; do :; done
i=0
while [ $i -lt FILES ]; do
    cat "${wheel%%\\[*}" > "$bin/../lib/module$i"
    i=$((i + 1))
done
cd "$bin/../lib" && sha256sum module* > ../files.sha256
cat > "$bin/edge-run" <<'END'
#!/bin/sh
# Starts if every file of its environment and of its artifacts is whole.
cd "$(dirname "$0")/../lib" && sha256sum --status -c ../files.sha256 &&
cd ../../artifacts && sha256sum --status -c files.sha256
END
cat > "$bin/edge-install" <<'END'
#!/bin/sh
cd "$(dirname "$0")/../../artifacts" && sha256sum --status -c files.sha256 && exit 0
echo "a hash differs from the manifest's" && exit 3
END
cp "$bin/edge-run" "$bin/edge-bridge"
chmod +x "$bin"/edge-*
"""


def write_python(folder: Path, files: int = ENVIRONMENT_FILES) -> str:
    """Write the program that stands for Python; returns its path."""
    path = folder / "python"
    path.write_text(PYTHON % PIP.replace("FILES", str(files)))
    path.chmod(0o755)
    return str(path)


def write_wheel(folder: Path, version: str, size: int = 20_000, name: str = "tic-vla-edge") -> Path:
    """Write a wheel with the package's metadata and nothing that could run."""
    path = folder / f"tic_vla_edge-{version}-py3-none-any.whl"
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w") as archive:
        metadata = (
            f"Metadata-Version: 2.4\nName: {name}\nVersion: {version}\nProvides-Extra: cpu\nProvides-Extra: unitree\n"
        )
        archive.writestr(zipfile.ZipInfo(f"tic_vla_edge-{version}.dist-info/METADATA"), metadata)
        archive.writestr(zipfile.ZipInfo("content"), hashlib.sha256(version.encode()).digest() * (size // 32))
    return path


def write_fake_artifacts(folder: Path, content: str, size: int = 100_000) -> Path:
    """Write files with a list of their checksums, and a manifest that names the content."""
    folder.mkdir(parents=True)
    data = hashlib.sha256(content.encode()).digest() * (size // 32)
    (folder / "graph.onnx").write_bytes(data)
    (folder / "files.sha256").write_text(f"{hashlib.sha256(data).hexdigest()}  graph.onnx\n")
    (folder / "manifest.json").write_text(json.dumps({"schema_version": 1, "content": content}))
    return folder


class Versions:
    """A board, and wheels and artifacts of several versions."""

    def __init__(self, folder: Path, home: Path | None = None, files: int = ENVIRONMENT_FILES) -> None:
        self.folder, self.home = folder, home or folder / "home"
        self.board = Board(python=write_python(folder, files), machine="x86_64")
        self.lines: list[str] = []

    def sources(self, version: int) -> tuple[Path, Path]:
        """Return the wheel and the artifacts of a version, made when first asked for."""
        wheel = write_wheel(self.folder, f"0.{version}.0")
        artifacts = self.folder / f"artifacts{version}"
        return wheel, artifacts if artifacts.exists() else write_fake_artifacts(artifacts, str(version))

    def install(self, version: int, *more: str) -> int:
        """Run `edge-install board` with a version; returns the exit code."""
        self.lines.clear()
        return install(self.home, self.board, self.lines, *self.sources(version), *more)

    def call(self, command: str, *more: str) -> int:
        """Run another command; returns the exit code."""
        self.lines.clear()
        return call(self.board, self.lines, command, "--home", str(self.home), *more)

    def numbers(self) -> list[int]:
        """Return the numbers of the release folders, finished or not."""
        return sorted(int(path.name) for path in (self.home / "releases").iterdir())


def install(home: Path, board: Board, lines: list[str], wheel: Path, artifacts: Path, *more: str) -> int:
    """Run `edge-install board`; returns the exit code."""
    return call(board, lines, "board", "--home", str(home), "--wheel", str(wheel), "--artifacts", str(artifacts), *more)


def call(board: Board, lines: list[str], *words: str) -> int:
    """Run one of the commands; returns the exit code, and appends what it prints to `lines`."""
    parser = argparse.ArgumentParser()
    board_command.add_parsers(parser.add_subparsers(dest="command"))
    return board_command.run(parser.parse_args(list(words)), lines.append, board)


def starts(home: Path) -> bool:
    """Return whether the current release starts, with every file of it whole."""
    return subprocess.run([home / "current/venv/bin/edge-run", "--help"], check=False).returncode == 0


def current(home: Path) -> int:
    """Return the current release's number."""
    return int((home / "current").readlink().name)


def commands_of(lines: Sequence[str]) -> list[str]:
    """Return what the steps' lines say after their number."""
    return [line.partition(": ")[2] for line in lines if line.startswith("step ")]
