"""`python -m edge.signature`: what it writes, prints and refuses."""

from __future__ import annotations

import itertools
import json
import shutil
from pathlib import Path

import pytest

from edge import signature
from edge.artifacts.trust import MAX_RELEASE, KeyFileError, Trust
from edge.signature import keygen, main, sign

pytest.importorskip("cryptography")

Capture = pytest.CaptureFixture[str]


@pytest.fixture
def key(tmp_path: Path) -> Path:
    keygen(tmp_path / "release.pem")
    return tmp_path / "release.pem"


@pytest.fixture
def copy(artifacts_dir: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(artifacts_dir, tmp_path / "nano"))


def refused(arguments: list[str], capsys: Capture) -> str:
    """The message of a command line that argparse refuses."""
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 2
    return capsys.readouterr().err


def test_both_commands_return_the_id_by_which_a_robot_knows_the_key(copy: Path, tmp_path: Path) -> None:
    made = keygen(tmp_path / "ours")
    assert made == sign(copy, tmp_path / "ours", 1) == Trust(tmp_path / "ours.pub", tmp_path / "counter").key_id


def test_everybody_may_read_what_is_public(copy: Path, key: Path) -> None:
    sign(copy, key, 1)
    for path in (key.with_name("release.pem.pub"), copy / "manifest.sig"):
        assert path.stat().st_mode & 0o7777 == 0o644


def test_a_signature_is_a_text_file_of_one_value_a_line(copy: Path, key: Path) -> None:
    sign(copy, key, MAX_RELEASE)
    text = (copy / "manifest.sig").read_text()
    assert text == json.dumps(json.loads(text), indent=1) + "\n"
    assert json.loads(text)["release"] == MAX_RELEASE


def test_a_key_needs_a_name() -> None:
    with pytest.raises(KeyFileError, match="expected the name of a file"):
        keygen(Path("/"))


def test_a_file_that_is_no_key_is_named(copy: Path, tmp_path: Path) -> None:
    (tmp_path / "key").write_text("nothing")
    with pytest.raises(KeyFileError, match=r"key: not a PEM private key that can be read \(.+\)"):
        sign(copy, tmp_path / "key", 1)


def test_a_private_key_of_another_kind_is_named(copy: Path, tmp_path: Path) -> None:
    from cryptography.hazmat.primitives import serialization as form
    from cryptography.hazmat.primitives.asymmetric import ec

    secret = ec.generate_private_key(ec.SECP256R1())
    pem = secret.private_bytes(form.Encoding.PEM, form.PrivateFormat.PKCS8, form.NoEncryption())
    (tmp_path / "ec.pem").write_bytes(pem)
    with pytest.raises(KeyFileError, match="expected an Ed25519 private key, found ECPrivateKey"):
        sign(copy, tmp_path / "ec.pem", 1)


@pytest.mark.parametrize(
    ("arguments", "missing"),
    [
        ([], "command"),
        (["keygen"], "--key"),
        (["sign", "nano", "--release", "1"], "--key"),
        (["sign", "nano", "--key", "k"], "--release"),
        (["sign", "--key", "k", "--release", "1"], "DIR"),
        (["verify", "nano"], "--trust"),
    ],
)
def test_a_missing_argument_is_named(arguments: list[str], missing: str, capsys: Capture) -> None:
    assert refused(arguments, capsys).rstrip().endswith(missing)


@pytest.mark.parametrize(
    "line",
    [
        "keygen --key new.pem --json new.pem",
        "keygen --key new.pem --json ./new.pem.pub",
        "sign nano --key release.pem --release 1 --json release.pem",
        "sign nano --key release.pem --release 1 --json link.json",
        "sign nano --key release.pem --release 1 --json nano/manifest.json",
        "verify nano --trust release.pem.pub --json release.pem.pub",
    ],
)
def test_a_result_replaces_no_key_and_no_artifact(
    line: str, key: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(key.parent)
    (key.parent / "nano").mkdir()
    (key.parent / "link.json").symlink_to(key)
    before = {path.name: path.read_bytes() for path in key.parent.iterdir() if path.is_file()}
    assert main(line.split()) == 2
    assert capsys.readouterr().err.startswith(f"signature: --json {line.split()[-1]}: ")
    assert {path.name: path.read_bytes() for path in key.parent.iterdir() if path.is_file()} == before


def test_a_result_is_written_beside_the_artifacts(copy: Path, key: Path, tmp_path: Path) -> None:
    result = tmp_path / "result.json"
    assert main(["sign", str(copy), "--key", str(key), "--release", "1", "--json", str(result)]) == 0
    assert json.loads(result.read_text())["release"] == 1


@pytest.mark.parametrize(
    ("command", "shown"),
    [
        ("keygen", ["--key FILE ", "--json FILE|- "]),
        ("sign", ["--key FILE ", "--release N ", " DIR\n", "--json FILE|- "]),
        ("verify", ["--trust KEY.pub ", " DIR\n", "--json FILE|- "]),
    ],
)
def test_the_help_shows_what_each_argument_takes(command: str, shown: list[str], capsys: Capture) -> None:
    with pytest.raises(SystemExit):
        main([command, "--help"])
    text = capsys.readouterr().out
    assert all(one in text for one in shown), text


@pytest.mark.slow
def test_the_result_names_key_and_time_and_the_operator_reads_the_same(
    copy: Path, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    instants = itertools.count(5 * 10**9, 1_234_567_890)
    monkeypatch.setattr(signature.time, "monotonic_ns", lambda: next(instants))
    file = str(tmp_path / "ours")
    results = {}
    for arguments in (
        ["keygen", "--key", file],
        ["sign", str(copy), "--key", file, "--release", "3"],
        ["verify", str(copy), "--trust", f"{file}.pub"],
    ):
        assert main([*arguments, "--json", "-"]) == 0
        printed = capsys.readouterr()
        result = results[arguments[0]] = json.loads(printed.out)
        assert result.pop("wall_s") == 1.235
        values = ", ".join(f"{name} {value}" for name, value in result.items())
        assert printed.err == f"signature: {arguments[0]} done: {values}\n"
    key_id = Trust(Path(f"{file}.pub"), tmp_path / "counter").key_id
    assert results == {
        "keygen": {"key": file, "key_id": key_id},
        "sign": {"release": 3, "key_id": key_id},
        "verify": {"release": 3, "key_id": key_id},
    }


def test_nothing_is_made_when_the_result_cannot_be_written(tmp_path: Path, capsys: Capture) -> None:
    assert main(["keygen", "--key", str(tmp_path / "key"), "--json", "/dev/null/result.json"]) == 2
    assert list(tmp_path.iterdir()) == []
    assert capsys.readouterr().err.startswith("signature: ")


def test_a_refusal_is_one_line_that_says_which_command_it_is(copy: Path, tmp_path: Path, capsys: Capture) -> None:
    keygen(tmp_path / "ours")
    capsys.readouterr()
    assert main(["verify", str(copy), "--trust", str(tmp_path / "ours.pub")]) == 3
    line = capsys.readouterr().err
    assert line.startswith("signature: ") and line.count("\n") == 1 and "manifest.sig" in line
