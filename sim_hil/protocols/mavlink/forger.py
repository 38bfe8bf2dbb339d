"""Packets that an attacker on the rover's network adds to the genuine ones, with the rover's own address. Pure.

On a signed link the bridge must drop each of them, and the genuine stream must not suffer (fault matrix row 41).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection
from typing import Final

from pymavlink.dialects.v20 import common

from sim_hil.protocols.mavlink.node import COMPONENT
from sim_hil.protocols.mavlink.vehicle import Mode
from sim_hil.protocols.mavlink.wire import KEY_BYTES, Message, Writer, now_ticks

UNSIGNED, WRONG_KEY, REPLAYED, OTHER_SYSTEM = "unsigned", "wrong_key", "replayed", "other_system"
KINDS: Final = (UNSIGNED, WRONG_KEY, REPLAYED, OTHER_SYSTEM)
"""Attacks by name: without a signature; with another key and a time far ahead; recorded packets; another system."""
_AHEAD_TICKS: Final = 3600 * 100_000  # an hour
_REPLAY_AFTER: Final = 100  # packets, about a second
_EVERY: Final = 5  # genuine packets per forged one


class Forger:
    """Attacker that sends one forged packet for every fifth genuine one."""

    def __init__(self, system: int, key: bytes | None, ticks: int) -> None:
        """`key`: the link's key, for the packets of another system; None on an unsigned link."""
        self._recorded: deque[bytes] = deque(maxlen=_REPLAY_AFTER)
        self._count = 0
        other = system % 254 + 1
        self._writers = {
            UNSIGNED: Writer(system, COMPONENT),
            WRONG_KEY: Writer(system, COMPONENT, bytes(KEY_BYTES), now_ticks() + _AHEAD_TICKS),
            OTHER_SYSTEM: Writer(other, COMPONENT, key, ticks),
        }

    def advance(self, ticks: int) -> None:
        """Set the clock of the other system's signatures."""
        self._writers[OTHER_SYSTEM].advance(ticks)

    def packets(self, genuine: bytes, kinds: Collection[str]) -> list[bytes]:
        """Return the packets that follow a genuine one while the attacks in `kinds` are on; other names are ignored."""
        recorded = self._recorded[0] if len(self._recorded) == _REPLAY_AFTER else None
        self._recorded.append(genuine)
        self._count += 1
        if self._count % _EVERY:
            return []
        forged = [writer.pack(_lie()) for kind, writer in self._writers.items() if kind in kinds]
        return forged + ([recorded] if REPLAYED in kinds and recorded is not None else [])


def _lie() -> Message:
    """Return a heartbeat of a rover that a person drives by its remote: believed, it ends the drive."""
    flags = Mode.MANUAL.base_flags | common.MAV_MODE_FLAG_SAFETY_ARMED
    return common.MAVLink_heartbeat_message(
        common.MAV_TYPE_GROUND_ROVER, common.MAV_AUTOPILOT_PX4, flags, Mode.MANUAL.custom_mode,
        common.MAV_STATE_ACTIVE, 3,
    )  # fmt: skip
