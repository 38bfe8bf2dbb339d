"""The base's frames as the DBC file describes them: names and physical values on one side, bytes on the other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from math import isfinite
from pathlib import Path
from typing import Final

import cantools
from cantools.database.can import Database, Message

from sim_hil.protocols.can.e2e import COUNTER_PERIOD, Checker, Frame, Verdict, protect

DBC_PATH: Final = Path(__file__).with_name("carter.dbc")
PROTOCOL_VERSION: Final = 1
STATE_IDLE, STATE_ARMED, STATE_ESTOP = 0, 1, 2
ESTOP_NONE, ESTOP_STOP, ESTOP_RESET = 0, 1, 2
SOURCE_NONE, SOURCE_BUTTON, SOURCE_BUS = 0, 1, 2
MODE_DISARM, MODE_ARM = 0, 1
COUNTS_MODULUS: Final = 1 << 24
_UPTIME_MODULUS_MS: Final = 1 << 32


@dataclass(frozen=True)
class Received:
    """One frame that a receiver has judged; `signals` is empty unless its CRC is right."""

    name: str
    verdict: Verdict
    signals: Mapping[str, float]
    newly_lost: int = 0

    @property
    def good(self) -> bool:
        """Whether it may be obeyed."""
        return self.verdict is Verdict.GOOD


@cache
def database() -> Database:
    """The DBC file, read once."""
    loaded = cantools.database.load_file(DBC_PATH)
    assert isinstance(loaded, Database)
    return loaded


def sent_by(node: str) -> tuple[Message, ...]:
    """Messages that `node` ("Base" or "Controller") sends."""
    return tuple(message for message in database().messages if node in message.senders)


def periods_s(node: str) -> dict[str, float]:
    """Cycle times of the messages that `node` sends by the clock."""
    return {message.name: message.cycle_time / 1000 for message in sent_by(node) if message.cycle_time}


def clipped(name: str, signals: Mapping[str, float]) -> dict[str, float]:
    """Every value moved into its signal's range; so a sensor beyond its range reports the range's end."""
    values = {}
    for signal in database().get_message_by_name(name).signals:
        if signal.name in signals:
            assert signal.minimum is not None and signal.maximum is not None
            values[signal.name] = max(float(signal.minimum), min(float(signal.maximum), signals[signal.name]))
    return values


class Encoder:
    """Makes the frames of one sender, each with its next counter."""

    def __init__(self) -> None:
        self._counters: dict[str, int] = {}

    def encode(self, name: str, **signals: float) -> Frame:
        """The frame, values clipped to their ranges. Raises ValueError for a missing, unknown or not finite signal."""
        message = database().get_message_by_name(name)
        expected = {signal.name for signal in message.signals} - {"Crc", "Counter"}
        if set(signals) != expected:
            raise ValueError(f"{name}: expected signals {sorted(expected)}, found {sorted(signals)}")
        if not all(map(isfinite, signals.values())):  # NaN would be clipped to the largest value
            raise ValueError(f"{name}: expected finite signals, found {signals}")
        counter = self._counters.get(name, 0)
        self._counters[name] = (counter + 1) % COUNTER_PERIOD
        body = message.encode({**clipped(name, signals), "Crc": 0, "Counter": 0}, strict=False)
        return Frame(message.frame_id, protect(message.frame_id, body, counter))


class Decoder:
    """Judges and reads the frames that `node` sends; a stream for every identifier."""

    def __init__(self, node: str) -> None:
        self._messages = {message.frame_id: message for message in sent_by(node)}
        self._checkers = {identifier: Checker(message.length) for identifier, message in self._messages.items()}

    def decode(self, frame: Frame) -> Received | None:
        """What the frame says; None for an identifier that is not expected."""
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
        """The stream of that message has ended: its next frame only starts another."""
        self._checkers[database().get_message_by_name(name).frame_id].forget()

    def forget_all(self) -> None:
        """The bus was away."""
        for checker in self._checkers.values():
            checker.forget()


def uptime_s(stamp_s: float) -> float:
    """A time since switching on as BaseHeartbeat carries it."""
    return (round(stamp_s * 1000) % _UPTIME_MODULUS_MS) / 1000
