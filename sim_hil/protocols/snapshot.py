"""One float64 array shared with another process: readers get the newest consistent value, and the writer never waits.

The memory is an anonymous file passed as a descriptor, so a killed process leaves nothing behind.
"""

from __future__ import annotations

import mmap
import os
import struct
import time
import zlib
from typing import Final

import numpy as np
from numpy.typing import NDArray

_HEADER: Final = struct.Struct("<QI")  # sequence number (0: nothing yet), CRC-32 of sequence and data
_TRIES: Final = 100
_PAUSE_S: Final = 0.001  # a writer that is preempted during its copy resumes within milliseconds


class TornSnapshotError(RuntimeError):
    """The writer left a value half-written."""


def _crc(sequence: int, data: bytes) -> int:
    return zlib.crc32(data, sequence & 0xFFFFFFFF)


class SnapshotWriter:
    """Writer of the snapshot; pass `fd` to the reader's process."""

    def __init__(self, length: int) -> None:
        self._length = length
        self._sequence = 0
        size = _HEADER.size + 8 * length
        self.fd = os.memfd_create("edge-hil-pose")
        os.ftruncate(self.fd, size)
        self._memory = mmap.mmap(self.fd, size)

    def write(self, values: NDArray[np.float64]) -> None:
        """Replace the value. Raises ValueError for a wrong length."""
        if values.shape != (self._length,):
            raise ValueError(f"snapshot: expected {self._length} numbers, found shape {values.shape}")
        data = values.astype("<f8").tobytes()
        self._sequence += 1
        self._memory[:] = _HEADER.pack(self._sequence, _crc(self._sequence, data)) + data

    def close(self) -> None:
        """Release the memory and the descriptor."""
        self._memory.close()
        os.close(self.fd)


class SnapshotReader:
    """Reader of the snapshot behind a descriptor."""

    def __init__(self, fd: int, length: int) -> None:
        size = _HEADER.size + 8 * length
        found = os.fstat(fd).st_size
        if found != size:
            raise ValueError(f"snapshot: expected {size} bytes for {length} numbers, found {found}")
        self._memory = mmap.mmap(fd, size, prot=mmap.PROT_READ)

    def read(self) -> NDArray[np.float64] | None:
        """Return the newest consistent value; None before the first. Raises TornSnapshotError after 0.1 s.

        A half-written copy fails its CRC and is read again.
        """
        for _ in range(_TRIES):
            content = bytes(self._memory[:])
            sequence, crc = _HEADER.unpack_from(content)
            if sequence == 0:
                return None
            data = content[_HEADER.size :]
            if _crc(sequence, data) == crc:
                return np.frombuffer(data, dtype="<f8").astype(np.float64)
            time.sleep(_PAUSE_S)
        raise TornSnapshotError(f"no consistent snapshot in {_TRIES} tries; check that the writer is alive")

    def close(self) -> None:
        """Release the memory."""
        self._memory.close()
