"""Frames that the bridge sends: their signals, constants, counter and CRC. Pure."""

from __future__ import annotations

from firmware_bridge.can.database import CanDatabase
from firmware_bridge.can.frame import Frame


class FrameSender:
    """Encoder of our frames, with a counter per message."""

    def __init__(self, database: CanDatabase) -> None:
        self._database = database
        self._counters = dict.fromkeys(database.sent, 0)

    def make(self, name: str, values: dict[str, float]) -> Frame:
        """Encode the next frame of a message; `values`: finite numbers by place in the robot file."""
        message, bits = self._database.sent[name], self._database.constants[name]
        for where, value in values.items():
            signal = self._database.signals[where]
            placed = signal.encode(value)
            if signal.order == "big":
                placed = int.from_bytes(placed.to_bytes(message.length, "big"), "little")
            bits |= placed
        data, protection = bits.to_bytes(message.length, "little"), message.protection
        if protection is None:
            return Frame(message.identifier, data)
        counter = self._counters[name]
        self._counters[name] = (counter + 1) % protection.counter_period
        return Frame(message.identifier, protection.protect(message.identifier, data, counter))
