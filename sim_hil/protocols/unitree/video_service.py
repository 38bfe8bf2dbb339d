"""Video service `videohub`: answers GetImageSample with a newly rendered JPEG."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable
from typing import Final

from firmware_bridge.unitree.messages import ids
from sim_hil.protocols.snapshot import TornSnapshotError
from sim_hil.protocols.unitree.services.service import Received, ServiceServer

ERROR_NO_IMAGE: Final = 100  # the video service's own error code


class VideoHub:
    """Video service: one render answers all waiting GetImageSample requests."""

    def __init__(
        self,
        server: ServiceServer,
        render: Callable[[], bytes | None],
        report: Callable[[dict[str, object]], None],
        show: Callable[[bytes], None] = lambda jpeg: None,
    ) -> None:
        """Create the service; `render` returns a JPEG, None without a pose, or raises TornSnapshotError.

        `report` sends an event to the parent. `show` takes every picture that is sent.
        """
        self._server = server
        self._render = render
        self._report = report
        self._show = show
        self._malformed = 0

    def serve(self) -> None:
        """Answer the waiting requests."""
        waiting: list[Received] = []
        for request in self._server.requests():
            content = {"t_ns": request.received_ns, "api_id": request.api_id, "parameter": request.parameter}
            self._report({"event": "request", **content})
            if request.api_id == ids.API_VERSION:
                self._server.reply(request, ids.OK, ids.SERVICE_VERSION)
            elif request.api_id == ids.GET_IMAGE_SAMPLE:
                waiting.append(request)
            else:
                self._server.reply(request, ids.ERROR_NOT_IMPLEMENTED)
        if self._server.malformed != self._malformed:
            self._report({"event": "malformed", "count": self._server.malformed - self._malformed})
            self._malformed = self._server.malformed
        self._answer(waiting)

    def _answer(self, waiting: list[Received]) -> None:
        """Answer all of `waiting` with one image."""
        if not waiting:
            return
        try:
            jpeg = self._render()
        except TornSnapshotError as error:
            # The physics is delayed or has ended; the next request detects which.
            sys.stderr.write(f"edge-hil camera: an image was left out: {error}\n")
            jpeg = None
        for request in waiting:
            if jpeg is None:
                self._server.reply(request, ERROR_NO_IMAGE)
            else:
                self._send(request, jpeg)

    def _send(self, request: Received, jpeg: bytes) -> None:
        self._server.reply(request, ids.OK, "", jpeg)
        self._report({"event": "frame", "t_ns": time.monotonic_ns()})
        self._show(jpeg)

    def show_unasked(self) -> None:
        """Show a picture that nobody has requested."""
        with contextlib.suppress(TornSnapshotError):
            jpeg = self._render()
            if jpeg is not None:
                self._show(jpeg)
