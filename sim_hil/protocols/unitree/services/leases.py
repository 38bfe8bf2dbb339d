"""The lease of a service: while somebody holds it, nobody else is obeyed. Pure; rules of protocol facts, section 2."""

from __future__ import annotations

import json
from typing import Final

from firmware_bridge.unitree.messages import ids

APPLY: Final = 101
RENEW: Final = 102
TERM_US: Final = 1_000_000  # the maker's server and client: one second, renewed after 0.3 of it
ERROR_DENIED: Final = 3205
ERROR_NOT_EXIST: Final = 3206
ERROR_EXISTS: Final = 3207


class Lease:
    """At most one holder at a time; ids are times in microseconds, as the maker's server gives them."""

    def __init__(self, term_us: int = TERM_US) -> None:
        self._term_us = term_us
        self._id = 0  # 0: nobody
        self._renewed_ns = 0

    def holder(self, now_ns: int) -> int:
        """Id of the lease in force, 0 without one."""
        if self._id and now_ns > self._renewed_ns + self._term_us * 1000:
            self._id = 0
        return self._id

    def denies(self, lease_id: int, now_ns: int) -> bool:
        """Whether a request with this id (0: none) may not be obeyed now."""
        return self.holder(now_ns) != lease_id

    def handle(self, api_id: int, parameter: str, lease_id: int, now_ns: int) -> tuple[int, str]:
        """One request of the service NAME_lease: code and data."""
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
