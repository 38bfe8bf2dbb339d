"""Artifacts as `edge-install board` copies and keeps them: which files, and whether the manifest's hashes hold.

A manifest of another schema version is checked by its hashes only: the program that runs this may be older or newer
than the release, whose own program checks the rest.
"""

from __future__ import annotations

import hashlib
import os
import stat
from pathlib import Path
from typing import BinaryIO, Final

from edge.artifacts.files import (
    HASH_BLOCK_BYTES,
    MANIFEST_NAME,
    SCHEMA_VERSION,
    ArtifactError,
    check_entry,
    parse_manifest,
    read_manifest_bytes,
)
from firmware_bridge.system.input_file import parse_json

_OPEN: Final = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK


def open_plain(path: Path) -> BinaryIO:
    """Open a regular file for reading, never through a link. Raises ArtifactError for another kind, or OSError."""
    if path.is_symlink():
        raise ArtifactError(f"{path}: expected a file, found a link; copy what {path.readlink()} is to its place")
    descriptor = os.open(path, _OPEN)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise ArtifactError(f"{path}: expected a file, found another kind; remove it")
    return os.fdopen(descriptor, "rb")


def sha256_of(file: BinaryIO) -> str:
    """Return the SHA-256 of the rest of an open file, read in blocks."""
    digest = hashlib.sha256()
    while block := file.read(HASH_BLOCK_BYTES):
        digest.update(block)
    return digest.hexdigest()


def plain_files(directory: Path) -> tuple[Path, ...]:
    """Return every file of an artifact directory. Raises ArtifactError for a link: its target may be secret."""
    found = tuple(sorted(path for path in directory.iterdir() if path.is_symlink() or not path.is_dir()))
    for path in found:
        open_plain(path).close()
    return found


def check_artifacts(directory: Path, manifest_sha256: str | None = None) -> str:
    """Check the manifest and the hash of every file that it lists; returns the manifest's SHA-256.

    `manifest_sha256`: expected hash of the manifest. Raises ArtifactError.
    """
    raw = read_manifest_bytes(directory)
    found = hashlib.sha256(raw).hexdigest()
    if manifest_sha256 is not None and manifest_sha256 != found:
        raise ArtifactError(f"{directory / MANIFEST_NAME}: sha256 {found[:12]}…, expected {manifest_sha256[:12]}…")
    for name, sha256 in _listed(directory, raw).items():
        path = directory / name
        try:
            with open_plain(path) as file:
                other = sha256_of(file)
        except OSError as error:
            raise ArtifactError(f"{path}: listed in the manifest, cannot be read ({error.strerror})") from error
        if other != sha256:
            raise ArtifactError(f"{path}: sha256 {other[:12]}…, the manifest lists {sha256[:12]}…: a hash differs")
    return found


def _listed(directory: Path, raw: bytes) -> dict[str, str]:
    """Return the SHA-256 of each file that a manifest lists. Raises ArtifactError."""
    path = directory / MANIFEST_NAME
    try:
        manifest = parse_json(raw)
    except ValueError as error:
        raise ArtifactError(f"{path}: not JSON ({error})") from error
    if not isinstance(manifest, dict):
        raise ArtifactError(f"{path}: expected a JSON object")
    files, version = manifest.get("files"), manifest.get("schema_version")
    if type(version) is not int or version < 1:
        raise ArtifactError(f"{path}: schema version {version!r}, expected a whole number from 1 on; export again")
    if version == SCHEMA_VERSION:
        files = parse_manifest(directory, raw)["files"]
        if not isinstance(files, dict):
            raise ArtifactError(f"{path}: files: expected a JSON object; export again")
        for name, entry in files.items():
            check_entry(name, entry)
    entries = files.items() if isinstance(files, dict) else ()
    return {name: entry["sha256"] for name, entry in entries if _has_hash(name, entry)}


def _has_hash(name: str, entry: object) -> bool:
    return Path(name).name == name and isinstance(entry, dict) and isinstance(entry.get("sha256"), str)
