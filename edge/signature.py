"""Sign artifacts: make keys, write `manifest.sig` and check it as a robot does (`edge.artifacts.trust`).

Keys are PEM files that OpenSSL reads too. The counter belongs to the key: number the releases that a key signs in one
row, whatever the model (a date such as 20260131 will do).
"""

from __future__ import annotations

import argparse
import base64
import json
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from edge.artifacts.files import SIGNATURE_NAME, ArtifactError, parse_manifest, read_manifest_bytes
from edge.artifacts.manifest import load_artifacts
from edge.artifacts.trust import (
    MAX_RELEASE,
    SCHEMA,
    KeyFileError,
    Trust,
    ed25519_library,
    first_line,
    key_id_of,
    read_small,
    signed_message,
    write_durably,
)
from edge.core.cli import EXIT_BAD_INPUT, EXIT_DONE, EXIT_REFUSED, check_result_target, command_line, write_result
from firmware_bridge.system.terminal import CommandParser, one_line

EXAMPLES = """examples:
  python -m edge.signature keygen --key release.pem           # also writes release.pem.pub, which goes to the robots
  python -m edge.signature sign out/orin --key release.pem --release 20260131
  python -m edge.signature verify out/orin --trust release.pem.pub

exit codes: 0 done, 2 bad arguments or input, 3 refused (artifacts, signature)
"""


def keygen(key_file: Path) -> str:
    """Write a new private key, readable by its owner alone, and `FILE.pub`; returns the key id. Never overwrites."""
    library = ed25519_library()
    form = library.serialization
    if not key_file.name:
        raise KeyFileError(f"--key {key_file}: expected the name of a file")
    public_file = key_file.with_name(key_file.name + ".pub")
    for path in (key_file, public_file):
        if path.exists() or path.is_symlink():
            raise KeyFileError(f"{path}: exists; a key is never overwritten, name another file")
    key = library.private.generate()
    secret = key.private_bytes(form.Encoding.PEM, form.PrivateFormat.PKCS8, form.NoEncryption())
    public = key.public_key().public_bytes(form.Encoding.PEM, form.PublicFormat.SubjectPublicKeyInfo)
    write_durably(key_file, secret.decode("ascii"), 0o600)
    write_durably(public_file, public.decode("ascii"), 0o644)
    return key_id_of(library, key.public_key())


def sign(directory: Path, key_file: Path, release: int) -> str:
    """Sign a directory's manifest as a release; returns the key id. Raises ArtifactError or KeyFileError."""
    if not 0 < release <= MAX_RELEASE:
        raise KeyFileError(f"--release {release}: expected a number from 1 on that grows with every release")
    manifest = read_manifest_bytes(directory)
    parse_manifest(directory, manifest)  # what is damaged is not signed
    library = ed25519_library()
    try:
        key = library.serialization.load_pem_private_key(read_small(key_file), password=None)
    except (OSError, ValueError, TypeError) as error:  # TypeError: it needs a passphrase
        raise KeyFileError(f"{key_file}: not a PEM private key that can be read ({first_line(error)})") from error
    if not isinstance(key, library.private):
        raise KeyFileError(f"{key_file}: expected an Ed25519 private key, found {type(key).__name__}")
    key_id = key_id_of(library, key.public_key())
    signature = base64.b64encode(key.sign(signed_message(manifest, release))).decode("ascii")
    record = {"schema": SCHEMA, "key_id": key_id, "release": release, "signature": signature}
    write_durably(directory / SIGNATURE_NAME, json.dumps(record, indent=1) + "\n", 0o644)
    return key_id


def parser() -> argparse.ArgumentParser:
    """Command line of `python -m edge.signature`."""
    p = CommandParser(
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


def _check_json(args: argparse.Namespace) -> None:
    """Refuse a result that would replace a key or a file of the artifacts. Raises KeyFileError or OSError."""
    check_result_target(args.json)
    if args.json in (None, "-"):
        return
    target = Path(os.path.realpath(args.json))
    key, directory = vars(args).get("key"), vars(args).get("directory")
    keys = [each for each in (key, vars(args).get("trust"), key and f"{key}.pub") if each is not None]
    if target in [Path(os.path.realpath(each)) for each in keys]:
        raise KeyFileError(f"--json {args.json}: is a key file, which the result would replace; name another file")
    if directory is not None and Path(os.path.realpath(directory)) in target.parents:
        raise KeyFileError(f"--json {args.json}: lies in the artifact directory; name a file outside it")


@command_line("signature")
def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    args = parser().parse_args(argv)
    started_ns = time.monotonic_ns()
    try:
        _check_json(args)
        if args.command == "keygen":
            result: dict[str, Any] = {"key": str(args.key), "key_id": keygen(args.key)}
        elif args.command == "sign":
            result = {"release": args.release, "key_id": sign(args.directory, args.key, args.release)}
        else:
            result = _verify(args.directory, args.trust)
        sys.stderr.write(f"signature: {args.command} done: {', '.join(f'{k} {v}' for k, v in result.items())}\n")
        write_result(args.json, {**result, "wall_s": round((time.monotonic_ns() - started_ns) / 1e9, 3)})
    except ArtifactError as error:
        sys.stderr.write(f"signature: {one_line(error)}\n")
        return EXIT_REFUSED
    except (KeyFileError, OSError) as error:
        sys.stderr.write(f"signature: {one_line(error)}\n")
        return EXIT_BAD_INPUT
    return EXIT_DONE


def _verify(directory: Path, key_file: Path) -> dict[str, Any]:
    class _Once(Trust):
        """Trust of a robot that has not run any release yet."""

        def accept(self, release: int) -> None:
            """Store nothing."""

    trust = _Once(key_file, directory / "no-counter" / "release.json")
    return {"release": load_artifacts(directory.absolute(), trust).release, "key_id": trust.key_id}


if __name__ == "__main__":
    sys.exit(main())
