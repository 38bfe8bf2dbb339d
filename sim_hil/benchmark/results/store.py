"""The directory of a benchmark run: what was asked for, and each result as it comes; valid after any interruption.

config.json     conditions, episodes, versions: written first, never changed; a resumed run must have the same
results.jsonl   one line a finished episode, appended whole
failed.jsonl    episodes whose process died each time; a resumed run tries them again
episodes/ID.json, videos/ID.mp4    written before their line in results.jsonl
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
from sim_hil.benchmark.results.record import EpisodeResult, FailedRun, ResultError

CONFIG, RESULTS, FAILED = "config.json", "results.jsonl", "failed.jsonl"
EPISODES, VIDEOS = "episodes", "videos"


class StoreError(ValueError):
    """A directory that cannot be used as asked; one line: what, expected, found, what to do."""


class ResultStore:
    """One writer; results are in the order in which they came. Methods raise OSError when the disk fails."""

    def __init__(
        self,
        directory: Path,
        config: Mapping[str, Any],
        results: Sequence[EpisodeResult],
        lock: IO[bytes] | None = None,
        failed: Sequence[FailedRun] = (),
    ) -> None:
        """`lock` keeps other runs out for as long as it is open."""
        self._lock = lock
        self.directory = directory
        self.config = config
        self._results = {result.id: result for result in results}
        self._failed = list(failed)

    @staticmethod
    def create(directory: Path, config: Mapping[str, object]) -> ResultStore:
        """A new run in a new or empty directory; raises StoreError."""
        if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
            raise StoreError(
                f"--out {directory}: expected a new or empty directory; continue that run with --resume, or name "
                "another one"
            )
        _make(directory)
        write_whole(directory / CONFIG, json.dumps(config, indent=1) + "\n")
        return ResultStore(directory, config, (), _locked(directory))

    @staticmethod
    def resume(directory: Path, config: Mapping[str, object]) -> ResultStore:
        """Continue a run that was asked for the very same; raises StoreError, naming what differs."""
        if not (directory / CONFIG).is_file():
            raise StoreError(f"--resume: {directory} holds no benchmark run ({CONFIG}); start one without --resume")
        found = read_config(directory)
        asked = json.loads(json.dumps(config))
        if different := sorted(key for key in {*asked, *found} if asked.get(key) != found.get(key)):
            raise StoreError(
                f"--resume: {different[0]} of the run in {directory} differs from what is asked for now; repeat the "
                f"first command, or name another directory ({_difference(found, asked, different[0])})"
            )
        lock = _locked(directory)
        _make(directory)
        _cut_torn_line(directory / RESULTS)
        (directory / FAILED).unlink(missing_ok=True)
        for partial in directory.glob("*/*.partial*"):
            partial.unlink()
        return ResultStore(directory, found, read_results(directory), lock)

    def close(self) -> None:
        """Let other runs in."""
        if self._lock is not None:
            self._lock.close()

    @property
    def results(self) -> list[EpisodeResult]:
        """Finished episodes."""
        return list(self._results.values())

    @property
    def failed(self) -> list[FailedRun]:
        """Episodes of this run that have no result."""
        return list(self._failed)

    def has(self, episode_id: str) -> bool:
        """Whether that episode has a result."""
        return episode_id in self._results

    def add(self, result: EpisodeResult) -> bool:
        """Append a result; False, and nothing is written, for an episode that has one already."""
        if result.id in self._results:
            return False
        _append(self.directory / RESULTS, result.as_json())
        self._results[result.id] = result
        return True

    def add_failed(self, failed: FailedRun) -> None:
        """Record that an episode has no result."""
        _append(self.directory / FAILED, asdict(failed))
        self._failed.append(failed)


def read_config(directory: Path) -> dict[str, Any]:
    """What a run was asked for; raises StoreError."""
    path = directory / CONFIG
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise StoreError(f"{path}: expected what a benchmark run has written ({error})") from error
    if not isinstance(content, dict):
        raise StoreError(f"{path}: expected a JSON object, found {type(content).__name__}")
    return content


def read_results(directory: Path) -> list[EpisodeResult]:
    """Results of a run, a torn last line left out; raises StoreError."""
    path = directory / RESULTS
    if not path.exists():
        return []
    results: dict[str, EpisodeResult] = {}
    for number, line in enumerate(_whole_lines(path), 1):
        try:
            result = EpisodeResult.of_json(json.loads(line))
        except (ValueError, ResultError) as error:
            raise StoreError(f"{path}:{number}: {error}") from error
        if result.id in results:
            raise StoreError(f"{path}:{number}: episode {result.id} is there twice")
        results[result.id] = result
    return list(results.values())


def read_failed(directory: Path) -> list[FailedRun]:
    """Episodes of a run that have no result, a torn last line left out; raises StoreError."""
    path = directory / FAILED
    failed = []
    for number, line in enumerate(_whole_lines(path) if path.exists() else (), 1):
        try:
            failed.append(FailedRun.of_json(json.loads(line)))
        except (ValueError, ResultError) as error:
            raise StoreError(f"{path}:{number}: {error}") from error
    return failed


def _locked(directory: Path) -> IO[bytes]:
    """The run's directory is one process's; raises StoreError when it is another's. The kernel frees a dead one's."""
    file = (directory / CONFIG).open("rb")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        file.close()
        raise StoreError(
            f"--out {directory}: another edge-bench is running in it; wait for it, or name another"
        ) from error
    return file


def _make(directory: Path) -> None:
    try:
        for folder in (EPISODES, VIDEOS):
            (directory / folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StoreError(f"--out {directory}: cannot be made ({error.strerror})") from error


def _append(path: Path, content: Mapping[str, object]) -> None:
    """One line in one write to the end, on the disk before anything else is said of it."""
    data = (json.dumps(content) + "\n").encode()
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    try:
        if os.write(handle, data) != len(data):
            raise OSError(f"{path}: the disk is full; the last line is cut, --resume repairs it")
        os.fsync(handle)
    finally:
        os.close(handle)


def _whole_lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8").split("\n")[:-1]
    except (OSError, UnicodeDecodeError) as error:
        raise StoreError(f"{path}: cannot be read ({error})") from error


def _cut_torn_line(path: Path) -> None:
    """Remove what a process that died while writing has left behind the last whole line."""
    if not path.exists():
        return
    data = path.read_bytes()
    whole = data.rfind(b"\n") + 1
    if whole < len(data):
        with path.open("r+b") as file:
            file.truncate(whole)


def _difference(found: Mapping[str, object], asked: Mapping[str, object], key: str) -> str:
    """The two values of a key, of a table only where they differ, short enough for a line."""
    was, now = found.get(key), asked.get(key)
    if isinstance(was, dict) and isinstance(now, dict):
        inner = next(name for name in sorted({*was, *now}) if was.get(name) != now.get(name))
        return f"{inner}: {_short(was.get(inner))} then, {_short(now.get(inner))} now"
    return f"{_short(was)} then, {_short(now)} now"


def _short(value: object) -> str:
    text = json.dumps(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
