"""Cache of finished build stages; the hash of a stage's inputs is its key, so no stage is built twice.

An entry is a directory `<key>/` with the stage's files and `entry.json`, their sizes and hashes. It is built in
`<key>.partial` and renamed, so an interrupted stage leaves no entry. Hashes are checked on every use, so a damaged
entry is rebuilt. Outputs are copies, so a change to an output cannot change the cache.
"""

from __future__ import annotations

import ast
import fcntl
import hashlib
import importlib.metadata
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

from edge.core.cli import write_whole
from firmware_bridge.system.input_file import read_json

ENTRY_NAME = "entry.json"
RESULT_NAME = "result.json"
PACKAGES = ("numpy", "onnx", "onnxscript", "safetensors", "tokenizers", "torch")
VARIANTS = ("onnxruntime", "opencv-python")
"""Packages that also exist under longer names (`onnxruntime-gpu`, `opencv-python-headless`): all belong to the key."""
SOURCE_FOLDERS = ("edge", "export")
DATA_SUFFIXES = (".json", ".toml")
_LOCK_NAME = "lock"
_TIMINGS_NAME = "timings.json"
_MARKER_NAME = ".tic-vla-edge-cache"
_OURS = re.compile(r"[0-9a-f]{64}(\.partial|\.building)?", re.ASCII)
"""Names of entries and of their temporary files; the cache removes no other name."""
_CHUNK_BYTES = 1 << 22


class CacheError(OSError):
    """Unusable cache directory; its text is the one line to show."""


def default_cache_dir(environ: Mapping[str, str]) -> Path:
    """Return `$XDG_CACHE_HOME/tic-vla-edge`, or `~/.cache/tic-vla-edge` unless that variable is an absolute path."""
    named = Path(environ.get("XDG_CACHE_HOME", ""))
    return (named if named.is_absolute() else Path.home() / ".cache") / "tic-vla-edge"


def file_sha256(path: Path) -> str:
    """Compute the SHA-256 of a file in blocks. Raises OSError."""
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while piece := stream.read(_CHUNK_BYTES):
            digest.update(piece)
    return digest.hexdigest()


@lru_cache
def source_sha256(modules: tuple[str, ...]) -> str:
    """Hash modules of this project, all that they import from it, and the data files beside these.

    A change of that code invalidates its entries; a change elsewhere keeps them valid.
    """
    root, digest = Path(__file__).parents[2], hashlib.sha256()
    waiting, found = list(modules), dict[str, Path]()
    while waiting:
        name = waiting.pop()
        stem = root.joinpath(*name.split("."))
        candidates = (stem.with_suffix(".py"), stem / "__init__.py")
        path = next((path for path in candidates if path.is_file()), None)  # None for a name inside a module
        if path is not None and name not in found:
            found[name] = path
            waiting += [imported for imported in _imports(path) if imported.split(".")[0] in SOURCE_FOLDERS]
    folders = {path.parent for path in found.values()}
    data = {path for folder in folders for path in folder.iterdir() if path.suffix in DATA_SUFFIXES}
    for path in sorted({*found.values(), *data}):
        digest.update(f"{path.relative_to(root).as_posix()}:{file_sha256(path)}\n".encode())
    return digest.hexdigest()


@cache
def _imports(path: Path) -> frozenset[str]:
    """Return the names that a file imports, also inside functions; `from a import b` may mean the module a.b."""
    names: set[str] = set()
    waiting: list[ast.AST] = [ast.parse(path.read_text(encoding="utf-8"))]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif not isinstance(node, ast.expr):  # most nodes are parts of expressions, and none of these imports
            waiting += ast.iter_child_nodes(node)
    return frozenset(names)


@lru_cache
def package_versions() -> dict[str, str]:
    """Return the installed versions of the packages that a result depends on."""
    found = {name: importlib.metadata.version(name) for name in PACKAGES}
    for distribution in importlib.metadata.distributions():
        name = str(distribution.metadata["Name"] or "").lower().replace("_", "-")
        if any(name == variant or name.startswith(f"{variant}-") for variant in VARIANTS):
            found[name] = distribution.version
    return dict(sorted(found.items()))


def stage_key(stage: str, parts: Mapping[str, object], modules: Sequence[str]) -> str:
    """Hash all inputs of a stage: `parts` (plain JSON) and the code of `modules`. Returns a SHA-256."""
    source = source_sha256(tuple(sorted(modules)))
    content = {"stage": stage, "parts": parts, "packages": package_versions(), "source": source}
    return hashlib.sha256(json.dumps(content, sort_keys=True, allow_nan=False).encode()).hexdigest()


def fsync_path(path: Path) -> None:
    """Force a file or directory to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def open_cache(directory: Path, limit_bytes: int, log: Callable[[str], None]) -> Iterator[StageCache]:
    """Open the cache. On exit, remove the least recently used entries until the rest fits `limit_bytes`.

    Entries are removed only if no other process has the cache open. Raises CacheError, also for a foreign folder.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        _claim(directory)
        descriptor = os.open(directory / _LOCK_NAME, os.O_RDWR | os.O_CREAT, 0o644)
    except CacheError:
        raise
    except OSError as error:
        raise CacheError(
            f"cache {directory}: cannot be written ({error.strerror}); name another with --cache DIR or use --no-cache"
        ) from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH)
        cache = StageCache(directory, log)
        try:
            yield cache
        finally:
            with suppress(BlockingIOError):  # another process has it open
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                cache.prune(limit_bytes)
    finally:
        os.close(descriptor)


def remove_abandoned(folder: Path, prefix: str) -> None:
    """Remove caches in `folder` whose names begin with `prefix` and that no process has open: it was killed."""
    for directory in folder.glob(f"{prefix}*"):
        if directory.is_symlink() or not (directory / _MARKER_NAME).is_file():
            continue
        with (directory / _LOCK_NAME).open("a") as lock, suppress(BlockingIOError):
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(directory, ignore_errors=True)


def _claim(directory: Path) -> None:
    """Mark a directory as a cache. Raises CacheError if it holds other files."""
    marker = directory / _MARKER_NAME
    if marker.exists():
        return
    known = (_LOCK_NAME, _TIMINGS_NAME)
    others = sorted(p.name for p in directory.iterdir() if p.name not in known and not _OURS.fullmatch(p.name))
    if others:
        raise CacheError(
            f"cache {directory}: holds {others[0]}, which is not part of a cache; name an empty or new directory"
        )
    marker.touch()


@dataclass(frozen=True)
class StageCache:
    """Finished stages in a directory, each under the hash of its inputs; created by `open_cache`."""

    directory: Path
    log: Callable[[str], None]

    def fetch_or_build(self, key: str, build: Callable[[Path], None]) -> tuple[Path, bool]:
        """Return the directory of a stage's files, which `build` writes unless cached, and whether they were cached.

        A second process that needs the same stage waits for the first and uses its result. Exceptions of `build`
        propagate and leave no entry.
        """
        entry = self.directory / key
        with self._locked(key):
            if entry.exists():
                damage = _damage(entry)
                if damage is None:
                    os.utime(entry / ENTRY_NAME)  # its age counts from its last use
                    return entry, True
                self.log(f"cache: {damage}; building it again")
                shutil.rmtree(entry)
            partial = self.directory / f"{key}.partial"
            shutil.rmtree(partial, ignore_errors=True)  # left by a process that was killed
            partial.mkdir()
            try:
                build(partial)
                _seal(partial)
                partial.rename(entry)
                fsync_path(self.directory)
            finally:
                shutil.rmtree(partial, ignore_errors=True)
        return entry, False

    def result(self, key: str, compute: Callable[[], Mapping[str, object]]) -> tuple[dict[str, Any], bool]:
        """Return a stage's result as plain JSON, and whether it was cached."""

        def build(directory: Path) -> None:
            text = json.dumps(compute(), indent=1, sort_keys=True, allow_nan=False) + "\n"
            (directory / RESULT_NAME).write_text(text, encoding="utf-8")

        entry, cached = self.fetch_or_build(key, build)
        content: dict[str, Any] = read_json(entry / RESULT_NAME)
        return content, cached

    def timings(self, run: str) -> dict[str, float]:
        """Return each stage's last build time for this kind of run, s; empty if unknown."""
        known = self._all_timings().get(run)
        pairs = known.items() if isinstance(known, dict) else ()
        return {k: float(v) for k, v in pairs if isinstance(v, int | float) and not isinstance(v, bool) and v >= 0}

    def remember_timings(self, run: str, seconds: Mapping[str, float]) -> None:
        """Store the durations (s) of the built stages, for the next run's estimate only."""
        content = self._all_timings()
        content[run] = {**self.timings(run), **{k: round(v, 3) for k, v in seconds.items()}}
        write_whole(self.directory / _TIMINGS_NAME, json.dumps(content, indent=1, sort_keys=True) + "\n")

    def _all_timings(self) -> dict[str, Any]:
        try:
            content = read_json(self.directory / _TIMINGS_NAME)
        except (OSError, ValueError):
            return {}  # absent or damaged: a missing estimate is no error
        return content if isinstance(content, dict) else {}

    def prune(self, limit_bytes: int) -> None:
        """Delete leftovers of killed processes and the least recently used entries, until the rest fits."""
        ours = [path for path in self.directory.iterdir() if _OURS.fullmatch(path.name) and not path.is_symlink()]
        for leftover in [path for path in ours if path.suffix]:
            shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()
        entries = [path for path in ours if not path.suffix and path.is_dir()]
        sizes = {entry: sum(path.stat().st_size for path in entry.iterdir()) for entry in entries}
        used_ns = {entry: max((p.stat().st_mtime_ns for p in entry.glob(ENTRY_NAME)), default=0) for entry in entries}
        for entry in sorted(entries, key=lambda entry: used_ns[entry]):
            if sum(sizes.values()) <= limit_bytes:
                return
            del sizes[entry]
            shutil.rmtree(entry)

    @contextmanager
    def _locked(self, key: str) -> Iterator[None]:
        descriptor = os.open(self.directory / f"{key}.building", os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            yield
        finally:
            os.close(descriptor)


def _seal(directory: Path) -> None:
    """Record the files of a finished stage and force them to the disk, before the rename makes it an entry."""
    files = sorted(path for path in directory.iterdir())
    content = {path.name: {"sha256": file_sha256(path), "bytes": path.stat().st_size} for path in files}
    entry = directory / ENTRY_NAME
    entry.write_text(json.dumps({"files": content}, indent=1, sort_keys=True) + "\n", encoding="utf-8")
    for path in [*files, entry, directory]:
        fsync_path(path)


def _damage(entry: Path) -> str | None:
    """Return what is damaged in an entry; None if its files are exactly those recorded."""
    try:
        files = read_json(entry / ENTRY_NAME)["files"]
        found = sorted(path.name for path in entry.iterdir() if path.name != ENTRY_NAME)
        if found != sorted(files):
            return f"{entry.name[:12]}… holds {found}, recorded were {sorted(files)}"
        for name, recorded in files.items():
            if file_sha256(entry / name) != recorded["sha256"]:
                return f"{entry.name[:12]}…/{name} differs from the stored file"
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        return f"{entry.name[:12]}… cannot be read ({error})"
    return None
