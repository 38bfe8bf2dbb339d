"""CAN frames of the base as described by the DBC file, with end-to-end protection: a CRC-8 and a counter. Pure.

Similar to AUTOSAR E2E profile 1. The CRC covers the identifier, so a frame received under another identifier is
invalid. Byte 0 contains the CRC, the low half of byte 1 the counter.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from math import isfinite
from typing import Final

import cantools
from cantools.database.can import Database, Message

from firmware_bridge.can.frame import Frame
from firmware_bridge.can.protection import Checker, Crc, Protection, Verdict
from firmware_bridge.core.config_can import ROBOT_FILES

COUNTER_PERIOD: Final = 16
MAX_AHEAD: Final = 6  # a counter further ahead than this more likely belongs to an older, delayed frame
PROTECTION: Final = Protection(
    Crc(8, polynomial=0x1D, initial=0xFF, final_xor=0xFF),
    crc_bytes=(0,),
    covers=("id_low", "id_high", "data"),
    counter_byte=1,
    counter_shift=0,
    counter_mask=0x0F,
    counter_period=COUNTER_PERIOD,
    max_ahead=MAX_AHEAD,
)
"""CRC-8 SAE J1850 over the identifier and bytes 1 to the end; of b"123456789" it is 0x4B."""


DBC_PATH: Final = ROBOT_FILES / "carter.dbc"
PROTOCOL_VERSION: Final = 1
STATE_IDLE, STATE_ARMED, STATE_ESTOP = 0, 1, 2
ESTOP_NONE, ESTOP_STOP, ESTOP_RESET = 0, 1, 2
SOURCE_NONE, SOURCE_BUTTON, SOURCE_BUS = 0, 1, 2
MODE_DISARM, MODE_ARM = 0, 1
COUNTS_MODULUS: Final = 1 << 24
_UPTIME_MODULUS_MS: Final = 1 << 32


@dataclass(frozen=True)
class Received:
    """One received and checked frame; `signals` is empty unless its CRC is valid."""

    name: str
    verdict: Verdict
    signals: Mapping[str, float]
    newly_lost: int = 0

    @property
    def good(self) -> bool:
        """Whether the frame may be obeyed."""
        return self.verdict is Verdict.GOOD


@cache
def database() -> Database:
    """Load the DBC file (cached)."""
    loaded = cantools.database.load_file(DBC_PATH)
    assert isinstance(loaded, Database)
    return loaded


def sent_by(node: str) -> tuple[Message, ...]:
    """Return the messages that `node` ("Base" or "Controller") sends."""
    return tuple(message for message in database().messages if node in message.senders)


def periods_s(node: str) -> dict[str, float]:
    """Return the cycle times of the periodic messages of `node`, s."""
    return {message.name: message.cycle_time / 1000 for message in sent_by(node) if message.cycle_time}


def clipped(name: str, signals: Mapping[str, float]) -> dict[str, float]:
    """Clip every value to its signal's range, as a sensor does."""
    values = {}
    for signal in database().get_message_by_name(name).signals:
        if signal.name in signals:
            assert signal.minimum is not None and signal.maximum is not None
            values[signal.name] = max(float(signal.minimum), min(float(signal.maximum), signals[signal.name]))
    return values


class Encoder:
    """Encoder of one sender's frames, with a counter per message."""

    def __init__(self) -> None:
        self._counters: dict[str, int] = {}

    def encode(self, name: str, **signals: float) -> Frame:
        """Encode a frame with clipped values. Raises ValueError for a missing, unknown or non-finite signal."""
        message = database().get_message_by_name(name)
        expected = {signal.name for signal in message.signals} - {"Crc", "Counter"}
        if set(signals) != expected:
            raise ValueError(f"{name}: expected signals {sorted(expected)}, found {sorted(signals)}")
        if not all(map(isfinite, signals.values())):  # NaN would be clipped to the largest value
            raise ValueError(f"{name}: expected finite signals, found {signals}")
        counter = self._counters.get(name, 0)
        self._counters[name] = (counter + 1) % COUNTER_PERIOD
        body = message.encode({**clipped(name, signals), "Crc": 0, "Counter": 0}, strict=False)
        return Frame(message.frame_id, PROTECTION.protect(message.frame_id, body, counter))


class Decoder:
    """Decoder and checker of the frames that `node` sends, with one stream per identifier."""

    def __init__(self, node: str) -> None:
        self._messages = {message.frame_id: message for message in sent_by(node)}
        self._checkers = {
            identifier: Checker(message.length, PROTECTION) for identifier, message in self._messages.items()
        }

    def decode(self, frame: Frame) -> Received | None:
        """Decode a frame; None for an unknown identifier."""
        message = self._messages.get(frame.identifier)
        if message is None:
            return None
        checker = self._checkers[frame.identifier]
        verdict = checker.check(frame)
        if verdict in (Verdict.WRONG_CRC, Verdict.WRONG_LENGTH):
            return Received(message.name, verdict, {})
        decoded = message.decode(frame.data, decode_choices=False)
        assert isinstance(decoded, dict)
        signals = {key: float(value) for key, value in decoded.items() if isinstance(value, (int, float))}
        return Received(message.name, verdict, signals, checker.newly_lost)

    def forget(self, name: str) -> None:
        """Reset the stream of a message: its next frame counts as FIRST."""
        self._checkers[database().get_message_by_name(name).frame_id].forget()

    def forget_all(self) -> None:
        """Reset all streams, after a bus failure."""
        for checker in self._checkers.values():
            checker.forget()


def uptime_s(stamp_s: float) -> float:
    """Return the time since switching on in the format of BaseHeartbeat, s (wraps at 2^32 ms)."""
    return (round(stamp_s * 1000) % _UPTIME_MODULUS_MS) / 1000
