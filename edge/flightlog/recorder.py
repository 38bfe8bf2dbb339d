"""Flight recorder: the runner's inputs, decisions and commands as MCAP files, written by a separate thread.

The control thread must never wait for a disk. `Recorder.put` therefore only appends to a bounded queue, without a lock,
which a preempted writer thread could hold. All slow or fallible work (JSON, compression, write, fsync) happens in the
writer thread. Records beyond the queue's length are dropped and counted by topic.

On disk a recording is bounded too. It consists of parts (`flight.mcap`, `flight.002.mcap`, …), each a whole MCAP that
begins with the `/run` record. Beyond `total_bytes` the oldest part except the first is deleted, so the beginning and
the end of the run are kept. While the file system has less than `free_bytes` left, nothing is written (`error` names
it) and records are dropped and counted. A write error ends the recording.

A chunk is closed and synced at least once a second, so a killed process loses at most the last second (read such a file
with `edge.flightlog.reader.read_messages`).
"""

from __future__ import annotations

import contextlib
import errno
import os
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from edge.flightlog.part import LogPart, PartFile, Payload, encode
from edge.flightlog.reader import part_path, parts

ARMING_FREE_SHARE = 0.07
"""Free share of the file system below which a recording robot is not armed (fault matrix row 51; openpilot)."""
_FLUSH_PERIOD_NS = 900_000_000  # less than one second even when a pass of the loop is late
_POLL_S = 0.05  # the writer polls, so that no caller has to wake it
_PART_AGE_NS = 300 * 1_000_000_000
"""Duration of a part, which bounds the memory of its index: 1 KiB a second, kept until the part is finished."""
_NICENESS = 10
_RESUME = 1.25
"""Multiple of the floor at which a paused recording resumes, so that it does not switch with every flush."""
_RUN_TOPIC = "/run"

_Item = tuple[str, int, Payload]


class RecordSink(Protocol):
    """Place for the records of the runner's loops: a Recorder, or a simulator's own."""

    def put(self, topic: str, stamp_ns: int, payload: Payload) -> None:
        """Take one record; must not wait or raise."""
        ...


@dataclass(frozen=True)
class RecorderLimits:
    """Memory and disk limits of a recording."""

    records: int = 4096
    """Queue length: more than a minute of all records of a run."""
    picture_bytes: int = 64 * 1024 * 1024
    """Largest number of pictures in the queue."""
    part_bytes: int = 256 * 1024 * 1024
    total_bytes: int = 4 * 1024 * 1024 * 1024
    free_bytes: int = 512 * 1024 * 1024
    """Space left free for other programs on that file system."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value < 1 and name != "free_bytes":
                raise ValueError(f"recorder limit {name} must be positive, found {value}")
        if self.free_bytes < 0:
            raise ValueError(f"recorder limit free_bytes must be 0 or more, found {self.free_bytes}")
        if self.total_bytes < 3 * self.part_bytes:
            raise ValueError(
                f"recorder limit total_bytes {self.total_bytes}: expected at least three parts of {self.part_bytes}, "
                "the first, the one being written and the one before it"
            )


class Recorder:
    """Write records to MCAP files without ever making the caller wait.

    A path that cannot be opened is reported in `error`, not raised: the caller decides whether a run without a
    recording may start. Each topic is put by one thread at a time (otherwise counts of drops may be one short), and
    pictures by one thread.
    """

    def __init__(
        self,
        path: str | Path,
        limits: RecorderLimits | None = None,
        *,
        from_run: bool = False,
        say: Callable[[str], None] = lambda _line: None,
    ) -> None:
        """`from_run`: nothing before the `/run` record is kept, however long the robot waits to be armed.

        `say` takes a line where recording pauses, goes on or stops; must not wait or raise.
        """
        self.path = Path(path)
        self._limits = limits or RecorderLimits()
        self._begun, self._say = not from_run, say
        self._queue: deque[_Item] = deque()
        self._refused: dict[str, int] = {}  # by `put`
        self._picture_bytes_in = 0  # by `put`
        self._picture_bytes_out = 0
        self._ended = False
        # Lock between the writer and readers of its counts; `put` never takes it.
        self._lock = threading.Lock()
        self._lost: Counter[str] = Counter()
        self._unsaved: Counter[str] = Counter()  # taken from the queue since the last flush
        self._error: str | None = None
        self._paused: str | None = None
        self.was_paused = False
        """Whether records were dropped because the disk was nearly full."""
        self._closing = threading.Event()
        self._run_item: _Item | None = None
        self._finished: list[tuple[Path, int]] = []
        self._discarded = 0
        self._number = 1
        self._part: LogPart | None = None
        self._made: tuple[int, int] | None = None
        file: PartFile | None = None
        try:
            if len(parts(self.path)) > 1:
                raise FileExistsError(errno.EEXIST, f"{parts(self.path)[-1].name} of another recording lies beside it")
            # A device or a pipe is there before; a file is never overwritten.
            new = not self.path.exists() or self.path.is_file()
            file = PartFile(Path(os.path.realpath(self.path)), new=new)
            self._made = file.identity if new else None
        except OSError as error:
            self._ended = True
            advice = "; name another file" if isinstance(error, FileExistsError) else ""
            self._error = f"cannot open {self.path} for recording: {error.strerror or error}{advice}"
        # A daemon thread: a disk that hangs must not keep the process alive.
        self._thread = threading.Thread(target=self._run, args=(file,), name="recorder", daemon=True)
        if file is not None:
            self._thread.start()

    @property
    def error(self) -> str | None:
        """Reason why nothing is written, in one line; None while recording works."""
        with self._lock:
            return self._error or self._paused

    @property
    def dropped(self) -> dict[str, int]:
        """Records per topic that were passed to `put` and may not be on disk.

        While `error` is None these were refused or not encodable. An error adds the queued records and those written
        since the last flush, some of which the file may contain: the count is never too low.
        """
        with self._lock:
            counts = Counter(self._refused.copy()) + self._lost
            # A record that `put` was adding while the recording ended will not be written.
            left = self._queue.copy() if self._ended and not self._thread.is_alive() else ()
        counts.update(topic for topic, _, _ in left)
        return dict(counts)

    def statistics(self) -> dict[str, Any]:
        """Return for a run's result: dropped records with the reason, and the files on disk."""
        part = self._part
        with self._lock:
            written = sum(size for _, size in self._finished) + (0 if part is None else part.file.length)
            found = {"error": self._error or self._paused, "bytes": written, "discarded_parts": self._discarded}
        return {"dropped": self.dropped, **found, "parts": [str(path) for path in parts(self.path)]}

    def put(self, topic: str, stamp_ns: int, payload: Payload) -> None:
        """Queue one record; never blocks, never raises, encodes nothing.

        `payload` is a JSON mapping (numpy values allowed) that no thread changes afterwards, or the bytes of a JPEG,
        which become a `foxglove.CompressedImage`.
        """
        size = len(payload) if isinstance(payload, bytes) else 0
        limits = self._limits
        if not self._begun:
            if topic != _RUN_TOPIC:
                return
            self._begun = True
        full = len(self._queue) >= limits.records or (
            size > 0 and self._picture_bytes_in + size - self._picture_bytes_out > limits.picture_bytes
        )
        if full or self._ended:
            self._refused[topic] = self._refused.get(topic, 0) + 1
            return
        if size:
            self._picture_bytes_in += size
        self._queue.append((topic, stamp_ns, payload))

    def close(self, timeout_s: float = 5.0) -> bool:
        """Write the queue, finish the file and return whether all records are on disk in time."""
        self._ended = True
        self._closing.set()
        if self._thread.ident is not None:
            self._thread.join(timeout_s)
            if self._thread.is_alive():
                self._fail(f"{self.path} was not finished within {timeout_s:g} s; its last second may be missing")
        return self.error is None

    def discard(self) -> None:
        """Delete the file of a run that did not begin, after `close`; another's file stays."""
        with contextlib.suppress(OSError):  # removed meanwhile
            status = self.path.stat()
            if (status.st_dev, status.st_ino) == self._made:
                Path(os.path.realpath(self.path)).unlink()

    def _take(self) -> _Item | None:
        with self._lock:
            try:
                item = self._queue.popleft()
            except IndexError:
                return None
            if isinstance(item[2], bytes):
                self._picture_bytes_out += len(item[2])
            self._unsaved[item[0]] += 1
            return item

    def _fail(self, message: str) -> None:
        self._ended = True
        while self._take() is not None:
            pass
        with self._lock:
            self._error = self._error or message
            self._lost.update(self._unsaved)
            self._unsaved.clear()
        self._say(message)

    def _drop_taken(self, topic: str) -> None:
        with self._lock:
            if self._unsaved[topic] > 0:  # otherwise _fail has counted it
                self._unsaved[topic] -= 1
                self._lost[topic] += 1

    def _all_saved(self) -> None:
        with self._lock:
            self._unsaved.clear()

    def _run(self, file: PartFile) -> None:
        with contextlib.suppress(OSError):
            # For ordinary scheduling; Linux niceness is per thread.
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICENESS)
        try:
            self._write_all(self._begin(file))
        except Exception as error:  # noqa: BLE001 - `error` must always give the reason for the thread's end
            reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
            self._fail(f"recording to {self.path} stopped: {reason or type(error).__name__}")
        finally:
            if self._part is not None:
                self._part.file.close()

    def _begin(self, file: PartFile) -> LogPart:
        try:
            self._part = LogPart(file, self._number)
        except OSError:
            file.close()
            raise
        self._part.flush()
        return self._part

    def _write_all(self, part: LogPart) -> None:
        self._check_space()
        begun_ns = flushed_ns = time.monotonic_ns()
        while True:
            # Read before the queue is emptied, so that all records from before close() are written.
            closing = self._closing.is_set()
            while (item := self._take()) is not None:
                self._write(part, item)
                if part.file.length >= self._limits.part_bytes and self._paused is None:
                    part, begun_ns = self._next_part(part), time.monotonic_ns()
                if time.monotonic_ns() - flushed_ns >= _FLUSH_PERIOD_NS:
                    break
            now_ns = time.monotonic_ns()
            if now_ns - flushed_ns >= _FLUSH_PERIOD_NS:
                part.flush()
                if part.file.removed:
                    raise OSError("the file was removed while recording")
                self._all_saved()
                self._check_space()
                flushed_ns = now_ns
                if part.is_empty or self._paused is not None:
                    begun_ns = now_ns  # its index does not grow, and a full disk could take no other part
                elif now_ns - begun_ns >= _PART_AGE_NS:
                    part, begun_ns = self._next_part(part), now_ns
            if closing and not self._queue:
                part.finish()
                self._all_saved()
                return
            if not self._queue:
                self._closing.wait(_POLL_S)

    def _write(self, part: LogPart, item: _Item) -> None:
        topic, stamp_ns, payload = item
        try:
            if topic == _RUN_TOPIC:
                encode(payload, stamp_ns)  # every part begins with it, so it must be encodable
                self._run_item = item
            if self._paused is not None:
                self.was_paused = True
                self._drop_taken(topic)
                return
            if self._run_item is not None and self._run_item is not item and not part.has(_RUN_TOPIC):
                part.add(*self._run_item)
            part.add(*item)
        except (TypeError, ValueError, RecursionError):
            # One record outside JSON must not end the recording of all others.
            self._drop_taken(topic)

    def _next_part(self, part: LogPart) -> LogPart:
        part.finish()
        part.file.close()
        self._all_saved()
        with self._lock:
            self._finished.append((part_path(self.path, self._number), part.file.length))
            self._part = None
        while self._limits.part_bytes + sum(size for _, size in self._finished) > self._limits.total_bytes:
            oldest, _ = self._finished[1]
            oldest.unlink(missing_ok=True)
            with self._lock:
                self._finished.pop(1)
                self._discarded += 1
        self._number += 1
        return self._begin(PartFile(part_path(self.path, self._number), new=True))

    def _check_space(self) -> None:
        """Pause below the floor; resume once there is clearly more space."""
        floor = self._limits.free_bytes
        free = _free(self.path)
        if free is None or free[0] >= floor * (_RESUME if self._paused else 1):
            paused = None
        else:
            paused = (
                f"recording to {self.path} is paused: {free[0] / 2**20:.0f} MiB are free, "
                f"{floor / 2**20:.0f} MiB are left to others; delete old logs"
            )
        with self._lock:
            before, self._paused = self._paused, paused
        if (before is None) != (paused is None):
            self._say(paused or f"recording to {self.path} goes on")


def arming_free_bytes(total_bytes: int, limits: RecorderLimits | None = None) -> int:
    """Return the free bytes below which a robot that records to a file system of this size is not armed."""
    return max((limits or RecorderLimits()).free_bytes, round(ARMING_FREE_SHARE * total_bytes))


def space_refusal(path: Path, limits: RecorderLimits | None = None) -> str | None:
    """Return why a robot that records to `path` must not be armed (fault matrix row 51); None: it may."""
    free = _free(path)
    if free is None:
        return None
    floor = arming_free_bytes(free[1], limits)
    if free[0] >= floor:
        return None
    return (
        f"{free[0] / 2**20:.0f} MiB of its file system are free, recording needs {floor / 2**20:.0f} MiB "
        f"({ARMING_FREE_SHARE:.0%} of it, and what is left to others); delete old logs or record elsewhere"
    )


def _free(path: Path) -> tuple[int, int] | None:
    """Return the free and total bytes of the file system of `path`; None where it cannot be read."""
    try:
        found = os.statvfs(path.parent)
    except OSError:
        return None
    if found.f_blocks == 0:
        return None
    return found.f_bavail * found.f_frsize, found.f_blocks * found.f_frsize
