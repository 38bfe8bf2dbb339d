"""What the bridge asks of the system for its own process: priority, memory that stays, signals that poll() sees."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import signal
import socket
from collections.abc import Iterator
from typing import Final

from firmware_bridge.core.config import BRIDGE_PRIORITY

_LOCK_PRESENT_FUTURE_ONCE_TOUCHED: Final = 1 | 2 | 4  # MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT of <sys/mman.h>
_LEAVE: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP, signal.SIGXCPU)
"""Signals that end the bridge with the robot stopped, also a closed terminal, Ctrl-Z and LimitRTTIME's warning."""


def settle_memory() -> None:
    """Let the garbage collector pass over everything that exists now: later collections visit a step's objects only."""
    gc.collect()
    gc.freeze()
    gc.collect()  # visits nothing; a later one begins at a quarter of the objects that this one visited


def take_priority(priority: int) -> None:
    """Give this thread, and those that it starts, a real-time priority where that is permitted.

    The installed service's is BRIDGE_PRIORITY, the runner's threads have less. A priority above it stays.
    """
    is_real_time = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK in (os.SCHED_FIFO, os.SCHED_RR)
    if is_real_time and os.sched_getparam(0).sched_priority > BRIDGE_PRIORITY:
        return
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))


def lock_memory() -> str | None:
    """Keep this process's pages in memory once touched; why not, in one line, when the system does not permit it."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_LOCK_PRESENT_FUTURE_ONCE_TOUCHED) == 0:
        return None
    error = os.strerror(ctypes.get_errno())
    return f"memory is not locked ({error}): a page fault may delay a step; LimitMEMLOCK=infinity permits it"


@contextlib.contextmanager
def signals_to_socket() -> Iterator[socket.socket]:
    """A socket that becomes readable at a signal to leave, so that poll() wakes up."""
    readable, writable = socket.socketpair()
    with readable, writable:
        writable.setblocking(False)
        signal.set_wakeup_fd(writable.fileno())
        for number in _LEAVE:
            if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:  # nohup asks to stay
                signal.signal(number, lambda *_: None)
        try:
            yield readable
        finally:
            signal.set_wakeup_fd(-1)
