"""Calls to the robot's services that wait for their answer: the runner's and the tests', never the bridge's."""

from __future__ import annotations

import time
from typing import Final

from firmware_bridge.dds.binding import has_reader, has_writer
from firmware_bridge.dds.bus import Bus
from firmware_bridge.unitree.requests import MAX_BINARY_BYTES, Requester, Response, make_request, move_parameter

__all__ = ["MAX_BINARY_BYTES", "Response", "RpcClient", "RpcError", "make_request", "move_parameter"]

_MATCH_POLL_S: Final = 0.01
_AGAIN_NS: Final = 2_000_000_000
"""Time without an answer after which a request is sent again: the robot may not have discovered our reader."""
_NS: Final = 1_000_000_000


class RpcError(RuntimeError):
    """A call that got no usable answer; `code` is the robot's error code, or None when there was no answer."""

    def __init__(self, message: str, code: int | None = None) -> None:
        super().__init__(message)
        self.code = code


class RpcClient(Requester):
    """One service as a client sees it: `send` and `responses` never wait, `call` blocks its caller only."""

    def __init__(self, bus: Bus, service: str, *, allowed: frozenset[int] | None = None) -> None:
        """`allowed`: the only API ids this client may put on the wire; None allows every id."""
        super().__init__(bus, service, allowed=allowed)
        self._waitset = bus.waitset(self._reader)

    def connected(self) -> bool:
        """Whether the service's two ends have been discovered."""
        return has_reader(self._writer) and has_writer(self._reader)

    def call(self, api_id: int, parameter: str = "", *, timeout_s: float) -> Response:
        """Send, every 2 s, and wait for the answer.

        Raises RpcError: no service, no answer in time, or the robot's error code.
        """
        deadline_ns = time.monotonic_ns() + int(timeout_s * _NS)
        while not self.connected():
            if time.monotonic_ns() >= deadline_ns:
                raise RpcError(f"{self.service}: no such service on the bus within {timeout_s:g} s; is the robot on?")
            time.sleep(_MATCH_POLL_S)
        sent: set[int] = set()
        again_ns = 0
        while (now_ns := time.monotonic_ns()) < deadline_ns:
            if now_ns >= again_ns:
                request_id = self.send(api_id, parameter)
                if request_id is None:
                    raise RpcError(f"{self.service}: DDS did not accept request {api_id}")
                sent.add(request_id)
                again_ns = now_ns + _AGAIN_NS
            self._waitset.wait(min(deadline_ns, again_ns) - now_ns)
            for response in self.responses():
                if response.request_id not in sent or response.api_id != api_id:
                    continue
                if response.code != 0:
                    raise RpcError(f"{self.service}: request {api_id} answered error {response.code}", response.code)
                return response
        raise RpcError(f"{self.service}: no answer to request {api_id} within {timeout_s:g} s")
