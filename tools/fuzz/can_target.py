"""CAN: frames on a virtual bus, bytes of a serial line and datagrams of a multicast bus."""

from __future__ import annotations

import random
import struct
import time
from dataclasses import replace
from typing import Final

import can
import msgpack

from firmware_bridge.can.database import Message, load_database
from firmware_bridge.can.multicast import unpacked
from firmware_bridge.can.robot_link import RobotLink
from firmware_bridge.can.serial_line import SerialFrames
from firmware_bridge.core.config import RobotConfig
from tools.fuzz.harness import mutated

_STEP_NS: Final = 20_000_000
_CHANNEL: Final = "fuzz"


class CanTarget:
    """A base's link on a virtual bus; half of the frames have a right CRC and counter, so that all code is reached."""

    batch = 32

    def __init__(self, config: RobotConfig) -> None:
        assert config.can is not None
        self._can = replace(config.can, interface="virtual", channel=_CHANNEL)
        self.config = replace(config, can=self._can)
        self.decoded = 0
        self._bus = can.Bus(interface="virtual", channel=_CHANNEL)
        self._database = load_database(self.config)
        self.link = RobotLink(self.config, lambda _: None)
        self._messages = list(self._database.received.values())
        self._identifiers = [*self._database.known]
        self._serial = SerialFrames()
        self._now_ns = time.monotonic_ns()

    def now_ns(self) -> int:
        """Return the time of the next step: 20 ms later."""
        self._now_ns += _STEP_NS
        return self._now_ns

    def put(self, chance: random.Random) -> None:
        """Send one frame, or what a piece of a serial line or a datagram decodes to."""
        self.decoded += 1
        kind = chance.random()
        if kind < 0.5:
            message = chance.choice(self._messages)
            self._send(message.identifier, self._right(message, chance))
        elif kind < 0.65:
            message = chance.choice(self._messages)
            self._send(message.identifier, mutated(self._right(message, chance), chance)[:8])
        elif kind < 0.8:
            known = chance.random() < 0.7
            identifier = chance.choice(self._identifiers) if known else chance.randrange(0x800)
            self._send(identifier, chance.randbytes(chance.randrange(9)), error=chance.random() < 0.05)
        elif kind < 0.9:
            self._put_serial(chance)
        elif (found := unpacked(self._datagram(chance))) is not None:
            self._bus.send(found)

    def _right(self, message: Message, chance: random.Random) -> bytes:
        """Return random data, mostly with the clock of the present step; counter and CRC are those of the step."""
        data, uptime = chance.randbytes(message.length), self._database.signals.get("can.uptime")
        if uptime is not None and uptime.message == message.name and chance.random() < 0.9:
            clear = ~(((1 << uptime.bits) - 1) << uptime.shift)
            bits = int.from_bytes(data, uptime.order) & clear | uptime.encode(self._now_ns / 1e9)  # type: ignore[arg-type]
            data = bits.to_bytes(message.length, uptime.order)  # type: ignore[arg-type]
        if message.protection is None:
            return data
        ahead = 0 if chance.random() < 0.95 else chance.randrange(16)
        counter = (self._now_ns // _STEP_NS + ahead) % message.protection.counter_period
        return message.protection.protect(message.identifier, data, counter)

    def _put_serial(self, chance: random.Random) -> None:
        message = chance.choice(self._messages)
        data = self._right(message, chance)
        frame = struct.pack("<BIBI", 0xAA, 0, len(data), message.identifier) + data + b"\xbb"
        self._serial.put(mutated(frame, chance))
        while (found := self._serial.take()) is not None:
            self._bus.send(found)

    def _datagram(self, chance: random.Random) -> bytes:
        if chance.random() < 0.2:
            return chance.randbytes(chance.randrange(64))
        message = chance.choice(self._messages)
        flags = dict.fromkeys(("is_extended_id", "is_remote_frame", "is_error_frame"), chance.random() < 0.05)
        content = {"arbitration_id": message.identifier, "data": self._right(message, chance), **flags}
        if chance.random() < 0.2:
            content[chance.choice(list(content))] = chance.choice((None, -1, 1 << 40, "x", 1.5, [], True))
        return mutated(bytes(msgpack.packb(content)), chance)

    def _send(self, identifier: int, data: bytes, *, error: bool = False) -> None:
        frame = can.Message(arbitration_id=identifier, data=data, is_extended_id=False, is_error_frame=error)
        self._bus.send(frame)

    def motion(self) -> str | None:
        """Read what the link has sent: a velocity that is not zero, a request to arm, a reset of a stop."""
        signals, table, found = self._database.signals, self._can, None
        sent = {message.identifier: message.name for message in self._database.sent.values()}
        while (message := self._bus.recv(0.0)) is not None:
            name, data = sent.get(message.arbitration_id, ""), bytes(message.data)
            for place in ("can.command.vx", "can.command.wz"):
                if signals[place].message == name and signals[place].decode(data) != 0:
                    found = f"{name} {data.hex()}"
            for place, value in (("can.mode.request", table.mode and table.mode.arm), ("can.estop.request", 2)):
                if place in signals and signals[place].message == name and signals[place].raw(data) == value:
                    found = f"{name} {data.hex()}"
        return found

    def close(self) -> None:
        """Leave the bus."""
        self.link.close()
        self._bus.shutdown()
