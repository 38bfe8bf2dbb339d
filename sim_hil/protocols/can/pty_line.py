"""Serial line between two processes of one machine: two ptys and a thread that copies bytes between them.

Data for an end that no process has opened is discarded, so a new client receives only data sent from then on.
"""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
import tty
from pathlib import Path
from typing import Final

_CHUNK: Final = 4096
_POLL_MS: Final = 50
_UNPLUGGED_S: Final = 0.01


class PtyLine:
    """Serial line; `near`: device of our end, `far`: link that the other process opens. Raises OSError."""

    def __init__(self, far: Path) -> None:
        """Create the line; `far`: a path that does not exist yet, removed by `close`."""
        self._masters: list[int] = []
        self.far = far
        devices = []
        try:
            for _ in range(2):
                master, slave = os.openpty()
                tty.setraw(slave)
                devices.append(os.ttyname(slave))
                os.close(slave)  # so that the line can detect whether a process has opened this end
                os.set_blocking(master, False)
                self._masters.append(master)
            far.symlink_to(devices[1])
        except OSError:
            self._release()
            raise
        self.near = devices[0]
        self._ending = False
        self._thread = threading.Thread(target=self._carry, name="pty-line", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Close both ends and remove the link; may be called twice."""
        if self._ending:
            return
        self._ending = True
        self._thread.join()
        with contextlib.suppress(FileNotFoundError):
            self.far.unlink()
        self._release()

    def _release(self) -> None:
        for master in self._masters:
            os.close(master)
        self._masters.clear()

    def _carry(self) -> None:
        poller = select.poll()
        for master in self._masters:
            poller.register(master, select.POLLIN)
        near, far = self._masters
        other = {near: far, far: near}
        while not self._ending:
            events = dict(poller.poll(_POLL_MS))
            for master, event in events.items():
                if event & select.POLLIN:
                    unplugged = events.get(other[master], 0) & select.POLLHUP or _unplugged(other[master])
                    self._move(master, None if unplugged else other[master])
            if any(event & select.POLLHUP for event in events.values()):
                time.sleep(_UNPLUGGED_S)  # an unplugged end would otherwise wake this thread continuously

    def _move(self, source: int, target: int | None) -> None:
        with contextlib.suppress(BlockingIOError):
            try:
                data = os.read(source, _CHUNK)
            except OSError:  # EIO: unplugged between poll and read
                return
            if target is not None:
                os.write(target, data)  # overflow is lost, as on a line without handshake


def _unplugged(master: int) -> bool:
    poller = select.poll()
    poller.register(master, 0)
    return any(event & select.POLLHUP for _, event in poller.poll(0))
