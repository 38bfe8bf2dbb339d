"""Robot's side of a Unitree request/response service over two DDS topics: server, lease, parsers of parameters."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final

from cyclonedds.sub import DataReader

from firmware_bridge.dds.bus import DDS_ERRORS, Bus, take_each
from firmware_bridge.unitree.messages import ids
from firmware_bridge.unitree.messages.idl import Request_, RequestIdentity_, Response_, ResponseHeader_, ResponseStatus_

APPLY: Final = 101
RENEW: Final = 102
TERM_US: Final = 1_000_000  # as in the maker's server; its client renews after 0.3 of the term
ERROR_DENIED: Final = 3205
ERROR_NOT_EXIST: Final = 3206
ERROR_EXISTS: Final = 3207


class Lease:
    """Lease of a service: while a client has it, requests of other clients are denied.

    Ids are times in microseconds, as in the maker's server.
    """

    def __init__(self, term_us: int = TERM_US) -> None:
        self._term_us = term_us
        self._id = 0  # 0: no holder
        self._renewed_ns = 0

    def holder(self, now_ns: int) -> int:
        """Return the id of the current lease, 0 if there is none."""
        if self._id and now_ns > self._renewed_ns + self._term_us * 1000:
            self._id = 0
        return self._id

    def denies(self, lease_id: int, now_ns: int) -> bool:
        """Return whether a request with this lease id (0: none) must be denied."""
        return self.holder(now_ns) != lease_id

    def handle(self, api_id: int, parameter: str, lease_id: int, now_ns: int) -> tuple[int, str]:
        """Handle a request of the service NAME_lease; return code and data."""
        if api_id == APPLY:
            return self._apply(parameter, now_ns)
        if api_id == RENEW:
            return self._renew(lease_id, now_ns), ""
        return ids.ERROR_NOT_IMPLEMENTED, ""

    def _apply(self, parameter: str, now_ns: int) -> tuple[int, str]:
        try:
            table = json.loads(parameter)
        except (ValueError, RecursionError):
            table = None
        if not isinstance(table, dict):
            return ids.ERROR_PARAMETER, ""
        if self.holder(now_ns):
            return ERROR_EXISTS, ""
        self._id, self._renewed_ns = now_ns // 1000, now_ns
        return ids.OK, json.dumps({"id": self._id, "term": self._term_us})

    def _renew(self, lease_id: int, now_ns: int) -> int:
        if lease_id == 0 or self.holder(now_ns) != lease_id:
            return ERROR_NOT_EXIST
        self._renewed_ns = now_ns
        return ids.OK


_HUGE = 1e9


def parse_table(parameter: str) -> dict[str, Any] | None:
    """Parse a JSON object; None for anything else."""
    try:
        table = json.loads(parameter)
    except (ValueError, RecursionError):
        return None
    return table if isinstance(table, dict) else None


def parse_numbers(parameter: str, *keys: str) -> tuple[float, ...] | None:
    """Return the finite numbers under `keys`; None if one is missing or invalid."""
    table = parse_table(parameter)
    numbers = []
    for key in keys:
        value = None if table is None else table.get(key)
        if not isinstance(value, (int, float)) or isinstance(value, bool) or not abs(value) < _HUGE:
            return None
        numbers.append(float(value))
    return tuple(numbers) if all(map(math.isfinite, numbers)) else None


def parse_flag(parameter: str, key: str) -> bool | None:
    """Return the boolean under `key`, also given as 0 or 1; None for anything else."""
    value = (parse_table(parameter) or {}).get(key)
    if isinstance(value, bool):
        return value
    return bool(value) if isinstance(value, int) and value in (0, 1) else None


def parse_text(parameter: str, key: str) -> str | None:
    """Return the text under `key`; None for anything else."""
    value = (parse_table(parameter) or {}).get(key)
    return value if isinstance(value, str) else None


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
