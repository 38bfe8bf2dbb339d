"""Busy processes beside a measurement: the load of a machine that runs other programs too."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Final

from sim_hil.processes.child_process import end_with_parent

MOST_BUSY: Final = 256
_SPIN: Final = "while True: pass"


@contextmanager
def busy_processes(count: int) -> Iterator[list[int]]:
    """Keep `count` processes of ordinary priority computing, and end them; yields their ids."""
    ends = partial(end_with_parent, os.getpid())
    command = [sys.executable, "-I", "-S", "-c", _SPIN]
    with ExitStack() as stack:
        started: list[int] = []
        for _ in range(count):
            child = stack.enter_context(subprocess.Popen(command, stdin=subprocess.DEVNULL, preexec_fn=ends))
            stack.callback(child.kill)  # runs before its context, which waits for it
            started.append(child.pid)
        yield started


@contextmanager
def paused(processes: Collection[int]) -> Iterator[None]:
    """Let the processes with these ids stand still inside the context."""
    for process in processes:
        os.kill(process, signal.SIGSTOP)
    try:
        yield
    finally:
        for process in processes:
            os.kill(process, signal.SIGCONT)
