"""Files of an artifact directory: the manifest, sealed by a hash of its own, and what it lists."""

from __future__ import annotations

import hashlib
import json
import os
import re
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from firmware_bridge.core.version import ARTIFACT_SCHEMA

SCHEMA_VERSION = ARTIFACT_SCHEMA
MANIFEST_NAME = "manifest.json"
SIGNATURE_NAME = "manifest.sig"
"""Beside the manifest, which cannot list it: it signs the manifest's bytes (`edge.artifacts.trust`)."""
MAX_MANIFEST_BYTES = 4_000_000
HASH_BLOCK_BYTES = 1 << 20
SEAL = "manifest_sha256"
"""Key of the manifest's hash of itself: one wrong bit in a rate or an id would drive as silently as one in a weight."""
_PLAIN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*", re.ASCII)
_SUFFIXES = (".onnx", ".onnx.data", ".json", ".html")
"""Everything that an export writes. Nothing that could be run or unpickled has a place in an artifact directory."""
_REFUSED_CONTENT = (
    (re.compile(rb"\x80[\x02-\x05]"), "a pickle"),
    (re.compile(rb"PK\x03\x04"), "a zip archive (.pt, .npz)"),
    (re.compile(rb"\x93NUMPY"), "a NumPy array"),
)
SECTIONS = ("schema_version", "target", "model", "runtime", "graphs", "files", "plan", "provenance", SEAL)


class ArtifactError(ValueError):
    """An artifact directory that must not be run; its text is the one line to show."""


@dataclass(frozen=True)
class FileIdentity:
    """Identity of a file: whether it is still the one that was hashed.

    Anybody who may write a file can set its time of modification. The kernel alone sets its time of change: a write, a
    rename and that setting itself all advance it.
    """

    device: int
    inode: int
    size: int
    modified_ns: int
    changed_ns: int

    @classmethod
    def of(cls, path: Path) -> FileIdentity:
        """Identity of the file at a path; raises OSError."""
        return cls.from_stat(path.stat(follow_symlinks=False))

    @classmethod
    def from_stat(cls, found: os.stat_result) -> FileIdentity:
        """Identity of a file by its status."""
        return cls(found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns)


def seal(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """The manifest with the hash of everything else in it."""
    content = {key: value for key, value in manifest.items() if key != SEAL}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return {**content, SEAL: hashlib.sha256(text.encode("ascii")).hexdigest()}


def read_manifest_bytes(directory: Path) -> bytes:
    """The manifest as it lies there, unchecked; raises ArtifactError."""
    path = directory / MANIFEST_NAME
    if not directory.is_dir():
        raise ArtifactError(f"{directory}: not a directory; make one with edge-export --out {directory}")
    try:
        with _open_regular(path) as file:
            raw = file.read(MAX_MANIFEST_BYTES + 1)
    except OSError as error:
        raise ArtifactError(
            f"{path}: cannot be read ({error.strerror}); is this a directory of edge-export?"
        ) from error
    if len(raw) > MAX_MANIFEST_BYTES:
        raise ArtifactError(f"{path}: larger than {MAX_MANIFEST_BYTES} bytes, refused")
    return raw


def read_manifest(directory: Path) -> dict[str, Any]:
    """The manifest as JSON, checked for its hash, version and sections; raises ArtifactError."""
    return parse_manifest(directory, read_manifest_bytes(directory))


def parse_manifest(directory: Path, raw: bytes) -> dict[str, Any]:
    """The manifest in bytes read from a directory, checked for its hash, version and sections; raises ArtifactError."""
    path = directory / MANIFEST_NAME
    try:
        manifest: Any = json.loads(raw)
    except (ValueError, RecursionError) as error:
        raise ArtifactError(f"{path}: not JSON ({error})") from error
    if not isinstance(manifest, dict):
        raise ArtifactError(f"{path}: expected a JSON object")
    if manifest.get("schema_version") != SCHEMA_VERSION:
        raise ArtifactError(
            f"{path}: schema version {manifest.get('schema_version')!r}, expected {SCHEMA_VERSION}; export again"
        )
    missing = [section for section in SECTIONS if section not in manifest]
    if missing:
        raise ArtifactError(f"{path}: sections {missing} are missing")
    if seal(manifest)[SEAL] != manifest[SEAL]:
        raise ArtifactError(f"{path}: sha256 of its content is not the one that it names; export again")
    return manifest


def check_entry(name: str, entry: Any) -> None:
    """A listed file has a plain name, of a kind that belongs here, a size and a hash; raises ArtifactError."""
    if not _PLAIN_NAME.fullmatch(name) or name in (MANIFEST_NAME, SIGNATURE_NAME):
        raise ArtifactError(f"{MANIFEST_NAME}: file name {name!r} is not a plain name")
    if not name.endswith(_SUFFIXES):
        kinds = ", ".join(_SUFFIXES)
        raise ArtifactError(f"{MANIFEST_NAME}: file {name!r} is of no kind that artifacts have ({kinds})")
    if (
        not isinstance(entry, dict)
        or not isinstance(entry.get("bytes"), int)
        or not isinstance(entry.get("sha256"), str)
    ):
        raise ArtifactError(f"{MANIFEST_NAME}: entry of {name} must give bytes and sha256")


def read_file(directory: Path, name: str, entry: Any) -> bytes:
    """The content of a listed file, whose size and hash were checked; raises ArtifactError."""
    check_entry(name, entry)
    path = directory / name
    with _open_listed(path, entry) as file:
        # One byte more than it had: a file that grows meanwhile is noticed by its hash.
        data = file.read(entry["bytes"] + 1)
    _compare(path, hashlib.sha256(data).hexdigest(), entry)
    for magic, kind in _REFUSED_CONTENT:
        if magic.match(data):
            raise ArtifactError(f"{path}: is {kind}, which is never opened; export again")
    return data


def hash_file(directory: Path, name: str, entry: Any) -> FileIdentity:
    """Verify a file that is too large to be held; returns what it is recognised by afterwards."""
    check_entry(name, entry)
    path = directory / name
    digest = hashlib.sha256()
    with _open_listed(path, entry) as file:
        found = os.fstat(file.fileno())
        if found.st_nlink > 1:
            # It is mapped while the robot drives: another name of the file could change it under the policy.
            raise ArtifactError(f"{path}: has {found.st_nlink} names (hard links); copy the directory instead")
        while block := file.read(HASH_BLOCK_BYTES):
            digest.update(block)
    _compare(path, digest.hexdigest(), entry)
    return FileIdentity.from_stat(found)


@contextmanager
def _open_listed(path: Path, entry: Mapping[str, Any]) -> Iterator[IO[bytes]]:
    try:
        with _open_regular(path) as file:
            size = os.fstat(file.fileno()).st_size
            if size != entry["bytes"]:
                raise ArtifactError(f"{path}: {size} bytes, the manifest says {entry['bytes']}; export again")
            yield file
    except OSError as error:
        raise ArtifactError(f"{path}: missing or not a regular file ({error.strerror})") from error


def _open_regular(path: Path) -> IO[bytes]:
    """Open a regular file for reading, and nothing else: no link is followed, no pipe waited for; raises OSError."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(None, "not a regular file")
    return os.fdopen(descriptor, "rb")


def _compare(path: Path, found: str, entry: Mapping[str, Any]) -> None:
    if found != entry["sha256"]:
        raise ArtifactError(f"{path}: sha256 {found[:12]}…, the manifest says {entry['sha256'][:12]}…; export again")
