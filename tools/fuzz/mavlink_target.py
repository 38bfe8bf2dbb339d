"""MAVLink: datagrams of an autopilot's socket."""

from __future__ import annotations

import contextlib
import random
import socket
import time
from dataclasses import replace
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as dialect
from pymavlink.generator.mavcrc import x25crc

from firmware_bridge.core.config import RobotConfig
from firmware_bridge.mavlink import modes
from firmware_bridge.mavlink.robot_link import RobotLink
from sim_hil.protocols.mavlink.wire import Message, Reader
from tools.fuzz.harness import mutated

_SET_MODE: Final = 176
_ARM: Final = 400
_NUMBERS: Final = (0, 1, 22, 30, 32, 77, 84, 86, 111, 147, 193, 230, 253, 331, 75, 76, 69, 11, 70)
_STAMPS: Final = {30: (4, 1_000_000), 32: (4, 1_000_000), 331: (8, 1_000)}
"""Messages that begin with a time: its bytes and its unit, ns."""
_STANDARD: Final = (0, 1, 30, 32, 147, 253, 331)  # of an autopilot that reports


class MavlinkTarget:
    """A rover's link on a UDP socket; most packets have a right checksum, half of them also the autopilot's number."""

    batch = 32

    def __init__(self, config: RobotConfig) -> None:
        assert config.mavlink is not None
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(5.0)
        link = f"udp:127.0.0.1:{self._socket.getsockname()[1]}"
        self._mavlink = replace(config.mavlink, link=link)
        self.config = replace(config, mavlink=self._mavlink)
        self.decoded = 0
        self._seq = 0
        self._reader = Reader()
        self.link = RobotLink(self.config, lambda _: None)
        self.link.read(time.monotonic_ns())  # sends a heartbeat, from which the address is known
        self._address = self._socket.recvfrom(2048)[1]
        self._socket.setblocking(False)

    def now_ns(self) -> int:
        """Return the present time."""
        return time.monotonic_ns()

    def put(self, chance: random.Random) -> None:
        """Send one datagram."""
        self.decoded += 1
        kind = chance.random()
        if kind < 0.1:
            data = chance.randbytes(chance.randrange(1, 300))
        elif kind < 0.4:
            data = mutated(self._packet(chance), chance)
        else:
            data = self._packet(chance)
        self._socket.sendto(data, self._address)

    def _packet(self, chance: random.Random) -> bytes:
        """Return a packet with a right checksum and random or mutated fields."""
        number = chance.choice(_STANDARD if chance.random() < 0.6 else _NUMBERS)
        kind = dialect.mavlink_map[number]
        size = kind.unpacker.size
        payload = chance.randbytes(size) if chance.random() < 0.3 else mutated(bytes(size), chance)[:255]
        if number in _STAMPS and chance.random() < 0.7:
            size, unit_ns = _STAMPS[number]
            payload = (self.now_ns() // unit_ns % (1 << 8 * size)).to_bytes(size, "little") + payload[size:]
        self._seq = (self._seq + 1) % 256
        ours = chance.random() < 0.8
        system, component = (self._mavlink.system, 1) if ours else (chance.randrange(256), chance.randrange(256))
        head = bytes((len(payload), 0, 0, self._seq, system, component)) + number.to_bytes(3, "little")
        crc: int = x25crc(head + payload + bytes((kind.crc_extra,))).crc
        return b"\xfd" + head + payload + crc.to_bytes(2, "little")

    def motion(self) -> str | None:
        """Read what the link has sent: a velocity that is not zero, a request to arm or to switch to driving."""
        found = None
        with contextlib.suppress(BlockingIOError):
            while True:
                for message in self._reader.read(self._socket.recv(2048)):
                    found = str(message) if self._moves(message) else found
        return found

    def _moves(self, message: Message) -> bool:
        if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
            return any((message.vx, message.vy, message.vz, message.yaw_rate))
        if message.get_type() != "COMMAND_LONG":
            return False
        drive = modes.BY_NAME[self._mavlink.autopilot].drive
        switches = message.command == _SET_MODE and (message.param2, message.param3)[: len(drive)] == drive
        return switches or (message.command == _ARM and message.param1 == 1)

    def close(self) -> None:
        """Close link and socket."""
        self.link.close()
        self._socket.close()
