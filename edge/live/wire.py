"""Datagrams between a runner and the process of its live view, over a pair of local sockets.

Header: kind u8, stamp_ns i64, topic length u8, then the topic and the payload. A datagram that does not fit is dropped.
"""

from __future__ import annotations

import json
import struct
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

RECORD, PICTURE, CONFIG, STOPPED, LISTENING, STOP, REFUSED, DROPPED = 1, 2, 3, 4, 5, 6, 7, 8
"""Kinds. From the runner: a record as JSON, a JPEG, the configuration, the answer to a stop, the number of records that
it could not send. From the view: the port at which it listens, a request to stop, why it cannot listen."""
EVENTS: Final = ("/run", "/semantic", "/fault", "/result")
"""Topics of which every record counts; of all others, only the newest."""
MOST_BYTES: Final = 1 << 20
"""Largest datagram, bytes: far above a JPEG of a front camera."""

_HEADER: Final = struct.Struct("<BqB")


class WireError(ValueError):
    """The bytes are not a datagram of this link."""


@dataclass(frozen=True)
class Datagram:
    """One datagram; `topic` and `stamp_ns` belong to records and pictures."""

    kind: int
    payload: bytes = b""
    topic: str = ""
    stamp_ns: int = 0

    def encode(self) -> bytes:
        """Return the bytes. Raises struct.error for a stamp or topic out of range."""
        topic = self.topic.encode()
        return _HEADER.pack(self.kind, self.stamp_ns, len(topic)) + topic + self.payload


def decode(data: bytes) -> Datagram:
    """Decode a datagram; raises WireError."""
    try:
        kind, stamp_ns, length = _HEADER.unpack_from(data)
        topic = data[_HEADER.size : _HEADER.size + length].decode()
    except (struct.error, UnicodeDecodeError) as error:
        raise WireError(f"no datagram of the live view: {error}") from error
    if len(data) < _HEADER.size + length or not RECORD <= kind <= DROPPED:
        raise WireError(f"no datagram of the live view: kind {kind}, {len(data)} bytes")
    return Datagram(kind, data[_HEADER.size + length :], topic, stamp_ns)


@dataclass(frozen=True)
class ViewConfig:
    """Where the view listens and whom it lets in; `bridge`: socket of the bridge that its STOP button stops, if any."""

    address: str
    port: int
    token: str
    bridge: Path | None

    def encode(self) -> bytes:
        """Return the configuration as a payload."""
        return json.dumps({**asdict(self), "bridge": None if self.bridge is None else str(self.bridge)}).encode()

    @staticmethod
    def parse(payload: bytes) -> ViewConfig:
        """Read a payload; raises WireError."""
        try:
            found: dict[str, Any] = json.loads(payload)
            bridge = None if found["bridge"] is None else Path(found["bridge"])
            return ViewConfig(str(found["address"]), int(found["port"]), str(found["token"]), bridge)
        except (ValueError, KeyError, TypeError) as error:
            raise WireError(f"no configuration of a live view: {error}") from error
