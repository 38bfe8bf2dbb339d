"""Signed artifacts: `manifest.sig`, an Ed25519 signature of the manifest and a release counter that may not go back.

The manifest holds the SHA-256 of every other file, so a signature of its bytes is one of the whole directory. It is
optional: without a trusted key the hashes still find damage, but not somebody who can rewrite the manifest as well.
With one (`edge-run --trust KEY.pub`), artifacts that are unsigned, signed by another key, or of an older release than
the last accepted one are refused before the manifest is parsed (fault matrix row 55).

Keys are PEM files that OpenSSL reads too. The counter belongs to the key: number the releases that a key signs in one
row, whatever the model (a date such as 20260131 will do).
"""

from __future__ import annotations

import argparse
import base64
import binascii
import hashlib
import json
import os
import stat
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edge.artifact_files import SIGNATURE_NAME, ArtifactError, parse_manifest, read_manifest_bytes
from edge.cli import EXIT_BAD_INPUT, EXIT_DONE, EXIT_REFUSED, check_result_target, command_line, write_result

STATE_DIRECTORY = Path("/var/lib/tic-vla-edge")
"""Where the units keep what the runner has to remember (systemd's StateDirectory)."""
MAX_RELEASE = 2**63 - 1
_SCHEMA = 1
_CONTEXT = b"tic-vla-edge artifacts 1\0"  # a signature made for anything else is none here
_MAX_FILE_BYTES = 4096
_SIGNATURE_KEYS = {"schema": int, "key_id": str, "release": int, "signature": str}
_COUNTER_KEYS = {"schema": int, "key_id": str, "release": int}

EXAMPLES = """examples:
  python -m edge.signature keygen --key release.pem           # also writes release.pem.pub, which goes to the robots
  python -m edge.signature sign out/orin --key release.pem --release 20260131
  python -m edge.signature verify out/orin --trust release.pem.pub

exit codes: 0 done, 2 bad arguments or input, 3 refused (artifacts, signature)
"""


class KeyFileError(ValueError):
    """A key file that cannot be used; one line."""


@dataclass(frozen=True)
class _Ed25519:
    """The part of `cryptography` that is used, loaded only by those who sign or trust."""

    private: Any
    public: Any
    serialization: Any
    invalid: type[Exception]


def _library() -> _Ed25519:
    try:
        from cryptography.exceptions import InvalidSignature
        from cryptography.hazmat.primitives import serialization
        from cryptography.hazmat.primitives.asymmetric import ed25519
    except ImportError as error:
        raise KeyFileError(
            f"signatures need the package cryptography ({error}): pip install 'tic-vla-edge[sign]'"
        ) from error
    return _Ed25519(ed25519.Ed25519PrivateKey, ed25519.Ed25519PublicKey, serialization, InvalidSignature)


def _message(manifest: bytes, release: int) -> bytes:
    return _CONTEXT + release.to_bytes(8, "big") + hashlib.sha256(manifest).digest()


def _key_id(library: _Ed25519, key: Any) -> str:
    form = library.serialization
    return hashlib.sha256(key.public_bytes(form.Encoding.Raw, form.PublicFormat.Raw)).hexdigest()[:16]


class Trust:
    """A public key on the robot, and the file that remembers the last release accepted under it.

    Raises KeyFileError when the key cannot be read: a robot told to trust a key never goes on without it.
    """

    def __init__(self, key_file: Path, counter_file: Path) -> None:
        self._library = _library()
        self._key_file = key_file
        self._counter_file = counter_file
        try:
            loaded = self._library.serialization.load_pem_public_key(_read_small(key_file))
        except (OSError, ValueError) as error:
            raise KeyFileError(f"{key_file}: not a PEM public key that can be read ({_first_line(error)})") from error
        if not isinstance(loaded, self._library.public):
            raise KeyFileError(f"{key_file}: expected an Ed25519 public key, found {type(loaded).__name__}")
        self._key = loaded
        self.key_id = _key_id(self._library, loaded)

    def check(self, directory: Path, manifest: bytes) -> int:
        """The release that the signature beside a manifest names; raises ArtifactError. Changes nothing."""
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
            self._key.verify(signature, _message(manifest, release))
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
        """Remember that a release has been accepted; raises ArtifactError when that is not possible."""
        last = self._last_release()
        if last is not None and last >= release:
            return
        record = {"schema": _SCHEMA, "key_id": self.key_id, "release": release}
        try:
            self._counter_file.parent.mkdir(parents=True, exist_ok=True)
            _write_durably(self._counter_file, json.dumps(record) + "\n", 0o644)
        except OSError as error:
            raise ArtifactError(
                f"{self._counter_file}: the accepted release cannot be remembered ({error.strerror}); "
                "give the runner a state directory that it may write to"
            ) from error

    def _last_release(self) -> int | None:
        if not self._counter_file.exists() and not self._counter_file.is_symlink():
            return None
        found = _read_record(self._counter_file, _COUNTER_KEYS)
        # Another key is another row of releases.
        return int(found["release"]) if found["key_id"] == self.key_id else None


def keygen(key_file: Path) -> str:
    """Write a new private key, readable by its owner alone, and `FILE.pub`; returns the key id. Never overwrites."""
    library = _library()
    form = library.serialization
    public_file = key_file.with_name(key_file.name + ".pub")
    for path in (key_file, public_file):
        if path.exists() or path.is_symlink():
            raise KeyFileError(f"{path}: exists; a key is never overwritten, name another file")
    key = library.private.generate()
    secret = key.private_bytes(form.Encoding.PEM, form.PrivateFormat.PKCS8, form.NoEncryption())
    public = key.public_key().public_bytes(form.Encoding.PEM, form.PublicFormat.SubjectPublicKeyInfo)
    _write_durably(key_file, secret.decode("ascii"), 0o600)
    _write_durably(public_file, public.decode("ascii"), 0o644)
    return _key_id(library, key.public_key())


def sign(directory: Path, key_file: Path, release: int) -> str:
    """Sign a directory's manifest as a release; returns the key id. Raises ArtifactError or KeyFileError."""
    if not 0 < release <= MAX_RELEASE:
        raise KeyFileError(f"--release {release}: expected a number from 1 on that grows with every release")
    library = _library()
    try:
        key = library.serialization.load_pem_private_key(_read_small(key_file), password=None)
    except (OSError, ValueError, TypeError) as error:  # TypeError: it needs a passphrase
        raise KeyFileError(f"{key_file}: not a PEM private key that can be read ({_first_line(error)})") from error
    if not isinstance(key, library.private):
        raise KeyFileError(f"{key_file}: expected an Ed25519 private key, found {type(key).__name__}")
    manifest = read_manifest_bytes(directory)
    parse_manifest(directory, manifest)  # what is damaged is not signed
    key_id = _key_id(library, key.public_key())
    signature = base64.b64encode(key.sign(_message(manifest, release))).decode("ascii")
    record = {"schema": _SCHEMA, "key_id": key_id, "release": release, "signature": signature}
    _write_durably(directory / SIGNATURE_NAME, json.dumps(record, indent=1) + "\n", 0o644)
    return key_id


def _read_small(path: Path) -> bytes:
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    with os.fdopen(descriptor, "rb") as file:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(None, "not a regular file")
        data = file.read(_MAX_FILE_BYTES + 1)
    if len(data) > _MAX_FILE_BYTES:
        raise OSError(None, f"larger than {_MAX_FILE_BYTES} bytes")
    return data


def _read_record(path: Path, keys: dict[str, type]) -> dict[str, Any]:
    """A small JSON object of exactly these keys; raises ArtifactError."""
    try:
        found: Any = json.loads(_read_small(path))
    except OSError as error:
        raise ArtifactError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise ArtifactError(f"{path}: not JSON ({_first_line(error)})") from error
    sound = (
        isinstance(found, dict)
        and set(found) == set(keys)
        and all(type(found[key]) is kind for key, kind in keys.items())
        and found["schema"] == _SCHEMA
        and 0 < found["release"] <= MAX_RELEASE
    )
    if not sound:
        raise ArtifactError(f"{path}: expected an object of {', '.join(keys)} with schema {_SCHEMA}")
    return dict(found)


def _write_durably(path: Path, text: str, mode: int) -> None:
    """Write a file so that after a power cut the old one or the new one is there, whole; raises OSError."""
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


def _first_line(error: Exception) -> str:
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    return text.splitlines()[0] if text else type(error).__name__


def parser() -> argparse.ArgumentParser:
    """Command line of `python -m edge.signature`."""
    p = argparse.ArgumentParser(
        "python -m edge.signature",
        description="Sign artifacts, and check signatures as a robot does.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = p.add_subparsers(dest="command", required=True)
    make = commands.add_parser("keygen", help="make a key pair")
    signing = commands.add_parser("sign", help="write DIR/manifest.sig")
    verifying = commands.add_parser("verify", help="check DIR/manifest.sig and every file")
    for command in (make, signing):
        command.add_argument("--key", type=Path, required=True, metavar="FILE", help="private key (PEM, Ed25519)")
    for command in (signing, verifying):
        command.add_argument("directory", type=Path, metavar="DIR", help="artifact directory")
    signing.add_argument("--release", type=int, required=True, metavar="N", help="number that grows with every release")
    verifying.add_argument("--trust", type=Path, required=True, metavar="KEY.pub", help="public key (PEM, Ed25519)")
    for command in (make, signing, verifying):
        command.add_argument("--json", metavar="FILE|-", help="write the result as JSON")
    return p


@command_line("signature")
def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    started_ns = time.monotonic_ns()
    try:
        check_result_target(args.json)
        if args.command == "keygen":
            result: dict[str, Any] = {"key": str(args.key), "key_id": keygen(args.key)}
        elif args.command == "sign":
            result = {"release": args.release, "key_id": sign(args.directory, args.key, args.release)}
        else:
            result = _verify(args.directory, args.trust)
        sys.stderr.write(f"signature: {args.command} done: {', '.join(f'{k} {v}' for k, v in result.items())}\n")
        write_result(args.json, {**result, "wall_s": round((time.monotonic_ns() - started_ns) / 1e9, 3)})
    except ArtifactError as error:
        sys.stderr.write(f"signature: {error}\n")
        return EXIT_REFUSED
    except (KeyFileError, OSError) as error:
        sys.stderr.write(f"signature: {error}\n")
        return EXIT_BAD_INPUT
    return EXIT_DONE


def _verify(directory: Path, key_file: Path) -> dict[str, Any]:
    from edge.manifest import load_artifacts  # it knows this module

    class _Once(Trust):
        """Checks as a robot would that has never run anything."""

        def accept(self, release: int) -> None:
            """Nothing to remember here."""

    trust = _Once(key_file, directory / "no-counter" / "release.json")
    return {"release": load_artifacts(directory.absolute(), trust).release, "key_id": trust.key_id}


if __name__ == "__main__":
    sys.exit(main())
