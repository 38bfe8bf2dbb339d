"""Limits of time and memory while files that are not proven yet are opened and run for the first time.

A graph can loop for ever or allocate without end, and ONNX Runtime computes constants while it opens one. A thread
watches: it ends the call under way, and when that does not help, the process. The robot is not armed meanwhile.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from edge.artifacts.files import ArtifactError
from edge.artifacts.manifest import Artifacts
from edge.core.cli import EXIT_REFUSED
from edge.inference.graph import CancelledError, Interrupt

OPEN_S: Final = 180.0
"""Time limit of opening all graphs and the tokenizer, s; a large model takes some 10 s."""
WARM_UP_S: Final = 180.0
POLL_S: Final = 0.02
GRACE_S: Final = 2.0
"""Time for a call to end after it was told to, s; then the process ends."""
MEMORY_GRACE_S: Final = 0.2
"""The same where memory grows: the machine's may end before."""
SPARE_BYTES: Final = 2 << 30
"""Memory of a start beside weights and KV buffers: ONNX Runtime's arenas and a provider's workspace, bytes."""
COPIES: Final = 4
"""Copies of the weights that a provider may hold while it opens a graph."""
SHARE: Final = 0.9
"""Largest share of the memory that the machine has left at the start."""


@dataclass(frozen=True)
class Memory:
    """Readings of memory, bytes; tests replace them."""

    own: Callable[[], int]
    """Anonymous memory of this process."""
    available: Callable[[], int]
    """Memory that the machine has left."""


def _field(path: Path, name: str) -> int:
    """Read a field of /proc in kB as bytes; 0 if it cannot be read."""
    try:
        lines = path.read_text(encoding="ascii", errors="replace").splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{name}:"))
    except (OSError, StopIteration, ValueError, IndexError):
        return 0


LINUX: Final = Memory(
    own=lambda: _field(Path("/proc/self/status"), "RssAnon"),
    available=lambda: _field(Path("/proc/meminfo"), "MemAvailable"),
)


def memory_limit(artifacts: Artifacts, available: int) -> int:
    """Return by how much a start may make this process grow, bytes; `available`: memory left, 0 if unknown."""
    weights = sum(map(len, artifacts.contents.values())) + sum(i.size for i in artifacts.identities.values())
    limit = COPIES * weights + artifacts.cache_bytes + SPARE_BYTES
    return min(limit, round(SHARE * available)) if available else limit


def end_process(line: str, code: int = EXIT_REFUSED) -> None:
    """Print one line and end the process at once: a thread hangs in native code that nothing else ends."""
    name = Path(sys.argv[0]).stem if sys.argv and sys.argv[0] else "edge"
    os.write(2, f"{name}: {line}\n".encode(errors="replace"))
    os._exit(code)


class StartGuard:
    """Watches one start; a limit that is exceeded becomes an ArtifactError, or the end of the process."""

    def __init__(
        self, artifacts: Artifacts, *, end: Callable[[str], None] = end_process, memory: Memory = LINUX
    ) -> None:
        """`end` is called with one line when the call under way does not end."""
        self.interrupt = Interrupt()
        self._where = artifacts.directory
        self._end = end
        self._memory = memory
        self._before = memory.own()
        self._limit_bytes = memory_limit(artifacts, memory.available())
        self._reason: str | None = None

    @contextmanager
    def stage(self, what: str, limit_s: float) -> Iterator[None]:
        """Limit the time of a block, s, and the memory until its end; raises ArtifactError."""
        done = threading.Event()
        deadline_ns = time.monotonic_ns() + round(limit_s * 1e9)
        watcher = threading.Thread(
            target=self._watch, args=(done, what, limit_s, deadline_ns), name="start-guard", daemon=True
        )
        watcher.start()
        try:
            yield
        except CancelledError as error:
            if self._reason is None:
                raise
            raise ArtifactError(self._reason) from error
        finally:
            done.set()
            watcher.join()
        if self._reason is not None:
            raise ArtifactError(self._reason)

    def _watch(self, done: threading.Event, what: str, limit_s: float, deadline_ns: int) -> None:
        while not done.wait(POLL_S):
            grown = self._memory.own() - self._before
            if time.monotonic_ns() > deadline_ns:
                grace_s = GRACE_S
                excess = f"not done after its limit of {limit_s:g} s"
            elif grown > self._limit_bytes:
                grace_s = MEMORY_GRACE_S
                excess = f"took {grown >> 20} MiB of memory, its limit is {self._limit_bytes >> 20} MiB"
            else:
                continue
            self._reason = f"{self._where}: {what}: {excess}; verify the artifacts (edge-export verify) or export again"
            self.interrupt.set()
            if not done.wait(grace_s):
                self._end(self._reason)
            return
