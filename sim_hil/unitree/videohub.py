"""The front camera as a process of its own: answers `videohub` GetImageSample with a JPEG rendered at that moment.

Started by `CameraProcess`; talks to its parent through three pipes' worth of plain things: the pose in shared memory
(`snapshot.py`), events as JSON lines on stdout, and an end of file on stdin when the parent has gone.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import select
import signal
import sys
import time
from collections.abc import Callable
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from firmware_bridge.config import DdsConfig
from firmware_bridge.unitree import ids
from firmware_bridge.unitree.dds import Bus
from sim_hil.camera import CameraWorld
from sim_hil.scene import load_scene
from sim_hil.unitree.service import Received, ServiceServer
from sim_hil.unitree.snapshot import SnapshotReader

JPEG_QUALITY: Final = 85
_PARENT_CHECK_NS: Final = 50_000_000
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
        """`render` gives a JPEG, or None while there is no pose yet; `tell` reports an event to the parent."""
        self._server = server
        self._render = render
        self._tell = tell

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
        if not waiting:
            return
        jpeg = self._render()
        for request in waiting:
            if jpeg is None:
                self._server.reply(request, ERROR_NO_IMAGE)
            else:
                self._server.reply(request, ids.OK, "", jpeg)
                self._tell({"event": "frame", "t_ns": time.monotonic_ns()})


def _tell(event: dict[str, object]) -> None:
    sys.stdout.write(json.dumps(event) + "\n")
    sys.stdout.flush()


def main(argv: list[str] | None = None) -> int:
    """Entry point of the camera process; ends when stdin does."""
    parser = argparse.ArgumentParser(prog="edge-hil camera", description="started by edge-hil")
    parser.add_argument("--scene", required=True)
    parser.add_argument("--people", type=int, required=True)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--width", type=int, required=True)
    parser.add_argument("--height", type=int, required=True)
    parser.add_argument("--domain", type=int, required=True)
    parser.add_argument("--interface", required=True)
    parser.add_argument("--peer", action="append", default=[])
    parser.add_argument("--pose-fd", type=int, required=True)
    args = parser.parse_args(argv)
    # A Ctrl-C reaches the whole process group; the parent decides when the camera ends.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    world = CameraWorld(load_scene(args.scene), people=args.people, seed=args.seed)
    poses = SnapshotReader(args.pose_fd, world.state_size)

    def render() -> bytes | None:
        state = poses.read()
        return None if state is None else encode_jpeg(world.render(state, args.width, args.height))

    bus = Bus(DdsConfig(args.domain, args.interface, tuple(args.peer)))
    server = ServiceServer(bus, ids.VIDEO_SERVICE)
    waitset = bus.waitset(server.reader)
    hub = VideoHub(server, render, _tell)
    # BrokenPipeError: the parent died between two looks at stdin.
    with contextlib.closing(world), contextlib.closing(poses), contextlib.suppress(BrokenPipeError):
        _tell({"event": "ready"})
        while not select.select([sys.stdin], [], [], 0)[0]:
            waitset.wait(_PARENT_CHECK_NS)
            hub.serve()
    return 0


if __name__ == "__main__":
    sys.exit(main())
