"""A robot that trusts a key runs what that key has signed, never an older release, and nothing else."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from edge import signature
from edge.artifacts.files import ArtifactError
from edge.artifacts.manifest import load_artifacts
from edge.artifacts.trust import KeyFileError, Trust
from edge.signature import keygen, main, sign
from tests.support.artifact_directory import edit_manifest

pytest.importorskip("cryptography")


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the key pairs `ours` and `theirs`."""
    folder = tmp_path_factory.mktemp("keys")
    for name in ("ours", "theirs"):
        keygen(folder / name)
    return folder


@pytest.fixture
def copy(artifacts_dir: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(artifacts_dir, tmp_path / "nano"))


@pytest.fixture
def trust(keys: Path, tmp_path: Path) -> Trust:
    return Trust(keys / "ours.pub", tmp_path / "state" / "release.json")


@pytest.fixture
def signed(copy: Path, keys: Path) -> Path:
    """Artifacts that the trusted key has signed as release 7."""
    sign(copy, keys / "ours", 7)
    return copy


def change(directory: Path, **values: Any) -> None:
    path = directory / "manifest.sig"
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))


@pytest.mark.slow
def test_signed_artifacts_are_accepted_and_name_their_release(signed: Path, trust: Trust) -> None:
    assert load_artifacts(signed, trust).release == 7


def test_without_a_trusted_key_a_signature_changes_nothing(copy: Path, keys: Path) -> None:
    sign(copy, keys / "theirs", 7)
    assert load_artifacts(copy).release is None


MISSHAPEN: list[dict[str, Any]] = [
    {"release": 0}, {"release": "9"}, {"release": 2**64}, {"signature": "!"}, {"signature": ""}, {"schema": 2},
    {"extra": 1}, {"key_id": None},
]  # fmt: skip


@pytest.mark.parametrize(
    ("key", "values", "message"),
    [
        (None, {}, r"manifest\.sig: missing"),
        ("theirs", {}, "signed with the key"),
        ("theirs", {"key_id": "ours"}, "not a signature of this manifest"),
        ("ours", {"release": 8}, "not a signature of this manifest"),
        *(("ours", values, r"manifest\.sig") for values in MISSHAPEN),
    ],
    ids=str,
)
def test_artifacts_without_a_signature_by_the_trusted_key_are_refused_in_one_line(
    copy: Path, keys: Path, trust: Trust, key: str | None, values: dict[str, Any], message: str
) -> None:
    if key is not None:
        sign(copy, keys / key, 7)
        change(copy, **{name: trust.key_id if value == "ours" else value for name, value in values.items()})
    with pytest.raises(ArtifactError, match=message) as refusal:
        load_artifacts(copy, trust)
    assert "\n" not in str(refusal.value)


def test_a_manifest_that_was_changed_and_sealed_again_is_refused_before_it_is_parsed(
    signed: Path, trust: Trust, monkeypatch: pytest.MonkeyPatch
) -> None:
    edit_manifest(signed, lambda m: m["runtime"].update(tick_period_ms=900))
    monkeypatch.setattr("edge.artifacts.manifest.parse_manifest", lambda *_: pytest.fail("parsed"))
    with pytest.raises(ArtifactError, match="not a signature of this manifest"):
        load_artifacts(signed, trust)


def test_a_signature_of_another_directory_is_refused(copy: Path, keys: Path, trust: Trust, tmp_path: Path) -> None:
    other = Path(shutil.copytree(copy, tmp_path / "other"))
    edit_manifest(other, lambda m: m.update(target="orin"))
    sign(other, keys / "ours", 7)
    shutil.copy(other / "manifest.sig", copy)
    with pytest.raises(ArtifactError, match="not a signature of this manifest"):
        load_artifacts(copy, trust)


@pytest.mark.slow
def test_an_older_release_than_the_last_accepted_one_is_refused(copy: Path, keys: Path, trust: Trust) -> None:
    for release in (7, 9, 9):
        sign(copy, keys / "ours", release)
        assert load_artifacts(copy, trust).release == release
    sign(copy, keys / "ours", 8)
    with pytest.raises(ArtifactError, match="release 8 is older than 9"):
        load_artifacts(copy, trust)


@pytest.mark.slow
def test_a_release_that_is_refused_for_another_reason_is_not_remembered(copy: Path, keys: Path, trust: Trust) -> None:
    sign(copy, keys / "ours", 9)
    whole = (copy / "tokenizer.json").read_bytes()
    (copy / "tokenizer.json").write_bytes(b"x" + whole[1:])
    with pytest.raises(ArtifactError, match=r"tokenizer\.json: sha256"):
        load_artifacts(copy, trust)
    (copy / "tokenizer.json").write_bytes(whole)
    sign(copy, keys / "ours", 8)
    assert load_artifacts(copy, trust).release == 8


@pytest.mark.slow
def test_a_robot_that_comes_to_trust_a_new_key_starts_a_new_row(copy: Path, keys: Path, tmp_path: Path) -> None:
    counter = tmp_path / "release.json"
    sign(copy, keys / "ours", 9)
    load_artifacts(copy, Trust(keys / "ours.pub", counter))
    sign(copy, keys / "theirs", 1)
    assert load_artifacts(copy, Trust(keys / "theirs.pub", counter)).release == 1


@pytest.mark.parametrize("content", ["", "{}", "[]", '{"schema": 1, "key_id": "x", "release": true}', "x" * 9000])
def test_a_damaged_counter_is_no_reason_to_go_back(signed: Path, keys: Path, tmp_path: Path, content: str) -> None:
    counter = tmp_path / "release.json"
    counter.write_text(content)
    with pytest.raises(ArtifactError, match=r"release\.json"):
        load_artifacts(signed, Trust(keys / "ours.pub", counter))


def test_a_counter_that_cannot_be_kept_is_a_refusal(signed: Path, keys: Path, tmp_path: Path) -> None:
    (tmp_path / "state").write_text("a file where the state directory should be")
    with pytest.raises(ArtifactError, match="cannot be remembered"):
        load_artifacts(signed, Trust(keys / "ours.pub", tmp_path / "state" / "release.json"))


@pytest.mark.slow
@pytest.mark.parametrize("step", ["fsync", "replace"])
def test_a_power_cut_while_the_counter_is_written_leaves_the_old_one(
    signed: Path, keys: Path, trust: Trust, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    load_artifacts(signed, trust)
    sign(signed, keys / "ours", 8)

    class PowerCutError(BaseException):
        pass

    def cut(*_: object) -> None:
        raise PowerCutError

    with monkeypatch.context() as patch:
        patch.setattr(*((os, "fsync") if step == "fsync" else (Path, "replace")), cut)
        with pytest.raises(PowerCutError):
            load_artifacts(signed, trust)
    assert json.loads((tmp_path / "state" / "release.json").read_text())["release"] == 7
    assert load_artifacts(signed, trust).release == 8


def test_a_key_that_is_none_is_never_trusted(tmp_path: Path, keys: Path) -> None:
    (tmp_path / "empty.pub").touch()
    for file in (tmp_path / "empty.pub", tmp_path / "none", keys / "ours"):
        with pytest.raises(KeyFileError, match="not a PEM"):
            Trust(file, tmp_path / "release.json")


def test_a_key_of_another_kind_is_refused_by_name(tmp_path: Path) -> None:
    from cryptography.hazmat.primitives import serialization as form
    from cryptography.hazmat.primitives.asymmetric import ec

    public = ec.generate_private_key(ec.SECP256R1()).public_key()
    pem = public.public_bytes(form.Encoding.PEM, form.PublicFormat.SubjectPublicKeyInfo)
    (tmp_path / "ec.pub").write_bytes(pem)
    with pytest.raises(KeyFileError, match="expected an Ed25519 public key"):
        Trust(tmp_path / "ec.pub", tmp_path / "release.json")


def test_a_private_key_is_for_its_owner_alone_and_never_overwritten(keys: Path) -> None:
    assert (keys / "ours").stat().st_mode & 0o777 == 0o600
    with pytest.raises(KeyFileError, match="never overwritten"):
        keygen(keys / "ours")


def test_damaged_artifacts_are_not_signed(copy: Path, keys: Path) -> None:
    (copy / "manifest.json").write_text("{}")
    with pytest.raises(ArtifactError):
        sign(copy, keys / "ours", 1)
    assert not (copy / "manifest.sig").exists()


@pytest.mark.slow
def test_the_command_makes_a_key_signs_and_verifies(
    copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    key = tmp_path / "release.pem"
    assert main(["keygen", "--key", str(key)]) == 0
    assert main(["sign", str(copy), "--key", str(key), "--release", "20260131"]) == 0
    assert main(["verify", str(copy), "--trust", f"{key}.pub", "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["release"] == 20260131
    assert main(["verify", str(copy), "--trust", str(key)]) == 2
    assert main(["sign", str(copy), "--key", str(key), "--release", "0"]) == 2
    (copy / "manifest.sig").unlink()
    assert main(["verify", str(copy), "--trust", f"{key}.pub"]) == 3
    assert {path.name for path in tmp_path.iterdir()} == {"nano", "release.pem", "release.pem.pub"}


def test_a_missing_package_is_named_with_its_install_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "cryptography.exceptions", None)
    assert signature.main(["keygen", "--key", str(tmp_path / "key")]) == 2
    assert "tic-vla-edge[sign]" in capsys.readouterr().err


def test_a_run_without_signatures_does_not_load_the_package() -> None:
    code = "import edge.artifacts.manifest, edge.flightlog.recorder, sys; sys.exit('cryptography' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=300)
