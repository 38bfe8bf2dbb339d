"""Remote control of a simulated Go2; it is used only by injected faults."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Final

_BYTES: Final = 40


@dataclass
class Remote:
    """State of the remote control: sticks in -1..1, keys as the bits of WirelessController_.keys."""

    lx: float = 0.0
    ly: float = 0.0
    rx: float = 0.0
    ry: float = 0.0
    keys: int = 0

    def release(self) -> None:
        """Release all sticks and keys."""
        self.lx = self.ly = self.rx = self.ry = 0.0
        self.keys = 0

    def as_bytes(self) -> bytes:
        """Encode as LowState_.wireless_remote: keys at byte 2, then lx, rx, ry at 4, 8, 12 and ly at 20."""
        data = bytearray(_BYTES)
        struct.pack_into("<H", data, 2, self.keys)
        struct.pack_into("<3f", data, 4, self.lx, self.rx, self.ry)
        struct.pack_into("<f", data, 20, self.ly)
        return bytes(data)
