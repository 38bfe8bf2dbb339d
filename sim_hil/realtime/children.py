"""Start, watch and end the processes of a run. No child outlives its parent, whatever ends the parent."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import TracebackType

from sim_hil.processes.child_process import last_lines, signal_on_parent_death

_POLL_S = 0.05

Tick = Callable[[], None]
"""Called a few times a second while waiting (progress)."""


class StepError(RuntimeError):
    """A failed step of a run; the message contains the end of its log."""


@dataclass
class Child:
    """One running step: a process in its own session, its stderr and stdout in a log file."""

    step: str
    process: subprocess.Popen[bytes]
    log: Path

    @property
    def running(self) -> bool:
        """Whether the process still runs."""
        return self.process.poll() is None

    def failure(self, what: str) -> StepError:
        """Return an error with the step, its log and the log's last lines."""
        lines = "\n".join(f"    {line}" for line in last_lines(self.log)) or "    (the log is empty)"
        return StepError(f"step '{self.step}' failed: {what}; its log {self.log} ends with\n{lines}")


@dataclass
class Children:
    """All processes of a run; leaving the block ends them in reverse order of their start."""

    log_dir: Path
    grace_s: float = 5.0
    _started: list[Child] = field(default_factory=list)

    def __enter__(self) -> Children:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with uninterrupted():
            for child in reversed(self._started):
                self.end(child)

    def start(
        self, step: str, command: Sequence[str], *, fifo_priority: int = 0, processors: Collection[int] = ()
    ) -> Child:
        """Start a step. Raises StepError if its program cannot be started.

        `fifo_priority` above 0: real-time priority, if the user is permitted to use it. `processors`: on which it may
        run; empty: on any.
        """
        log = self.log_dir / f"{step}.log"
        with log.open("wb") as stream:
            try:
                process = subprocess.Popen(
                    list(command),
                    stdin=subprocess.DEVNULL,
                    stdout=stream,
                    stderr=subprocess.STDOUT,
                    # A session of its own: Ctrl-C reaches the parent alone, which then stops its children in order.
                    start_new_session=True,
                    # System calls alone: nothing in it can meet a lock.
                    preexec_fn=partial(_prepare, fifo_priority, processors),
                )
            except OSError as error:
                raise StepError(f"step '{step}' failed: {command[0]} cannot be started: {error}") from error
        child = Child(step, process, log)
        self._started.append(child)
        return child

    def wait_until(self, child: Child, ready: Callable[[], bool], timeout_s: float, what: str, tick: Tick) -> None:
        """Wait until `ready()`. Raises StepError if a child ends before, or after `timeout_s`."""
        deadline_ns = time.monotonic_ns() + int(timeout_s * 1e9)
        while not ready():
            self.check_others(None)
            if time.monotonic_ns() > deadline_ns:
                raise child.failure(f"no {what} within {timeout_s:g} s")
            tick()
            time.sleep(_POLL_S)

    def wait(self, child: Child, timeout_s: float, tick: Tick) -> int:
        """Wait until a child ends and return its exit code. Raises StepError if another child ends before."""
        deadline_ns = time.monotonic_ns() + int(timeout_s * 1e9)
        while child.running:
            self.check_others(child)
            if time.monotonic_ns() > deadline_ns:
                raise child.failure(f"still running after {timeout_s:g} s")
            tick()
            time.sleep(_POLL_S)
        return child.process.returncode

    def check_others(self, but: Child | None) -> None:
        """Check that all children except `but` still run. Raises StepError."""
        for child in self._started:
            if child is not but and not child.running:
                raise child.failure(f"ended too early with exit code {child.process.returncode}")

    def stop(self, child: Child) -> int:
        """End a child by SIGINT and return its exit code. Raises StepError if it has to be killed."""
        ended_itself = self._interrupt(child)
        self._started.remove(child)
        if not ended_itself:
            raise child.failure(f"did not end within {self.grace_s:g} s of SIGINT and was killed")
        return child.process.returncode

    def forget(self, child: Child) -> None:
        """Remove a child that has ended as expected."""
        self._started.remove(child)

    def end(self, child: Child) -> None:
        """End a child by SIGINT, then its whole session by SIGKILL."""
        self._interrupt(child)

    def _interrupt(self, child: Child) -> bool:
        ended_itself = True
        if child.running:
            child.process.send_signal(signal.SIGINT)
            try:
                child.process.wait(self.grace_s)
            except subprocess.TimeoutExpired:
                ended_itself = False
        _kill_session(child.process.pid)  # also what it started and left behind
        child.process.wait()
        return ended_itself


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Ignore SIGINT and SIGTERM during a clean-up, which takes a few seconds at most."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, signal.SIG_IGN) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _kill_session(pid: int) -> None:
    with suppress(ProcessLookupError, PermissionError):  # the group has ended
        os.killpg(pid, signal.SIGKILL)  # start_new_session made the child the leader of a group of its own


def _prepare(fifo_priority: int, processors: Collection[int]) -> None:
    # Even a SIGKILL of the parent must not leave a robot walking: the kernel then interrupts the children.
    signal_on_parent_death(signal.SIGINT)
    if fifo_priority > 0:
        with suppress(PermissionError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(fifo_priority))
    if processors:
        os.sched_setaffinity(0, processors)
