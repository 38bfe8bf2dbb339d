"""Video service `videohub`: answers GetImageSample with a newly rendered JPEG."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from firmware_bridge.unitree.messages import ids
from sim_hil.protocols.snapshot import TornSnapshotError
from sim_hil.protocols.unitree.services.service import Received, ServiceServer

JPEG_QUALITY: Final = 85
ERROR_NO_IMAGE: Final = 100  # the video service's own error code


def encode_jpeg(rgb: NDArray[np.uint8]) -> bytes:
    """JPEG of an RGB picture [h, w, 3]. Raises RuntimeError when the encoder refuses it."""
    done, data = cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise RuntimeError("OpenCV could not encode a camera frame as JPEG")
    return data.tobytes()


class VideoHub:
    """The service: one render answers every GetImageSample that is waiting."""

    def __init__(
        self, server: ServiceServer, render: Callable[[], bytes | None], tell: Callable[[dict[str, object]], None]
    ) -> None:
        """`render` gives a JPEG, or None while there is no pose yet, and may raise TornSnapshotError.

        `tell` reports an event to the parent.
        """
        self._server = server
        self._render = render
        self._tell = tell
        self._malformed = 0

    def serve(self) -> None:
        """Answer what is waiting."""
        waiting: list[Received] = []
        for request in self._server.requests():
            self._tell(
                {
                    "event": "request",
                    "t_ns": request.received_ns,
                    "api_id": request.api_id,
                    "parameter": request.parameter,
                }
            )
            if request.api_id == ids.API_VERSION:
                self._server.reply(request, ids.OK, ids.SERVICE_VERSION)
            elif request.api_id == ids.GET_IMAGE_SAMPLE:
                waiting.append(request)
            else:
                self._server.reply(request, ids.ERROR_NOT_IMPLEMENTED)
        if self._server.malformed != self._malformed:
            self._tell({"event": "malformed", "count": self._server.malformed - self._malformed})
            self._malformed = self._server.malformed
        self._answer(waiting)

    def _answer(self, waiting: list[Received]) -> None:
        """One picture for all of `waiting`."""
        if not waiting:
            return
        try:
            jpeg = self._render()
        except TornSnapshotError as error:
            # The physics is held up or has gone; the next request finds out which.
            sys.stderr.write(f"edge-hil camera: a picture was left out: {error}\n")
            jpeg = None
        for request in waiting:
            if jpeg is None:
                self._server.reply(request, ERROR_NO_IMAGE)
            else:
                self._send(request, jpeg)

    def _send(self, request: Received, jpeg: bytes) -> None:
        self._server.reply(request, ids.OK, "", jpeg)
        self._tell({"event": "frame", "t_ns": time.monotonic_ns()})
