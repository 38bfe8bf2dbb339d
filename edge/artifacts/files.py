"""Files of an artifact directory: the manifest, sealed by its own hash, and the listed files."""

from __future__ import annotations

import hashlib
import json
import os
import re
import stat
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from firmware_bridge.core.version import ARTIFACT_SCHEMA
from firmware_bridge.system.input_file import check_integers

SCHEMA_VERSION = ARTIFACT_SCHEMA
MANIFEST_NAME = "manifest.json"
SIGNATURE_NAME = "manifest.sig"
"""Signature of the manifest's bytes; the manifest cannot list it (`edge.artifacts.trust`)."""
MAX_MANIFEST_BYTES = 4_000_000
HASH_BLOCK_BYTES = 1 << 20
SEAL = "manifest_sha256"
"""Key of the manifest's own hash: a wrong bit in a rate or an id is as dangerous as one in a weight."""
_PLAIN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*", re.ASCII)
_REFUSED_CONTENT = (
    (re.compile(rb"\x80[\x02-\x05]"), "a pickle"),
    (re.compile(rb"PK\x03\x04"), "a zip archive (.pt, .npz)"),
    (re.compile(rb"\x93NUMPY"), "a NumPy array"),
)
SECTIONS = (
    "schema_version", "target", "model", "runtime", "graphs", "files", "plan", "self_test", "provenance", SEAL
)  # fmt: skip
MAX_NESTING = 32
"""Deepest nesting of a manifest; an export writes 9 levels."""
MAX_BYTES = {".onnx.data": 64 << 30, ".onnx": 512 << 20, ".json": 64 << 20, ".html": 64 << 20}
"""Largest file of each kind, bytes: checked before it is read. An export moves weights above 64 MB to a data file."""
MAX_IN_MEMORY_BYTES = 2 << 30
"""All files together that are read into memory."""
MAX_DATA_BYTES = 64 << 30
"""All data files together, bytes: they are hashed at every start, a sparse one of any size costs its writer nothing."""


class ArtifactError(ValueError):
    """An artifact directory that must not be run; the message is one line."""


@dataclass(frozen=True)
class FileIdentity:
    """Identity of a file, which shows whether it is still the hashed one.

    Any user with write access can set the modification time. Only the kernel sets the change time: a write, a rename
    and a new modification time all advance it.
    """

    device: int
    inode: int
    size: int
    modified_ns: int
    changed_ns: int

    @classmethod
    def of(cls, path: Path) -> FileIdentity:
        """Return the identity of the file at a path; raises OSError."""
        return cls.from_stat(path.stat(follow_symlinks=False))

    @classmethod
    def from_stat(cls, found: os.stat_result) -> FileIdentity:
        """Return the identity of a file by its status."""
        return cls(found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns)


def seal(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """Return the manifest with the hash of its other content."""
    content = {key: value for key, value in manifest.items() if key != SEAL}
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return {**content, SEAL: hashlib.sha256(text.encode("ascii")).hexdigest()}


def read_manifest_bytes(directory: Path) -> bytes:
    """Read the manifest's bytes, unchecked; raises ArtifactError."""
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
    """Read the manifest as JSON; check its hash, version and sections; raises ArtifactError."""
    return parse_manifest(directory, read_manifest_bytes(directory))


def parse_manifest(directory: Path, raw: bytes) -> dict[str, Any]:
    """Parse a manifest's bytes; check its hash, version and sections; raises ArtifactError."""
    path = directory / MANIFEST_NAME
    try:
        manifest: Any = json.loads(raw, parse_constant=_refuse_constant)
        if _nesting(manifest) > MAX_NESTING:
            raise ArtifactError(f"{path}: nested deeper than {MAX_NESTING} levels, refused")
    except ArtifactError:
        raise
    except (ValueError, RecursionError) as error:
        raise ArtifactError(f"{path}: not JSON ({error})") from error
    try:
        check_integers(manifest)
    except ValueError as error:
        raise ArtifactError(f"{path}: {error}; export again") from error
    if not isinstance(manifest, dict):
        raise ArtifactError(f"{path}: expected a JSON object")
    version = manifest.get("schema_version")
    if version != SCHEMA_VERSION:
        older = type(version) is int and 0 < version < SCHEMA_VERSION
        advice = _older(directory, manifest) if older else "export again"
        raise ArtifactError(f"{path}: schema version {version!r}, expected {SCHEMA_VERSION}; {advice}")
    missing = [section for section in SECTIONS if section not in manifest]
    if missing:
        raise ArtifactError(f"{path}: sections {missing} are missing")
    if seal(manifest)[SEAL] != manifest[SEAL]:
        raise ArtifactError(f"{path}: sha256 of its content is not the one that it names; export again")
    return manifest


def _refuse_constant(text: str) -> float:
    raise ValueError(f"{text} is no number")


def _nesting(content: Any) -> int:
    """Return the depth of a JSON value, without recursion."""
    depth, level = 0, [content] if isinstance(content, dict | list) else []
    while level and depth <= MAX_NESTING:
        depth += 1
        parts = [value.values() if isinstance(value, dict) else value for value in level]
        level = [value for part in parts for value in part if isinstance(value, dict | list)]
    return depth


def _older(directory: Path, manifest: Mapping[str, Any]) -> str:
    """Return the advice for a manifest of an older release: the command that exports again."""
    asked = manifest.get("provenance")
    asked = asked.get("asked") if isinstance(asked, dict) else None
    named = [(key, asked.get(key) if isinstance(asked, dict) else None) for key in ("target", "model")]
    options = [f"--{key} {name} " for key, name in named if isinstance(name, str) and _PLAIN_NAME.fullmatch(name)]
    return (
        f"an older release wrote it, without a self-test; export again: edge-export {''.join(options)}--out {directory}"
    )


def check_entry(name: str, entry: Any) -> None:
    """Check that a listed file has a plain name of a permitted kind, a size and a hash; raises ArtifactError."""
    if not _PLAIN_NAME.fullmatch(name) or name in (MANIFEST_NAME, SIGNATURE_NAME):
        raise ArtifactError(f"{MANIFEST_NAME}: file name {name!r} is not a plain name")
    # All kinds of an export: an artifact directory contains nothing that could be run or unpickled.
    if not name.endswith(tuple(MAX_BYTES)):
        kinds = ", ".join(MAX_BYTES)
        raise ArtifactError(f"{MANIFEST_NAME}: file {name!r} is of no kind that artifacts have ({kinds})")
    if not isinstance(entry, dict) or type(entry.get("bytes")) is not int or not isinstance(entry.get("sha256"), str):
        raise ArtifactError(f"{MANIFEST_NAME}: entry of {name} must give bytes and sha256")
    most = next(most for suffix, most in MAX_BYTES.items() if name.endswith(suffix))
    if not 0 <= entry["bytes"] <= most:
        raise ArtifactError(f"{MANIFEST_NAME}: {name} has {entry['bytes']} bytes, expected at most {most}")


def check_files(files: Mapping[str, Any], data: Collection[str]) -> None:
    """Check every listed file and the sizes of all together; raises ArtifactError.

    `data`: the data files that the graphs name; they are mapped, all others are read into memory.
    """
    for name, entry in files.items():
        check_entry(name, entry)
        if name.endswith(".data") and name not in data:
            raise ArtifactError(f"{MANIFEST_NAME}: {name} is listed, but no graph names it; export again")
    for kind, most, names in (
        ("files", MAX_IN_MEMORY_BYTES, files.keys() - data),
        ("data files", MAX_DATA_BYTES, files.keys() & data),
    ):
        total = sum(files[name]["bytes"] for name in names)
        if total > most:
            raise ArtifactError(f"{MANIFEST_NAME}: {kind} of {total} bytes together, expected at most {most}")


def read_file(directory: Path, name: str, entry: Any) -> bytes:
    """Read a listed file and check its size and hash; raises ArtifactError."""
    check_entry(name, entry)
    path = directory / name
    with _open_listed(path, entry) as file:
        # One byte more than listed, so that the hash of a growing file differs.
        data = file.read(entry["bytes"] + 1)
    _compare(path, hashlib.sha256(data).hexdigest(), entry)
    for magic, kind in _REFUSED_CONTENT:
        if magic.match(data):
            raise ArtifactError(f"{path}: is {kind}, which is never opened; export again")
    return data


def hash_file(directory: Path, name: str, entry: Any) -> FileIdentity:
    """Verify a file that is too large for memory; return its identity."""
    check_entry(name, entry)
    path = directory / name
    digest = hashlib.sha256()
    with _open_listed(path, entry) as file:
        found = os.fstat(file.fileno())
        if found.st_nlink > 1:
            # The file is mapped while the robot drives: a second name could change it under the policy.
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
                raise ArtifactError(f"{path}: {size} bytes, the manifest lists {entry['bytes']}; export again")
            yield file
    except OSError as error:
        raise ArtifactError(f"{path}: missing or not a regular file ({error.strerror})") from error


def _open_regular(path: Path) -> IO[bytes]:
    """Open only a regular file for reading: never follow a link or wait for a pipe; raises OSError."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(None, "not a regular file")
    return os.fdopen(descriptor, "rb")


def _compare(path: Path, found: str, entry: Mapping[str, Any]) -> None:
    if found != entry["sha256"]:
        raise ArtifactError(f"{path}: sha256 {found[:12]}…, the manifest lists {entry['sha256'][:12]}…; export again")
