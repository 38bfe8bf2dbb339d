"""What the bridge asks of the system for its own process: memory that stays, signals that poll() sees."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import signal
import socket
from collections.abc import Iterator
from typing import Final

_LOCK_PRESENT_FUTURE_ONCE_TOUCHED: Final = 1 | 2 | 4  # MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT of <sys/mman.h>
_LEAVE: Final = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP, signal.SIGXCPU)
"""Signals that end the bridge with the robot stopped, also a closed terminal, Ctrl-Z and LimitRTTIME's warning."""

_STAY: Final = (signal.SIGTTOU, signal.SIGTTIN)
"""Signals that would freeze a bridge in the background of a terminal at its next line."""


def settle_memory() -> None:
    """Let the garbage collector pass over everything that exists now: later collections visit a step's objects only."""
    gc.collect()
    gc.freeze()
    gc.collect()  # visits nothing; a later one begins at a quarter of the objects that this one visited


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
        for number in _STAY:
            signal.signal(number, signal.SIG_IGN)
        try:
            yield readable
        finally:
            signal.set_wakeup_fd(-1)
