"""The robot's end of a Unitree request/response service over two DDS topics."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final

from cyclonedds.sub import DataReader

from firmware_bridge.unitree import ids
from firmware_bridge.unitree.dds import DDS_ERRORS, Bus, take_each
from firmware_bridge.unitree.idl import Request_, RequestIdentity_, Response_, ResponseHeader_, ResponseStatus_

_QUEUE_DEPTH: Final = 64  # requests that may wait between two polls
_MAX_PARAMETER_CHARS: Final = 4096

Answer = tuple[int, str]  # error code (0: done), data


@dataclass(frozen=True)
class Received:
    """One request as it arrived; `received_ns` is stamped when it is taken off the bus."""

    received_ns: int
    service: str
    api_id: int
    parameter: str
    request_id: int
    noreply: bool


class ServiceServer:
    """One service: `requests()` without waiting, `reply()` to each.

    The rules of the robot's own server: API id 1 is its version, a reply carries the request's identity, a request
    marked `noreply` is never answered, not even with an error, and data stays empty beside an error code.
    """

    def __init__(self, bus: Bus, service: str) -> None:
        self.service = service
        self.malformed = 0
        # Reliable, as the writers of every known client are: the request that a client sends in the instant in which
        # it is still being discovered is delivered, not lost.
        topic = ids.request_topic(service)
        self.reader: DataReader[Any] = bus.reader(topic, Request_, depth=_QUEUE_DEPTH, reliable=True)
        self._writer = bus.writer(ids.response_topic(service), Response_, depth=_QUEUE_DEPTH)

    def requests(self) -> Iterator[Received]:
        """Requests that are waiting, oldest first; what does not decode or is absurdly long is counted and dropped."""
        for sample in take_each(self.reader):
            if sample is None or len(sample.parameter) > _MAX_PARAMETER_CHARS:
                self.malformed += 1
                continue
            identity, policy = sample.header.identity, sample.header.policy
            now_ns = time.monotonic_ns()
            yield Received(now_ns, self.service, identity.api_id, sample.parameter, identity.id, policy.noreply)

    def reply(self, request: Received, code: int, data: str = "", binary: bytes = b"") -> None:
        """Answer a request."""
        if request.noreply:
            return
        if code != ids.OK:
            data, binary = "", b""
        header = ResponseHeader_(RequestIdentity_(request.request_id, request.api_id), ResponseStatus_(code))
        try:
            self._writer.write(Response_(header, data, binary))
        except DDS_ERRORS:
            return  # the client has gone or its queue is full; it will time out as on the real robot

    def serve(self, handle: Callable[[int, str], Answer]) -> list[Received]:
        """Answer everything that is waiting with `handle(api_id, parameter)`; returns it."""
        served = []
        for request in self.requests():
            served.append(request)
            if request.api_id == ids.API_VERSION:
                self.reply(request, ids.OK, ids.SERVICE_VERSION)
            else:
                self.reply(request, *handle(request.api_id, request.parameter))
        return served
