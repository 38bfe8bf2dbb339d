"""Damaged releases, artifacts with links, folders of other programs: what is refused, and what is built again."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Final

import pytest

from edge.core.cli import EXIT_BAD_INPUT, EXIT_CHECK_FAILED, EXIT_DONE, EXIT_REFUSED
from edge.deploy.releases import MARKER
from tests.support.fake_board import Versions, current, starts

# --- damaged releases


def flip_a_bit(release: Path) -> None:
    graph = release / "artifacts/graph.onnx"
    content = bytearray(graph.read_bytes())
    content[100] ^= 1
    graph.write_bytes(content)


DAMAGES: Final[tuple[Callable[[Path], None], ...]] = (
    flip_a_bit,
    lambda release: (release / "artifacts/graph.onnx").unlink(),
    lambda release: shutil.rmtree(release / "artifacts"),
    lambda release: shutil.rmtree(release / "venv"),
)


@pytest.fixture
def versions(tmp_path: Path) -> Versions:
    """Versions 1 to 3, whose manifests list the files with their hashes; two of them installed."""
    versions = Versions(tmp_path)
    for version in (1, 2, 3):
        _, artifacts = versions.sources(version)
        hashes = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in artifacts.glob("*.onnx")}
        manifest = {
            "schema_version": 1,
            "content": version,
            "files": {name: {"sha256": sha256} for name, sha256 in hashes.items()},
        }
        (artifacts / "manifest.json").write_text(json.dumps(manifest))
    assert versions.install(1) == versions.install(2) == EXIT_DONE
    return versions


@pytest.mark.parametrize("damage", DAMAGES, ids=["bit", "graph", "artifacts", "venv"])
def test_the_same_install_builds_a_damaged_current_release_again(
    versions: Versions, damage: Callable[[Path], None]
) -> None:
    damage(versions.home / "releases/2")
    assert versions.install(2) == EXIT_DONE
    assert current(versions.home) == 3 and starts(versions.home)
    assert any("build release 2 again, it is damaged" in line for line in versions.lines)
    assert versions.call("rollback") == EXIT_DONE and current(versions.home) == 1  # not 2, the damaged one


def test_a_damaged_old_release_is_built_again_and_removed(versions: Versions) -> None:
    flip_a_bit(versions.home / "releases/1")
    assert versions.install(1) == EXIT_DONE
    assert versions.numbers() == [2, 3] and current(versions.home) == 3 and starts(versions.home)


@pytest.mark.parametrize("damage", DAMAGES, ids=["bit", "graph", "artifacts", "venv"])
def test_rollback_refuses_a_damaged_release(versions: Versions, damage: Callable[[Path], None]) -> None:
    damage(versions.home / "releases/1")
    assert versions.call("rollback", "--to", "1") in (EXIT_REFUSED, EXIT_CHECK_FAILED)
    assert "releases/1" in versions.lines[-1]
    assert "release 2 is current" in versions.lines[-1] or "current release is unchanged" in versions.lines[-1]
    assert current(versions.home) == 2 and starts(versions.home)


def infinite(record: Path) -> None:
    record.write_text(record.read_text().replace("null", "1e400"))


def folder(record: Path) -> None:
    record.unlink()
    record.mkdir()


def pipe(record: Path) -> None:
    record.unlink()
    os.mkfifo(record)


@pytest.mark.parametrize("damage", [infinite, folder, pipe])
def test_a_damaged_record_is_named_and_stops_no_other_release(
    versions: Versions, damage: Callable[[Path], None]
) -> None:
    damage(versions.home / "releases/1/release.json")
    assert versions.call("releases") == EXIT_DONE
    assert any("release 1: damaged" in line and "release.json" in line for line in versions.lines)
    assert versions.call("rollback", "--to", "1") == EXIT_CHECK_FAILED and "cannot be read" in versions.lines[-1]
    assert versions.install(3) == EXIT_DONE and versions.numbers() == [2, 3]
    assert versions.call("remove") == EXIT_DONE and not versions.home.exists()


@pytest.mark.parametrize("kind", ["link", "dangling link", "file"])
def test_an_entry_that_is_no_folder_is_removed_without_what_it_leads_to(versions: Versions, kind: str) -> None:
    outside, entry = versions.folder / "outside", versions.home / "releases/3"
    outside.mkdir()
    (outside / "release.json").write_text((versions.home / "releases/2/release.json").read_text())
    if kind == "file":
        entry.write_text("")
    else:
        entry.symlink_to(outside if kind == "link" else outside / "none")
    assert versions.call("rollback", "--to", "3") == EXIT_CHECK_FAILED
    assert versions.call("remove") == EXIT_DONE
    assert not versions.home.exists() and (outside / "release.json").is_file()


# --- artifacts that are not copied


def test_a_link_among_the_artifacts_is_refused_before_anything_is_copied(versions: Versions) -> None:
    secret, (_, artifacts) = versions.folder / "secret", versions.sources(3)
    secret.write_text("secret")
    (artifacts / "report.html").symlink_to(secret)
    assert versions.install(3) == EXIT_REFUSED
    assert "report.html: expected a file, found a link" in versions.lines[-1] and versions.numbers() == [1, 2]


@pytest.mark.parametrize(
    "text",
    [
        "\0 not json",
        "[]",
        '{"schema_version": 1, "files": {"graph.onnx": {"sha256": "0"}}}',
        "{}",
        '{"schema_version": "1"}',
        '{"schema_version": true}',
    ],
    ids=["no JSON", "no object", "another hash", "no version", "a text as version", "no number as version"],
)
def test_a_dry_run_refuses_a_damaged_manifest(versions: Versions, text: str) -> None:
    (versions.sources(3)[1] / "manifest.json").write_text(text)
    assert versions.install(3, "--dry-run") == EXIT_REFUSED


# --- folders that are not ours


@pytest.fixture
def foreign(tmp_path: Path) -> Versions:
    """A folder of another program at --home."""
    versions = Versions(tmp_path, tmp_path / "foreign")
    (versions.home / "releases/2024").mkdir(parents=True)
    for name in ("install.log", "lock", "releases/2024/photo"):
        (versions.home / name).write_text("mine")
    return versions


@pytest.mark.parametrize("command", ["remove", "rollback", "releases", "board"])
def test_a_folder_of_another_program_is_refused_and_stays_as_it_is(foreign: Versions, command: str) -> None:
    before = sorted(foreign.home.rglob("*"))
    assert (foreign.install(1) if command == "board" else foreign.call(command)) == EXIT_BAD_INPUT
    assert "expected a folder that edge-install board made" in foreign.lines[-1] and len(foreign.lines) == 1
    assert sorted(foreign.home.rglob("*")) == before


def test_remove_leaves_an_empty_folder_of_the_user(tmp_path: Path) -> None:
    versions = Versions(tmp_path)
    versions.home.mkdir()
    assert versions.call("remove") == EXIT_BAD_INPUT and versions.home.is_dir()


def test_an_empty_home_is_refused(
    versions: Versions, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(versions.home)
    with pytest.raises(SystemExit, match="2"):
        versions.call("remove", "--home", "")
    assert "found an empty path" in capsys.readouterr().err and starts(versions.home)


def test_a_home_of_an_earlier_version_has_no_mark_and_is_removed(versions: Versions) -> None:
    (versions.home / MARKER).unlink()
    assert versions.call("remove") == EXIT_DONE and not versions.home.exists()


def test_a_link_that_is_not_ours_is_left_alone(tmp_path: Path) -> None:
    versions = Versions(tmp_path)
    versions.home.mkdir()
    (versions.home / "current").symlink_to("/usr")
    assert versions.install(1) == EXIT_CHECK_FAILED
    assert (versions.home / "current").readlink() == Path("/usr")


def test_the_current_release_is_never_cleaned_up_even_if_its_record_is_broken(tmp_path: Path) -> None:
    versions = Versions(tmp_path)
    versions.install(1)
    (versions.home / "releases/1/release.json").write_text("{")
    assert versions.install(2) == EXIT_DONE
    assert versions.numbers() == [1, 2] and current(versions.home) == 2
