"""One participant for several readers of a process that are opened at different times; loads DDS when it is opened."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

from firmware_bridge.core.sections import DdsConfig

if TYPE_CHECKING:
    from firmware_bridge.dds.bus import Bus


class SharedBus:
    """The participant of one process in one domain, opened by the first user; its owner closes it."""

    def __init__(self, network: DdsConfig) -> None:
        self.network = network
        self._lock = threading.Lock()  # two threads may come first
        self._bus: Bus | None = None

    def open(self) -> Bus:
        """Return the participant. Raises DdsError while the domain cannot be joined; the next call tries again."""
        from firmware_bridge.dds.bus import Bus  # needs the extra of its protocol

        with self._lock:
            if self._bus is None:
                self._bus = Bus(self.network)
            return self._bus

    def close(self) -> None:
        """Leave the domain; nothing made by the participant works after."""
        with self._lock:
            bus, self._bus = self._bus, None
            if bus is not None:
                bus.close()
