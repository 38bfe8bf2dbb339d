"""Sends requests to one of the robot's services and collects answers, without waiting.

The robot is an untrusted peer (faults table, "Unitree, known hazards"): its messages are bounded and matched by
identity id; all others are dropped and counted. The bridge uses only this module; calls that wait are in `rpc.py`.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from typing import Final

from firmware_bridge.dds.bus import DDS_ERRORS, MAX_SAMPLE_BYTES, Bus, take_each
from firmware_bridge.unitree.messages import idl
from firmware_bridge.unitree.messages.ids import request_topic, response_topic

MAX_DATA_CHARS: Final = 64 * 1024
MAX_BINARY_BYTES: Final = 8 * 1024 * 1024  # a 720p JPEG is about 0.15 MB


@dataclass(frozen=True)
class Response:
    """One bounds-checked answer."""

    request_id: int
    api_id: int
    code: int
    data: str
    binary: bytes

    @classmethod
    def checked(cls, sample: idl.Response_ | None) -> Response | None:
        """Return the sample's content; None when it does not decode or is larger than any valid answer."""
        if sample is None or len(sample.data) > MAX_DATA_CHARS or len(sample.binary) > MAX_BINARY_BYTES:
            return None
        identity, status = sample.header.identity, sample.header.status
        return cls(identity.id, identity.api_id, status.code, sample.data, bytes(sample.binary))


def make_request(request_id: int, api_id: int, parameter: str, *, noreply: bool) -> idl.Request_:
    """Build a request without lease, priority or binary part, as the maker's client does."""
    identity = idl.RequestIdentity_(request_id, api_id)
    header = idl.RequestHeader_(identity, idl.RequestLease_(0), idl.RequestPolicy_(0, noreply))
    return idl.Request_(header, parameter, b"")


def move_parameter(vx_mps: float, vy_mps: float, wz_radps: float) -> str:
    """Format the parameter of the sport service's Move."""
    return json.dumps({"x": vx_mps, "y": vy_mps, "z": wz_radps})


class Requester:
    """Client of one service; no method waits."""

    def __init__(self, bus: Bus, service: str, *, allowed: frozenset[int] | None = None) -> None:
        """`allowed`: the only API ids this client may put on the wire; None allows every id."""
        self.service = service
        self.malformed = 0
        self.failed_writes = 0
        self.failing = 0
        """Number of failed writes in a row, up to now."""
        self._allowed = allowed
        self._last_id = 0
        self._writer = bus.writer(request_topic(service), idl.Request_)
        self._reader = bus.reader(response_topic(service), idl.Response_, depth=8, reliable=True)

    def send(self, api_id: int, parameter: str = "", *, noreply: bool = False) -> int | None:
        """Write a request without waiting; return its id, or None when DDS did not accept it.

        Raises ValueError for an id outside the allow-list: a defect of the caller, never of its input.
        """
        if self._allowed is not None and api_id not in self._allowed:
            raise ValueError(f"{self.service}: api id {api_id} is not on the allow-list")
        self._last_id = max(self._last_id + 1, time.monotonic_ns())
        try:
            self._writer.write(make_request(self._last_id, api_id, parameter, noreply=noreply))
        except DDS_ERRORS:
            self.failed_writes += 1
            self.failing += 1
            return None
        self.failing = 0
        return self._last_id

    def responses(self, limit: int = 64, max_bytes: int = MAX_SAMPLE_BYTES) -> list[Response]:
        """Return at most `limit` answers received since the last call, other clients' included.

        An answer of more than `max_bytes` counts as malformed and is not decoded.
        """
        answers = []
        for sample in take_each(self._reader, limit, max_bytes):
            response = Response.checked(sample)
            if response is None:
                self.malformed += 1
            else:
                answers.append(response)
        return answers
