"""Directory of a benchmark run: its configuration and its results; consistent after any interruption.

config.json     conditions, episodes, versions: written first, never changed; a resumed run must have the same
results.jsonl   one line per finished episode, appended whole
failed.jsonl    episodes whose process died in every attempt; a resumed run tries them again
episodes/ID.json, videos/ID.mp4, flights/ID.mcap, causes/ID.json    written before their line in results.jsonl
"""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

from edge.core.cli import write_whole
from firmware_bridge.system.input_file import parse_json, read_bytes, read_json, read_text
from sim_hil.benchmark.results.record import EpisodeResult, FailedRun, ResultError

CONFIG, RESULTS, FAILED = "config.json", "results.jsonl", "failed.jsonl"
EPISODES, VIDEOS, FLIGHTS, CAUSES = "episodes", "videos", "flights", "causes"


class StoreError(ValueError):
    """A directory that cannot be used as requested; one line: what, expected, found, what to do."""


class ResultStore:
    """Results of a run in order of arrival, with a single writer. Methods raise OSError when the disk fails."""

    def __init__(
        self,
        directory: Path,
        config: Mapping[str, Any],
        results: Sequence[EpisodeResult],
        lock: IO[bytes] | None = None,
        failed: Sequence[FailedRun] = (),
    ) -> None:
        """Take results that are already on disk; `lock` excludes other runs while it is open."""
        self._lock = lock
        self.directory = directory
        self.config = config
        self._results = {result.id: result for result in results}
        self._failed = list(failed)

    @staticmethod
    def create(directory: Path, config: Mapping[str, object]) -> ResultStore:
        """Create a run in a new or empty directory. Raises StoreError."""
        check_new(directory)
        _make(directory, ())  # what a kill leaves before the configuration is an empty directory, which is new again
        write_whole(directory / CONFIG, json.dumps(config, indent=1) + "\n")
        _make(directory)
        return ResultStore(directory, config, (), _locked(directory))

    @staticmethod
    def resume(directory: Path, config: Mapping[str, object]) -> ResultStore:
        """Continue a run with the same configuration. Raises StoreError that names the difference."""
        if not (directory / CONFIG).is_file():
            raise StoreError(f"--resume: {directory} contains no benchmark run ({CONFIG}); start one without --resume")
        found = read_config(directory)
        requested = json.loads(json.dumps(config))
        if different := sorted(key for key in {*requested, *found} if requested.get(key) != found.get(key)):
            raise StoreError(
                f"--resume: {different[0]} of the run in {directory} differs from this command; repeat the first "
                f"command, or name another directory ({_difference(found, requested, different[0])})"
            )
        lock = _locked(directory)
        _make(directory)
        _cut_torn_line(directory / RESULTS)
        (directory / FAILED).unlink(missing_ok=True)
        for partial in directory.glob("*/*.partial*"):
            partial.unlink()
        return ResultStore(directory, found, read_results(directory), lock)

    def close(self) -> None:
        """Release the lock on the directory."""
        if self._lock is not None:
            self._lock.close()

    @property
    def results(self) -> list[EpisodeResult]:
        """Results of finished episodes."""
        return list(self._results.values())

    @property
    def failed(self) -> list[FailedRun]:
        """Episodes of this run without a result."""
        return list(self._failed)

    def has(self, episode_id: str) -> bool:
        """Return whether an episode has a result."""
        return episode_id in self._results

    def add(self, result: EpisodeResult) -> bool:
        """Append a result; return False and write nothing if the episode already has one."""
        if result.id in self._results:
            return False
        _append(self.directory / RESULTS, result.as_json())
        self._results[result.id] = result
        return True

    def add_failed(self, failed: FailedRun) -> None:
        """Record that an episode has no result."""
        _append(self.directory / FAILED, asdict(failed))
        self._failed.append(failed)


def check_new(directory: Path) -> None:
    """Raise StoreError unless a run can begin in a directory, which is new or empty."""
    if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
        raise StoreError(
            f"--out {directory}: expected a new or empty directory; continue that run with --resume, or name another "
            "one"
        )


def read_config(directory: Path) -> dict[str, Any]:
    """Read the configuration of a run, of any keys. Raises StoreError."""
    path = directory / CONFIG
    try:
        content = read_json(path)
    except (OSError, ValueError) as error:
        raise StoreError(f"{path}: expected the configuration of a benchmark run ({error})") from error
    if not isinstance(content, dict):
        raise StoreError(f"{path}: expected a JSON object, found {type(content).__name__}")
    return content


def read_results(directory: Path) -> list[EpisodeResult]:
    """Read the results of a run without a torn last line. Raises StoreError."""
    path = directory / RESULTS
    if not path.exists():
        return []
    results: dict[str, EpisodeResult] = {}
    for number, line in enumerate(_whole_lines(path), 1):
        try:
            result = EpisodeResult.of_json(parse_json(line))
        except (ValueError, ResultError) as error:
            raise StoreError(f"{path}:{number}: {error}") from error
        if result.id in results:
            raise StoreError(f"{path}:{number}: expected one result per episode, found {result.id} twice")
        results[result.id] = result
    return list(results.values())


def read_failed(directory: Path) -> list[FailedRun]:
    """Read the episodes of a run without a result, without a torn last line. Raises StoreError."""
    path = directory / FAILED
    failed = []
    for number, line in enumerate(_whole_lines(path) if path.exists() else (), 1):
        try:
            failed.append(FailedRun.of_json(parse_json(line)))
        except (ValueError, ResultError) as error:
            raise StoreError(f"{path}:{number}: {error}") from error
    return failed


def _locked(directory: Path) -> IO[bytes]:
    """Lock the run's directory for this process. Raises StoreError if another process holds the lock.

    The kernel releases the lock of a dead process.
    """
    file = (directory / CONFIG).open("rb")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        file.close()
        raise StoreError(
            f"--out {directory}: another edge-bench uses this directory; wait for it, or name another directory"
        ) from error
    return file


def _make(directory: Path, folders: Sequence[str] = (EPISODES, VIDEOS)) -> None:
    try:
        for folder in (".", *folders):
            (directory / folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StoreError(f"--out {directory}: cannot be created ({error.strerror})") from error


def _append(path: Path, content: Mapping[str, object]) -> None:
    """Append one line in one write and sync it to the disk."""
    data = (json.dumps(content) + "\n").encode()
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    try:
        if os.write(handle, data) != len(data):
            raise OSError(f"{path}: the disk is full; the last line is incomplete, --resume repairs it")
        os.fsync(handle)
    finally:
        os.close(handle)


def _whole_lines(path: Path) -> list[str]:
    try:
        return read_text(path).split("\n")[:-1]
    except (OSError, ValueError) as error:
        raise StoreError(f"{path}: cannot be read ({error})") from error


def _cut_torn_line(path: Path) -> None:
    """Remove an incomplete last line, left by a process that died while writing. Raises StoreError."""
    if not path.exists():
        return
    try:
        data = read_bytes(path)
    except OSError as error:
        raise StoreError(f"{path}: cannot be read ({error})") from error
    whole = data.rfind(b"\n") + 1
    if whole < len(data):
        with path.open("r+b") as file:
            file.truncate(whole)


def _difference(found: Mapping[str, object], requested: Mapping[str, object], key: str) -> str:
    """Describe the two values of a key in one line; of a table only the first entry that differs."""
    was, now = found.get(key), requested.get(key)
    if isinstance(was, dict) and isinstance(now, dict):
        inner = next(name for name in sorted({*was, *now}) if was.get(name) != now.get(name))
        return f"{inner}: {_short(was.get(inner))} then, {_short(now.get(inner))} now"
    return f"{_short(was)} then, {_short(now)} now"


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
