"""Lease of a service: while a client has it, requests of other clients are denied. Pure."""

from __future__ import annotations

import json
from typing import Final

from firmware_bridge.unitree.messages import ids

APPLY: Final = 101
RENEW: Final = 102
TERM_US: Final = 1_000_000  # as in the maker's server; its client renews after 0.3 of the term
ERROR_DENIED: Final = 3205
ERROR_NOT_EXIST: Final = 3206
ERROR_EXISTS: Final = 3207


class Lease:
    """Lease with at most one holder; ids are times in microseconds, as in the maker's server."""

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
