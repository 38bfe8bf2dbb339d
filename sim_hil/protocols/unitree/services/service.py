"""Robot's side of a Unitree request/response service over two DDS topics."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final

from cyclonedds.sub import DataReader

from firmware_bridge.unitree.dds import DDS_ERRORS, Bus, take_each
from firmware_bridge.unitree.messages import ids
from firmware_bridge.unitree.messages.idl import Request_, RequestIdentity_, Response_, ResponseHeader_, ResponseStatus_
from sim_hil.protocols.unitree.services.leases import ERROR_DENIED, Lease

_QUEUE_DEPTH: Final = 64  # requests queued between two polls
_MAX_PARAMETER_CHARS: Final = 4096
_NOOP: Final = 2  # API id of every service
_LAST_INTERNAL: Final = 100  # last API id common to all services; a service's own ids begin above

Answer = tuple[int, str]  # error code (0: done), data


@dataclass(frozen=True)
class Received:
    """One received request; `received_ns` is stamped when it is read from the bus."""

    received_ns: int
    service: str
    api_id: int
    parameter: str
    request_id: int
    noreply: bool
    lease_id: int = 0


class ServiceServer:
    """Server of one service; `requests()` and `reply()` never wait.

    Rules of the robot's own server: API id 1 returns the version; a reply carries the request's identity; a request
    marked `noreply` is never answered; data is empty with an error code. With a `lease`, requests outside `unleased`
    are denied to all clients but the holder.
    """

    def __init__(
        self,
        bus: Bus,
        service: str,
        *,
        version: str = ids.SERVICE_VERSION,
        lease: Lease | None = None,
        unleased: frozenset[int] = frozenset(),
    ) -> None:
        self.service = service
        self.malformed = 0
        self._version = version
        self._lease = lease
        self._unleased = unleased
        # Reliable, like the writers of all known clients, so that a request sent during discovery is not lost.
        topic = ids.request_topic(service)
        self.reader: DataReader[Any] = bus.reader(topic, Request_, depth=_QUEUE_DEPTH, reliable=True)
        self._writer = bus.writer(ids.response_topic(service), Response_, depth=_QUEUE_DEPTH)

    def requests(self) -> Iterator[Received]:
        """Yield the waiting requests, oldest first; requests that are invalid or too long are counted and dropped."""
        for sample in take_each(self.reader):
            if sample is None or len(sample.parameter) > _MAX_PARAMETER_CHARS:
                self.malformed += 1
                continue
            header = sample.header
            yield Received(
                time.monotonic_ns(),
                self.service,
                header.identity.api_id,
                sample.parameter,
                header.identity.id,
                header.policy.noreply,
                header.lease.id,
            )

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
            return  # the client ended or its queue is full; it will time out, as on the real robot

    def answer(self, request: Received, handle: Callable[[int, str], Answer]) -> Answer:
        """Return the answer of the server itself or of `handle(api_id, parameter)`."""
        if request.api_id == ids.API_VERSION:
            return ids.OK, self._version
        if request.api_id == _NOOP:
            return ids.OK, ""
        if request.api_id <= _LAST_INTERNAL:
            return ids.ERROR_NOT_IMPLEMENTED, ""
        leased = self._lease is not None and request.api_id not in self._unleased
        if leased and self._lease is not None and self._lease.denies(request.lease_id, request.received_ns):
            return ERROR_DENIED, ""
        return handle(request.api_id, request.parameter)

    def serve(self, handle: Callable[[int, str], Answer]) -> list[Received]:
        """Answer all waiting requests with `handle(api_id, parameter)` and return them."""
        served = []
        for request in self.requests():
            served.append(request)
            self.reply(request, *self.answer(request, handle))
        return served


class LeaseServer(ServiceServer):
    """Server of the service `<name>_lease` for a service with a lease."""

    def __init__(self, bus: Bus, service: str, lease: Lease) -> None:
        super().__init__(bus, f"{service}_lease")
        self._given = lease

    def serve_leases(self) -> None:
        """Answer all waiting requests."""
        for request in self.requests():
            answer = self._given.handle(request.api_id, request.parameter, request.lease_id, request.received_ns)
            self.reply(request, *answer)
