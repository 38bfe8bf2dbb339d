"""The front camera as a process of its own: answers `videohub` GetImageSample with a JPEG rendered at that moment.

Started by `CameraProcess`; talks to its parent through three pipes' worth of plain things: the pose in shared memory
(`snapshot.py`), events as JSON lines on what was stdout at the start, and an end of file on stdin when the parent has
gone.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import select
import signal
import sys
import time
from collections.abc import Callable
from typing import Final, TextIO

import cv2
import numpy as np
from numpy.typing import NDArray

from firmware_bridge.config import DdsConfig
from firmware_bridge.unitree import ids
from firmware_bridge.unitree.dds import Bus
from sim_hil.camera import CameraWorld
from sim_hil.scene import load_scene
from sim_hil.sensor_noise import SensorNoise
from sim_hil.unitree.service import Received, ServiceServer
from sim_hil.unitree.snapshot import SnapshotReader, TornSnapshotError

JPEG_QUALITY: Final = 85
_PARENT_CHECK_NS: Final = 50_000_000
_FAULTS_CHECK_NS: Final = 5_000_000  # a fault takes effect, and a held answer leaves, within this
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


def _event_pipe() -> TextIO:
    """The pipe to the parent, for us alone: what a library prints to stdout goes to stderr from now on."""
    pipe = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    return pipe


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
    parser.add_argument("--faults", action="store_true")
    args = parser.parse_args(argv)
    # A Ctrl-C reaches the whole process group; the parent decides when the camera ends.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    pipe = _event_pipe()

    def tell(event: dict[str, object]) -> None:
        pipe.write(json.dumps(event) + "\n")
        pipe.flush()

    world = CameraWorld(load_scene(args.scene), people=args.people, seed=args.seed)
    poses = SnapshotReader(args.pose_fd, world.state_size)

    noise = SensorNoise(args.width, args.height, args.seed)

    def render() -> bytes | None:
        state = poses.read()
        return None if state is None else encode_jpeg(noise.add(world.render(state, args.width, args.height)))

    bus = Bus(DdsConfig(args.domain, args.interface, tuple(args.peer)))
    server = ServiceServer(bus, ids.VIDEO_SERVICE)
    waitset = bus.waitset(server.reader)
    hub, alive, check_ns = VideoHub(server, render, tell), _parent_lives, _PARENT_CHECK_NS
    if args.faults:
        from sim_hil.faults.camera import FaultyVideoHub  # not loaded where no fault may be injected

        size, check_ns = (args.width, args.height), _FAULTS_CHECK_NS
        hub = faulty = FaultyVideoHub(server, render, tell, size=size, commands_fd=sys.stdin.fileno())
        alive = faulty.listen
    # BrokenPipeError: the parent died between two looks at stdin.
    with contextlib.closing(world), contextlib.closing(poses), contextlib.suppress(BrokenPipeError):
        tell({"event": "ready"})
        while alive():
            waitset.wait(check_ns)
            hub.serve()
    return 0


def _parent_lives() -> bool:
    return not select.select([sys.stdin], [], [], 0)[0]


if __name__ == "__main__":
    sys.exit(main())
