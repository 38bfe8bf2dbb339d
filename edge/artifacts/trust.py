"""Trust in signed artifacts: `manifest.sig`, an Ed25519 signature of the manifest and a release counter.

The manifest holds the SHA-256 of every other file, so a signature of its bytes is one of the whole directory. It is
optional: without a trusted key the hashes still find damage, but not an attacker who can rewrite the manifest as well.
With one (`edge-run --trust KEY.pub`), artifacts that are unsigned, signed by another key, or of an older release than
the last accepted one are refused before the manifest is parsed (fault matrix row 55). `edge.signature` makes keys and
signs.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import os
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edge.artifacts.files import SIGNATURE_NAME, ArtifactError

STATE_DIRECTORY = Path("/var/lib/tic-vla-edge")
"""Folder of the runner's persistent state in the units (systemd's StateDirectory)."""
MAX_RELEASE = 2**63 - 1
SCHEMA = 1
_CONTEXT = b"tic-vla-edge artifacts 1\0"  # a signature made for anything else is none here
_MAX_FILE_BYTES = 4096
_SIGNATURE_KEYS = {"schema": int, "key_id": str, "release": int, "signature": str}
_COUNTER_KEYS = {"schema": int, "key_id": str, "release": int}


class KeyFileError(ValueError):
    """An unusable key file; one line."""


@dataclass(frozen=True)
class Ed25519:
    """The used part of `cryptography`, loaded only for signing or trust."""

    private: Any
    public: Any
    serialization: Any
    invalid: type[Exception]


def ed25519_library() -> Ed25519:
    try:
        from cryptography.exceptions import InvalidSignature
        from cryptography.hazmat.primitives import serialization
        from cryptography.hazmat.primitives.asymmetric import ed25519
    except ImportError as error:
        raise KeyFileError(
            f"signatures need the package cryptography ({error}): pip install 'tic-vla-edge[sign]'"
        ) from error
    return Ed25519(ed25519.Ed25519PrivateKey, ed25519.Ed25519PublicKey, serialization, InvalidSignature)


def signed_message(manifest: bytes, release: int) -> bytes:
    return _CONTEXT + release.to_bytes(8, "big") + hashlib.sha256(manifest).digest()


def key_id_of(library: Ed25519, key: Any) -> str:
    form = library.serialization
    return hashlib.sha256(key.public_bytes(form.Encoding.Raw, form.PublicFormat.Raw)).hexdigest()[:16]


class Trust:
    """A public key on the robot, and the file that remembers the last release accepted under it.

    Raises KeyFileError when the key cannot be read: a robot that is configured to trust a key never runs without it.
    """

    def __init__(self, key_file: Path, counter_file: Path) -> None:
        self._library = ed25519_library()
        self._key_file = key_file
        self._counter_file = counter_file
        try:
            loaded = self._library.serialization.load_pem_public_key(read_small(key_file))
        except (OSError, ValueError) as error:
            raise KeyFileError(f"{key_file}: not a PEM public key that can be read ({first_line(error)})") from error
        if not isinstance(loaded, self._library.public):
            raise KeyFileError(f"{key_file}: expected an Ed25519 public key, found {type(loaded).__name__}")
        self._key = loaded
        self.key_id = key_id_of(self._library, loaded)

    def check(self, directory: Path, manifest: bytes) -> int:
        """Return the release of the signature beside a manifest; raises ArtifactError. Changes nothing."""
        path = directory / SIGNATURE_NAME
        if not path.exists() and not path.is_symlink():
            raise ArtifactError(
                f"{path}: missing, and {self._key_file} is the only key trusted here; sign the artifacts with it"
            )
        found = _read_record(path, _SIGNATURE_KEYS)
        release = int(found["release"])
        if found["key_id"] != self.key_id:
            raise ArtifactError(
                f"{path}: signed with the key {found['key_id'][:16]!r}, trusted is {self.key_id} ({self._key_file})"
            )
        try:
            signature = base64.b64decode(found["signature"], validate=True)
            self._key.verify(signature, signed_message(manifest, release))
        except (self._library.invalid, binascii.Error, ValueError) as error:
            raise ArtifactError(f"{path}: is not a signature of this manifest; sign again or copy again") from error
        last = self._last_release()
        if last is not None and release < last:
            raise ArtifactError(
                f"{path}: release {release} is older than {last}, which this robot has run; sign a newer release "
                f"(going back on purpose: remove {self._counter_file})"
            )
        return release

    def accept(self, release: int) -> None:
        """Store that a release was accepted; raises ArtifactError when that fails."""
        last = self._last_release()
        if last is not None and last >= release:
            return
        record = {"schema": SCHEMA, "key_id": self.key_id, "release": release}
        try:
            self._counter_file.parent.mkdir(parents=True, exist_ok=True)
            write_durably(self._counter_file, json.dumps(record) + "\n", 0o644)
        except OSError as error:
            raise ArtifactError(
                f"{self._counter_file}: the accepted release cannot be remembered ({error.strerror}); "
                "give the runner a state directory that it may write to"
            ) from error

    def _last_release(self) -> int | None:
        if not self._counter_file.exists() and not self._counter_file.is_symlink():
            return None
        found = _read_record(self._counter_file, _COUNTER_KEYS)
        # Each key has its own sequence of releases.
        return int(found["release"]) if found["key_id"] == self.key_id else None


def read_small(path: Path) -> bytes:
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    with os.fdopen(descriptor, "rb") as file:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(None, "not a regular file")
        data = file.read(_MAX_FILE_BYTES + 1)
    if len(data) > _MAX_FILE_BYTES:
        raise OSError(None, f"larger than {_MAX_FILE_BYTES} bytes")
    return data


def _read_record(path: Path, keys: dict[str, type]) -> dict[str, Any]:
    """Read a small JSON object with exactly these keys; raises ArtifactError."""
    try:
        found: Any = json.loads(read_small(path))
    except OSError as error:
        raise ArtifactError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise ArtifactError(f"{path}: not JSON ({first_line(error)})") from error
    sound = (
        isinstance(found, dict)
        and set(found) == set(keys)
        and all(type(found[key]) is kind for key, kind in keys.items())
        and found["schema"] == SCHEMA
        and 0 < found["release"] <= MAX_RELEASE
    )
    if not sound:
        raise ArtifactError(f"{path}: expected an object of {', '.join(keys)} with schema {SCHEMA}")
    return dict(found)


def write_durably(path: Path, text: str, mode: int) -> None:
    """Write a file atomically: after a power cut the old or the new content is complete; raises OSError."""
    partial = path.with_name(path.name + ".partial")
    try:
        descriptor = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC | os.O_NOFOLLOW, mode)
        with os.fdopen(descriptor, "w", encoding="utf-8") as file:
            os.fchmod(descriptor, mode)
            file.write(text)
            file.flush()
            os.fsync(descriptor)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def first_line(error: Exception) -> str:
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return text.splitlines()[0] if text else type(error).__name__
