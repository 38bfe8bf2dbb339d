"""Hash of the source and data files that compute an episode; finer than a package version."""

from __future__ import annotations

import hashlib
from pathlib import Path
from types import ModuleType

import edge
import firmware_bridge
import sim_hil

_SUFFIXES = frozenset((".py", ".toml", ".urdf", ".dbc"))


def code_sha256(*more: ModuleType) -> str:
    """Return the SHA-256 over names and content of the files of `edge`, `firmware_bridge`, `sim_hil` and `more`."""
    digest = hashlib.sha256()
    for package in (edge, firmware_bridge, sim_hil, *more):
        root = Path(package.__path__[0])
        for path in sorted(path for path in root.rglob("*") if path.suffix in _SUFFIXES):
            digest.update(f"{root.name}/{path.relative_to(root).as_posix()}\0".encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()
