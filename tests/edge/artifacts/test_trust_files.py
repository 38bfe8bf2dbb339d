"""The small files of trust: what is signed, which records and counters are accepted, and how they reach the disk."""

from __future__ import annotations

import hashlib
import json
import os
import stat
import struct
from pathlib import Path
from typing import Any

import pytest

from edge.artifacts import trust as module
from edge.artifacts.files import ArtifactError
from edge.artifacts.trust import (
    MAX_RELEASE,
    KeyFileError,
    Trust,
    first_line,
    read_small,
    signed_message,
    write_durably,
)
from edge.signature import keygen, sign

pytest.importorskip("cryptography")

MANIFEST = b'{"schema_version": 4}'
SHAPE = "expected an object of schema, key_id, release, signature with schema 1"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a manifest and a key, in which signing needs no whole artifacts."""
    monkeypatch.setattr("edge.signature.parse_manifest", lambda *_: None)
    (tmp_path / "manifest.json").write_bytes(MANIFEST)
    keygen(tmp_path / "key")
    return tmp_path


@pytest.fixture
def trust(folder: Path) -> Trust:
    return Trust(folder / "key.pub", folder / "state" / "of" / "release.json")


def record(folder: Path) -> dict[str, Any]:
    return dict(json.loads((folder / "manifest.sig").read_text()))


# What is signed


def test_context_release_and_hash_of_the_manifest_are_signed() -> None:
    expected = b"tic-vla-edge artifacts 1\0" + struct.pack(">Q", 258) + hashlib.sha256(MANIFEST).digest()
    assert signed_message(MANIFEST, 258) == expected


def test_a_key_is_known_by_sixteen_digits(trust: Trust) -> None:
    assert len(trust.key_id) == 16
    int(trust.key_id, 16)


def test_releases_are_numbered_up_to_the_largest_of_64_bits_with_a_sign(folder: Path, trust: Trust) -> None:
    sign(folder, folder / "key", 2**63 - 1)
    assert trust.check(folder, MANIFEST) == 2**63 - 1 == MAX_RELEASE
    with pytest.raises(KeyFileError, match="--release 9223372036854775808"):
        sign(folder, folder / "key", 2**63)


# Records


@pytest.mark.parametrize(
    "values",
    [{"release": 0}, {"release": -1}, {"release": 2**63}, {"release": True}, {"schema": 2}, {"key_id": 1}, {"more": 1}],
    ids=str,
)
def test_a_record_of_another_shape_is_refused_for_its_shape(folder: Path, trust: Trust, values: dict[str, Any]) -> None:
    sign(folder, folder / "key", 1)
    (folder / "manifest.sig").write_text(json.dumps({**record(folder), **values}))
    with pytest.raises(ArtifactError, match=SHAPE):
        trust.check(folder, MANIFEST)


@pytest.mark.parametrize("text", ["5", "null", '"text"', "[]", "[[]]"])
def test_a_record_that_is_no_object_is_refused_for_its_shape(folder: Path, trust: Trust, text: str) -> None:
    (folder / "manifest.sig").write_text(text)
    with pytest.raises(ArtifactError, match=SHAPE):
        trust.check(folder, MANIFEST)


def test_a_signature_with_a_foreign_character_is_refused(folder: Path, trust: Trust) -> None:
    sign(folder, folder / "key", 1)
    text = record(folder)["signature"]
    (folder / "manifest.sig").write_text(json.dumps({**record(folder), "signature": f"{text[:8]}!{text[8:]}"}))
    with pytest.raises(ArtifactError, match="not a signature"):
        trust.check(folder, MANIFEST)


# The counter


def counter(folder: Path) -> Path:
    return folder / "state" / "of" / "release.json"


def test_the_counter_is_made_with_its_folders_and_everybody_may_read_it(folder: Path, trust: Trust) -> None:
    before = os.umask(0o077)
    try:
        trust.accept(7)
    finally:
        os.umask(before)
    assert json.loads(counter(folder).read_text()) == {"schema": 1, "key_id": trust.key_id, "release": 7}
    assert counter(folder).stat().st_mode & 0o7777 == 0o644


@pytest.mark.parametrize("release", [7, 6])
def test_the_counter_is_not_written_again_for_a_release_that_is_not_newer(
    folder: Path, trust: Trust, monkeypatch: pytest.MonkeyPatch, release: int
) -> None:
    trust.accept(7)
    monkeypatch.setattr(module, "write_durably", lambda *_: pytest.fail("written"))
    trust.accept(release)
    assert json.loads(counter(folder).read_text())["release"] == 7


def test_a_newer_release_replaces_the_older_one(folder: Path, trust: Trust) -> None:
    for release in (7, 8):
        trust.accept(release)
    assert json.loads(counter(folder).read_text())["release"] == 8


# Reading and writing


@pytest.mark.parametrize(("size", "message"), [(4096, None), (4097, "larger than 4096 bytes"), (9000, "larger")])
def test_a_file_is_read_up_to_4096_bytes(tmp_path: Path, size: int, message: str | None) -> None:
    (tmp_path / "file").write_bytes(b"x" * size)
    if message is None:
        assert read_small(tmp_path / "file") == b"x" * size
        return
    with pytest.raises(OSError, match=message):
        read_small(tmp_path / "file")


def test_no_more_than_one_byte_beyond_the_limit_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_bytes(b"x" * 9000)
    read: list[int] = []
    opened = os.fdopen

    class Counting:
        def __init__(self, descriptor: int, mode: str) -> None:
            self.file = opened(descriptor, mode)

        def __enter__(self) -> Counting:
            return self

        def __exit__(self, *_: object) -> None:
            self.file.close()

        def read(self, size: int) -> bytes:
            read.append(size)
            return bytes(self.file.read(size))

    monkeypatch.setattr(module.os, "fdopen", Counting)
    with pytest.raises(OSError, match="larger"):
        read_small(tmp_path / "file")
    assert read == [4097]


def test_what_is_no_regular_file_is_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match="not a regular file"):
        read_small(tmp_path / "pipe")


def test_the_content_is_on_the_disk_before_its_name_and_the_name_before_the_return(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    events: list[object] = []

    def fsync(descriptor: int) -> None:
        status = os.fstat(descriptor)
        events.append("folder" if stat.S_ISDIR(status.st_mode) else status.st_size)

    replace = Path.replace
    monkeypatch.setattr(module.os, "fsync", fsync)
    monkeypatch.setattr(Path, "replace", lambda one, two: (events.append("named"), replace(one, two))[1])
    write_durably(tmp_path / "file", "12345", 0o600)
    assert events == [5, "named", "folder"]
    assert (tmp_path / "file").read_text() == "12345"


@pytest.mark.parametrize("fails", [False, True])
def test_neither_a_descriptor_nor_a_partial_file_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fails: bool
) -> None:
    def full(_descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    before = list(Path("/proc/self/fd").iterdir())
    if fails:
        monkeypatch.setattr(module.os, "fsync", full)
        with pytest.raises(OSError, match="No space left"):
            write_durably(tmp_path / "file", "12345", 0o600)
    else:
        write_durably(tmp_path / "file", "12345", 0o600)
    assert len(list(Path("/proc/self/fd").iterdir())) == len(before)
    assert [path.name for path in tmp_path.iterdir()] == ([] if fails else ["file"])


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (OSError(2, "No such file"), "No such file"),
        (OSError("odd"), "odd"),
        (ValueError("first\nsecond"), "first"),
        (ValueError(), "ValueError"),
    ],
)
def test_an_error_is_told_in_one_line(error: Exception, line: str) -> None:
    assert first_line(error) == line
