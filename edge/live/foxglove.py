"""The WebSocket protocol of Foxglove (subprotocol `foxglove.sdk.v1`), for data that a server sends. Pure.

Source: github.com/foxglove/ws-protocol, docs/spec.md (MIT). foxglove-sdk has a server, but none that asks for a token:
anybody on the machine could read it. A test compares our frames with that server's.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any, Final

from edge.flightlog.standard_schemas import Schema

SUBPROTOCOLS: Final = ("foxglove.sdk.v1", "foxglove.websocket.v1")
MOST_REQUEST_BYTES: Final = 65_536

_MESSAGE_DATA: Final = struct.Struct("<BIQ")  # opcode 1, subscription, log time
_MOST_SUBSCRIPTIONS: Final = 256
_MOST_ID: Final = 2**32 - 1


class ProtocolError(ValueError):
    """A client's request does not belong to the protocol."""


class Channels:
    """The channels that the server offers; a topic gets its channel with its first message."""

    def __init__(self) -> None:
        self._ids: dict[str, int] = {}
        self._described: list[dict[str, Any]] = []

    def id_of(self, topic: str) -> int | None:
        """Return a topic's channel; None for a topic that is not offered."""
        return self._ids.get(topic)

    def add(self, topic: str, schema: Schema) -> str:
        """Offer a topic and return the advertisement for the connected clients."""
        self._ids[topic] = len(self._ids) + 1
        channel = {
            "id": self._ids[topic],
            "topic": topic,
            "encoding": "json",
            "schemaName": schema["title"],
            "schema": json.dumps(schema),
            "schemaEncoding": "jsonschema",
        }
        self._described.append(channel)
        return _advertise([channel])

    def advertisement(self) -> str:
        """Return the advertisement of all channels for a new client."""
        return _advertise(self._described)


class Subscriptions:
    """Subscriptions of one client: channel -> number that the client gave it."""

    def __init__(self) -> None:
        self._of_channel: dict[int, int] = {}

    def take(self, text: str) -> list[int]:
        """Take a client's request; return the channels that it has just subscribed. Raises ProtocolError."""
        try:
            request = json.loads(text)
            operation = request["op"]
            if operation == "subscribe":
                wanted = {_number(each["channelId"]): _number(each["id"]) for each in request["subscriptions"]}
                if len(self._of_channel | wanted) > _MOST_SUBSCRIPTIONS:
                    raise ProtocolError(f"expected at most {_MOST_SUBSCRIPTIONS} subscriptions")
                self._of_channel |= wanted
                return list(wanted)
            if operation == "unsubscribe":
                ended = {_number(each) for each in request["subscriptionIds"]}
                self._of_channel = {channel: id_ for channel, id_ in self._of_channel.items() if id_ not in ended}
        except ProtocolError:
            raise
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise ProtocolError(f"no request of the protocol: {type(error).__name__}") from error
        return []  # whatever else a client may ask for is not offered

    def frame(self, channel: int, stamp_ns: int, payload: bytes) -> bytes | None:
        """Return the frame of a message; None if the client has not subscribed its channel."""
        subscription = self._of_channel.get(channel)
        return None if subscription is None else _MESSAGE_DATA.pack(1, subscription, stamp_ns) + payload


def server_info(name: str, session: str) -> str:
    """Return the first message to a client."""
    info: Mapping[str, Any] = {
        "op": "serverInfo", "name": name, "capabilities": [], "supportedEncodings": [], "metadata": {},
        "sessionId": session,
    }  # fmt: skip
    return json.dumps(info)


def _advertise(channels: list[dict[str, Any]]) -> str:
    return json.dumps({"op": "advertise", "channels": channels})


def _number(value: object) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= _MOST_ID:
        raise ProtocolError("expected a number of 32 bits")
    return value
