"""The stage cache: nothing is made twice, nothing damaged or half-made is ever used."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from export.core import cache as stages
from export.core.cache import CacheError, StageCache, open_cache, remove_abandoned, stage_key

GIB = 1 << 30
CODE = ("export.quantize.precision",)


class Notes:
    def __init__(self) -> None:
        self.lines: list[str] = []

    def __call__(self, line: str) -> None:
        self.lines.append(line)


@pytest.fixture
def notes() -> Notes:
    return Notes()


@pytest.fixture
def cache(tmp_path: Path, notes: Notes) -> Iterator[StageCache]:
    with open_cache(tmp_path / "cache", GIB, notes) as opened:
        yield opened


def writes(text: str, calls: list[str] | None = None) -> Callable[[Path], None]:
    def build(directory: Path) -> None:
        if calls is not None:
            calls.append(text)
        (directory / "graph.onnx").write_text(text)

    return build


def key(name: str) -> str:
    """A key as stages have it."""
    return hashlib.sha256(name.encode()).hexdigest()


def entries(directory: Path) -> list[str]:
    return sorted(path.name for path in directory.iterdir() if path.is_dir())


@pytest.mark.parametrize(
    ("stage", "parts"),
    [("gate", {"a": 1}), ("graph", {"a": 2}), ("graph", {"a": 1, "b": 0}), ("graph", {"a": "1"}), ("graph", {})],
)
def test_any_other_part_names_another_stage(stage: str, parts: dict[str, object]) -> None:
    assert stage_key(stage, parts, CODE) != stage_key("graph", {"a": 1}, CODE)


@pytest.mark.parametrize("function", ["package_versions", "source_sha256"])
def test_another_version_of_a_package_or_of_our_code_names_another_stage(
    monkeypatch: pytest.MonkeyPatch, function: str
) -> None:
    before = stage_key("graph", {}, CODE)
    monkeypatch.setattr(stages, function, lambda *_: {"onnx": "edited"})
    assert stage_key("graph", {}, CODE) != before


def forget() -> None:
    """Empty the memory of sources, as in a new process."""
    stages.source_sha256.cache_clear()
    stages._imports.cache_clear()


@pytest.fixture
def sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A tree of ours in small: a imports b.c inside a function, d is nobody's."""
    for name, text in {
        "export/a.py": "try:\n    def f():\n        from edge.b import c\nfinally:\n    pass\n",
        "edge/b/__init__.py": "",
        "edge/b/c.py": "import numpy\n",
        "edge/b/numbers.json": "{}",
        "edge/d.py": "",
        "export/core/cache.py": "",
    }.items():
        path = tmp_path / "root" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    monkeypatch.setattr(stages, "__file__", str(tmp_path / "root" / "export" / "core" / "cache.py"))
    forget()
    yield tmp_path / "root"
    forget()


@pytest.mark.parametrize(
    ("edited", "counts"),
    [
        ("export/a.py", True),
        ("edge/b/c.py", True),
        ("edge/b/__init__.py", True),
        ("edge/b/numbers.json", True),
        ("edge/d.py", False),
        ("export/core/cache.py", False),
    ],
)
def test_an_edit_counts_where_the_stages_code_can_reach_it(sources: Path, edited: str, counts: bool) -> None:
    before = stages.source_sha256(("export.a",))
    (sources / edited).write_text((sources / edited).read_text() + " ")
    forget()
    assert (stages.source_sha256(("export.a",)) != before) is counts


def test_a_stage_is_built_once(cache: StageCache) -> None:
    calls: list[str] = []
    first, was_there = cache.fetch_or_build("k", writes("x", calls))
    again, is_there = cache.fetch_or_build("k", writes("x", calls))
    assert (first, was_there, is_there) == (again, False, True)
    assert (again / "graph.onnx").read_text() == "x"
    assert calls == ["x"]


def test_a_result_is_kept_as_it_was(cache: StageCache) -> None:
    assert cache.result("r", lambda: {"cosine": 0.999, "reason": "é"}) == ({"cosine": 0.999, "reason": "é"}, False)
    assert cache.result("r", dict) == ({"cosine": 0.999, "reason": "é"}, True)


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[0] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize(
    "damage",
    [
        lambda entry: flip(entry / "graph.onnx"),
        lambda entry: (entry / "graph.onnx").write_text(""),
        lambda entry: (entry / "graph.onnx").unlink(),
        lambda entry: (entry / "planted.onnx").write_text("x"),
        lambda entry: (entry / "entry.json").unlink(),
        lambda entry: (entry / "entry.json").write_text("[]"),
        lambda entry: (entry / "entry.json").write_text("{"),
    ],
    ids=["flipped", "truncated", "missing", "planted", "no record", "another record", "half a record"],
)
def test_a_damaged_entry_is_rebuilt_and_reported(
    cache: StageCache, notes: Notes, damage: Callable[[Path], object]
) -> None:
    entry, _ = cache.fetch_or_build("k", writes("good"))
    damage(entry)
    again, was_there = cache.fetch_or_build("k", writes("good"))
    assert not was_there
    assert [p.name for p in sorted(again.iterdir())] == ["entry.json", "graph.onnx"]
    assert (again / "graph.onnx").read_text() == "good"
    assert len(notes.lines) == 1
    assert "building it again" in notes.lines[0]


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError, ValueError])
def test_an_interrupted_build_leaves_no_entry(cache: StageCache, error: type[BaseException]) -> None:
    def interrupted(directory: Path) -> None:
        (directory / "graph.onnx").write_text("half")
        raise error

    with pytest.raises(error):
        cache.fetch_or_build("k", interrupted)
    assert entries(cache.directory) == []


def test_two_builders_of_one_stage_build_it_once(cache: StageCache) -> None:
    calls: list[str] = []
    begun, go = threading.Event(), threading.Event()

    def slow(directory: Path) -> None:
        begun.set()
        assert go.wait(30)
        writes("x", calls)(directory)

    first = threading.Thread(target=cache.fetch_or_build, args=("k", slow))
    first.start()
    assert begun.wait(30)
    found: list[bool] = []
    second = threading.Thread(target=lambda: found.append(cache.fetch_or_build("k", writes("y", calls))[1]))
    second.start()
    go.set()
    first.join(30)
    second.join(30)
    assert calls == ["x"]
    assert found == [True]


def test_the_entries_used_longest_ago_go_first(tmp_path: Path, notes: Notes) -> None:
    with open_cache(tmp_path, GIB, notes) as cache:
        for age, name in enumerate(("new", "middle", "old")):
            entry, _ = cache.fetch_or_build(key(name), writes("x" * 1000))
            os.utime(entry / "entry.json", ns=(10**18 - age, 10**18 - age))
        cache.fetch_or_build(key("old"), writes("never called"))
    with open_cache(tmp_path, 2500, notes):
        pass
    assert entries(tmp_path) == sorted([key("new"), key("old")])


def test_nothing_is_pruned_under_another_process_hands(tmp_path: Path, notes: Notes) -> None:
    code = (
        "import sys; from pathlib import Path; from export.core.cache import open_cache\n"
        "with open_cache(Path(sys.argv[1]), 0, print): pass"
    )
    with open_cache(tmp_path, GIB, notes) as cache:
        cache.fetch_or_build(key("k"), writes("x"))
        subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True, timeout=300)
        assert entries(tmp_path) == [key("k")]
    subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True, timeout=300)
    assert entries(tmp_path) == []


def test_leftovers_of_killed_processes_go(tmp_path: Path, notes: Notes) -> None:
    (tmp_path / f"{key('k')}.partial").mkdir()
    (tmp_path / f"{key('k')}.building").touch()
    with open_cache(tmp_path, GIB, notes):
        pass
    assert sorted(path.name for path in tmp_path.iterdir()) == [".tic-vla-edge-cache", "lock"]


def test_a_killed_exports_folder_of_stages_goes_and_no_other_does(tmp_path: Path, notes: Notes) -> None:
    for name in ("killed", "open", "other"):
        (tmp_path / f".edge-export-{name}").mkdir()
    with open_cache(tmp_path / ".edge-export-killed", GIB, notes):
        pass
    with open_cache(tmp_path / ".edge-export-open", GIB, notes):
        remove_abandoned(tmp_path, ".edge-export-")
    assert sorted(path.name for path in tmp_path.iterdir()) == [".edge-export-open", ".edge-export-other"]


@pytest.mark.parametrize("name", ["photos/a.jpg", "movie.partial", "thesis.building", "notes.txt"])
def test_a_directory_with_files_of_the_users_is_refused_and_not_touched(
    tmp_path: Path, notes: Notes, name: str
) -> None:
    theirs = tmp_path / name
    theirs.parent.mkdir(exist_ok=True)
    theirs.write_text("mine")
    with pytest.raises(CacheError, match="which is not part of a cache"), open_cache(tmp_path, 0, notes):
        pass
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [theirs]


@pytest.mark.parametrize("name", ["photos/a.jpg", "movie.partial", "thesis.building", f"{'a' * 63}/x", "AB/x"])
def test_a_users_file_in_a_cache_survives_any_pruning(tmp_path: Path, notes: Notes, name: str) -> None:
    with open_cache(tmp_path, GIB, notes) as cache:
        cache.fetch_or_build(key("k"), writes("x"))
    theirs = tmp_path / name
    theirs.parent.mkdir(exist_ok=True)
    theirs.write_text("mine")
    with open_cache(tmp_path, 0, notes):
        pass
    assert theirs.read_text() == "mine"
    assert not (tmp_path / key("k")).exists()


def test_a_directory_that_cannot_be_written_is_refused_in_one_line(tmp_path: Path, notes: Notes) -> None:
    (tmp_path / "file").touch()
    with (
        pytest.raises(CacheError, match=r"cache .*: cannot be written .*--no-cache"),
        open_cache(tmp_path / "file" / "cache", GIB, notes),
    ):
        pass


def test_seconds_of_the_last_run_are_kept_by_stage(cache: StageCache) -> None:
    cache.remember_timings("nano", {"graph a": 2.0, "graph b": 1.0})
    cache.remember_timings("nano", {"graph a": 3.0})
    assert cache.timings("nano") == {"graph a": 3.0, "graph b": 1.0}
    assert cache.timings("1b") == {}


@pytest.mark.parametrize("content", ["", "[]", '{"nano": 3}', '{"nano": {"graph a": "soon"}}'])
def test_damaged_seconds_are_no_error(cache: StageCache, content: str) -> None:
    (cache.directory / "timings.json").write_text(content)
    assert cache.timings("nano") == {}
    cache.remember_timings("nano", {"graph a": 1.0})
    assert json.loads((cache.directory / "timings.json").read_text())["nano"] == {"graph a": 1.0}
