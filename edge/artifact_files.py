"""Files of an artifact directory: the manifest, sealed by a hash of its own, and what it lists."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

SCHEMA_VERSION = 2
MANIFEST_NAME = "manifest.json"
MAX_MANIFEST_BYTES = 4_000_000
HASH_BLOCK_BYTES = 1 << 20
SEAL = "manifest_sha256"
"""Key of the manifest's hash of itself: one wrong bit in a rate or an id would drive as silently as one in a weight."""
_PLAIN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*", re.ASCII)
_SECTIONS = ("schema_version", "target", "model", "runtime", "graphs", "files", "plan", "provenance", SEAL)


class ArtifactError(ValueError):
    """An artifact directory that must not be run; its text is the one line to show."""


@dataclass(frozen=True)
class FileIdentity:
    """What tells whether a file is still the one that was hashed."""

    device: int
    inode: int
    size: int
    modified_ns: int

    @classmethod
    def of(cls, path: Path) -> FileIdentity:
        """Identity of the file at a path; raises OSError."""
        found = path.stat(follow_symlinks=False)
        return cls(found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns)


def seal(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """The manifest with the hash of everything else in it."""
    content = {key: value for key, value in manifest.items() if key != SEAL}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return {**content, SEAL: hashlib.sha256(text.encode("ascii")).hexdigest()}


def read_manifest(directory: Path) -> dict[str, Any]:
    """The manifest as JSON, checked for its hash, version and sections; raises ArtifactError."""
    path = directory / MANIFEST_NAME
    if not directory.is_dir():
        raise ArtifactError(f"{directory}: not a directory; make one with edge-export --out {directory}")
    try:
        if path.stat().st_size > MAX_MANIFEST_BYTES:
            raise ArtifactError(f"{path}: larger than {MAX_MANIFEST_BYTES} bytes, refused")
        raw = path.read_bytes()
        manifest: Any = json.loads(raw)
    except OSError as error:
        raise ArtifactError(
            f"{path}: cannot be read ({error.strerror}); is this a directory of edge-export?"
        ) from error
    except (ValueError, RecursionError) as error:
        raise ArtifactError(f"{path}: not JSON ({error})") from error
    if not isinstance(manifest, dict):
        raise ArtifactError(f"{path}: expected a JSON object")
    if manifest.get("schema_version") != SCHEMA_VERSION:
        raise ArtifactError(
            f"{path}: schema version {manifest.get('schema_version')!r}, expected {SCHEMA_VERSION}; export again"
        )
    missing = [section for section in _SECTIONS if section not in manifest]
    if missing:
        raise ArtifactError(f"{path}: sections {missing} are missing")
    if seal(manifest)[SEAL] != manifest[SEAL]:
        raise ArtifactError(f"{path}: sha256 of its content is not the one that it names; export again")
    return manifest


def _check_file(directory: Path, name: str, entry: Any) -> Path:
    """Path of a listed file that is a regular file of the listed size; raises ArtifactError."""
    if not _PLAIN_NAME.fullmatch(name) or name == MANIFEST_NAME:
        raise ArtifactError(f"{MANIFEST_NAME}: file name {name!r} is not a plain name")
    path = directory / name
    if (
        not isinstance(entry, dict)
        or not isinstance(entry.get("bytes"), int)
        or not isinstance(entry.get("sha256"), str)
    ):
        raise ArtifactError(f"{MANIFEST_NAME}: entry of {name} must give bytes and sha256")
    if path.is_symlink() or not path.is_file():
        raise ArtifactError(f"{path}: missing or not a regular file")
    if path.stat().st_size != entry["bytes"]:
        raise ArtifactError(f"{path}: {path.stat().st_size} bytes, the manifest says {entry['bytes']}; export again")
    return path


def _compare(path: Path, found: str, entry: Mapping[str, Any]) -> None:
    if found != entry["sha256"]:
        raise ArtifactError(f"{path}: sha256 {found[:12]}…, the manifest says {entry['sha256'][:12]}…; export again")


def read_file(directory: Path, name: str, entry: Any) -> bytes:
    path = _check_file(directory, name, entry)
    data = path.read_bytes()
    _compare(path, hashlib.sha256(data).hexdigest(), entry)
    return data


def hash_file(directory: Path, name: str, entry: Any) -> FileIdentity:
    """Verify a file that is too large to be held; returns what it is recognised by afterwards."""
    path = _check_file(directory, name, entry)
    identity = FileIdentity.of(path)
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(HASH_BLOCK_BYTES):
            digest.update(block)
    _compare(path, digest.hexdigest(), entry)
    return identity
