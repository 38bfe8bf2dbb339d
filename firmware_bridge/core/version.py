"""Version, commit and artifact schema of this installation, as `--version` prints them."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Final

ARTIFACT_SCHEMA: Final = 4
"""Version of the manifest's layout that this release reads and writes."""
_PACKAGE: Final = Path(__file__).resolve().parents[1]


def version_line(command: str) -> str:
    """Return `COMMAND VERSION (commit COMMIT, artifact schema N)`; the version is the one in pyproject.toml."""
    try:
        number = version("tic-vla-edge")
    except PackageNotFoundError:
        number = "not installed"
    return f"{command} {number} (commit {commit()}, artifact schema {ARTIFACT_SCHEMA})"


def commit() -> str:
    """Return the commit a wheel was built from, that of the checkout this runs in, or `unknown`."""
    stamp, git = _PACKAGE / "commit.txt", _PACKAGE.parent / ".git"
    try:
        if stamp.exists():
            return stamp.read_text().strip()
        head = (git / "HEAD").read_text().strip()
        if not head.startswith("ref: "):
            return head[:12]
        return (git / head.removeprefix("ref: ")).read_text().strip()[:12]
    except OSError:  # a packed reference, a worktree, or no checkout
        return "unknown"
