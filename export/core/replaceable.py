"""Whether an export may replace a directory: without torch, so that `--out` is refused at once."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Any

from edge.artifacts.files import MANIFEST_NAME, ArtifactError, read_manifest
from export.core.cache import file_sha256
from firmware_bridge.system.input_file import open_regular, read_json

OLDER_SCHEMAS = (1, 2, 3)
"""Manifest schemas whose directories an export may replace."""


def check_replaceable(out: Path) -> None:
    """Refuse to replace a directory unless it is empty or holds only files of an export."""
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    listed = {MANIFEST_NAME, *_files_of(out)}
    others = sorted(path.name for path in out.iterdir() if path.name not in listed)
    if others:
        raise ArtifactError(
            f"{out / others[0]}: not written by edge-export, so {out} is not replaced; name another directory"
        )


def _files_of(out: Path) -> dict[str, Any]:
    """Return the files that a manifest lists; those of an older schema only if all match it. Raises ArtifactError."""
    try:
        listed = read_manifest(out)["files"]
        if not isinstance(listed, dict):
            raise ArtifactError(f"{out / MANIFEST_NAME}: files must be an object; name another directory")
        return dict(listed)
    except ArtifactError:
        try:
            older = read_json(out / MANIFEST_NAME)
            files = dict(older["files"])
            # All names before any file: hashing a listed device would never end.
            ours = older["schema_version"] in OLDER_SCHEMAS and all(Path(name).name == name for name in files)
            ours = ours and all(_regular_sha256(out / name) == entry["sha256"] for name, entry in files.items())
        except (OSError, ValueError, KeyError, TypeError):
            ours = False
        if not ours:
            raise
        return files


def _regular_sha256(path: Path) -> str:
    """Hash a regular file of this directory; raises OSError for a link, a device or a FIFO."""
    if path.is_symlink():
        raise OSError(errno.ELOOP, "is a link", str(path))
    open_regular(path).close()
    return file_sha256(path)
