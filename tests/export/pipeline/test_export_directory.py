"""`edge-export --out`: whole directories only, and nothing of the user's is ever lost."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import pytest

from edge.artifacts.files import SCHEMA_VERSION, SECTIONS, ArtifactError, seal
from edge.artifacts.manifest import load_artifacts
from export.cli import main
from export.core.cache import StageCache
from export.core.replaceable import check_replaceable
from export.pipeline.artifacts import NEW, OLD, _swap, build_artifacts, workplace
from tests.support.export.export_job import job, manifest, progress


@pytest.mark.slow
def test_an_artifact_directory_with_something_of_the_users_in_it_is_not_replaced(
    artifacts_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = Path(shutil.copytree(artifacts_dir, tmp_path / "nano"))
    (out / "flight.mcap").write_bytes(b"evidence")
    assert main(["--out", str(out)]) == 2
    assert "flight.mcap" in capsys.readouterr().err
    assert (out / "flight.mcap").read_bytes() == b"evidence"


@pytest.mark.slow
def test_a_failed_swap_puts_the_old_directory_back(
    cache: StageCache, artifacts_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = Path(shutil.copytree(artifacts_dir, tmp_path / "nano"))
    rename = Path.rename

    def failing(self: Path, target: Path) -> Path:
        if self.name == "new":
            raise OSError("disk full")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", failing)
    with pytest.raises(OSError, match="disk full"):
        build_artifacts(job(), out, cache, progress())
    assert [p.name for p in tmp_path.iterdir()] == ["nano"]
    load_artifacts(out)


@pytest.mark.parametrize("renamed", [1, 2])
@pytest.mark.parametrize("done", [False, True])
def test_an_interrupt_of_the_swap_leaves_one_whole_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, renamed: int, done: bool
) -> None:
    """Ctrl-C before or after each of the two renames."""
    out, rename, count = tmp_path / "nano", Path.rename, 0
    out.mkdir()
    (out / "first").touch()

    def interrupted(self: Path, target: Path) -> Path:
        nonlocal count
        count += 1
        if count == renamed and not done:
            raise KeyboardInterrupt
        moved = rename(self, target)
        if count == renamed:
            raise KeyboardInterrupt
        return moved

    with workplace(out) as work:
        (work / NEW).mkdir()
        (work / NEW / "second").touch()
        monkeypatch.setattr(Path, "rename", interrupted)
        with pytest.raises(KeyboardInterrupt):
            _swap(work / NEW, out, work / OLD)
    expected = "second" if (renamed, done) == (2, True) else "first"
    assert [path.name for path in out.iterdir()] == [expected]
    assert [path.name for path in tmp_path.iterdir()] == ["nano"]


def test_an_error_after_the_first_rename_is_undone_with_the_workplace(tmp_path: Path) -> None:
    (tmp_path / "nano").mkdir()
    with workplace(tmp_path / "nano") as work:
        (tmp_path / "nano").rename(work / OLD)
    assert [path.name for path in tmp_path.iterdir()] == ["nano"]


@pytest.mark.slow
def test_a_foreign_directory_is_not_touched(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter1.tex").write_text("years of work")
    assert main(["--out", str(tmp_path / "thesis")]) == 2
    assert "manifest.json" in capsys.readouterr().err
    assert (tmp_path / "thesis" / "chapter1.tex").read_text() == "years of work"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["nano.partial", "nano.old.partial"])
def test_a_directory_of_the_users_beside_the_output_stays(artifacts_dir: Path, tmp_path: Path, name: str) -> None:
    (tmp_path / name).mkdir()
    (tmp_path / name / "notes.txt").write_text("mine")
    (tmp_path / "nano").mkdir()  # empty: may be used
    assert main(["--out", str(tmp_path / "nano")]) == 0
    assert (tmp_path / name / "notes.txt").read_text() == "mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["nano", name])


@pytest.mark.slow
def test_a_link_to_a_directory_stays_a_link(artifacts_dir: Path, tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "nano").symlink_to("disk")
    assert main(["--out", str(tmp_path / "nano")]) == 0
    assert (tmp_path / "nano").is_symlink()
    load_artifacts(tmp_path / "disk")


@pytest.mark.slow
def test_an_older_directory_of_ours_is_replaced_if_its_files_match_its_manifest(
    artifacts_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = Path(shutil.copytree(artifacts_dir, tmp_path / "nano"))
    content = {"schema_version": 1, "files": manifest(out)["files"]}
    (out / "manifest.json").write_text(json.dumps(content))
    tokenizer = (out / "tokenizer.json").read_bytes()
    (out / "tokenizer.json").write_bytes(tokenizer + b"\n")
    assert main(["--out", str(out)]) == 2
    assert "schema version 1" in capsys.readouterr().err
    (out / "tokenizer.json").write_bytes(tokenizer)
    assert main(["--out", str(out)]) == 0
    load_artifacts(out)


@pytest.mark.parametrize("name", ["/dev/zero", "../out/fifo", "fifo", "link"])
def test_an_older_manifest_that_lists_a_device_or_a_link_is_refused_at_once(name: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    os.mkfifo(out / "fifo")
    (out / "link").symlink_to("/dev/zero")
    (out / "manifest.json").write_text(json.dumps({"schema_version": 1, "files": {name: {"sha256": "0" * 64}}}))
    with pytest.raises(ArtifactError, match="schema version 1"):
        check_replaceable(out)


def test_a_sealed_manifest_whose_files_are_a_number_is_refused(tmp_path: Path) -> None:
    content: dict[str, Any] = {**{key: {} for key in SECTIONS}, "schema_version": SCHEMA_VERSION, "files": 5}
    (tmp_path / "manifest.json").write_text(json.dumps(seal(content)))
    with pytest.raises(ArtifactError, match=r"manifest\.json: files must be an object"):
        check_replaceable(tmp_path)


@pytest.mark.slow
def test_a_second_export_into_one_directory_is_refused(
    artifacts_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with workplace(tmp_path / "nano") as work:
        (work / "new").mkdir()
        assert main(["--out", str(tmp_path / "nano")]) == 2
        assert "another export is writing" in capsys.readouterr().err.splitlines()[-1]
        assert (work / "new").exists()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_the_directory_that_a_killed_export_replaced_is_restored(artifacts_dir: Path, tmp_path: Path) -> None:
    work = tmp_path / ".nano.edge-export"
    shutil.copytree(artifacts_dir, work / "old")
    (work / "new").mkdir()
    with workplace(tmp_path / "nano"):
        load_artifacts(tmp_path / "nano")
    assert [path.name for path in tmp_path.iterdir()] == ["nano"]
