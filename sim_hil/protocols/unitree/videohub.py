"""The front camera as a process of its own: answers `videohub` GetImageSample with a JPEG rendered at that moment.

Started by the front end; it communicates with its parent through three descriptors: the pose in shared memory
(`snapshot.py`), events as JSON lines on what was stdout at the start, and an end of file on stdin when the parent has
gone.
"""

from __future__ import annotations

import contextlib
import functools
import signal
import sys
from typing import Final

from firmware_bridge.core.config import DdsConfig
from firmware_bridge.dds.bus import Bus
from firmware_bridge.system.terminal import CommandParser
from firmware_bridge.unitree.messages import ids
from sim_hil.layouts.scenes import open_scene
from sim_hil.processes.child_process import input_is_open, take_standard_output, write_message
from sim_hil.protocols.render_process import PictureView, encode_jpeg
from sim_hil.protocols.snapshot import SnapshotReader
from sim_hil.protocols.unitree.services.service import ServiceServer
from sim_hil.protocols.unitree.video_service import VideoHub
from sim_hil.simulation.camera import CameraWorld
from sim_hil.simulation.sensor_noise import SensorNoise

_PARENT_CHECK_NS: Final = 50_000_000
_FAULTS_CHECK_NS: Final = 5_000_000  # a fault takes effect, and a held answer leaves, within this


def main(argv: list[str] | None = None) -> int:
    """Entry point of the camera process; ends when stdin does."""
    parser = CommandParser(prog="edge-hil camera", description="started by edge-hil")
    parser.add_argument("--scene", required=True)
    parser.add_argument("--people", type=int, required=True)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--width", type=int, required=True)
    parser.add_argument("--height", type=int, required=True)
    parser.add_argument("--domain", type=int, required=True)
    parser.add_argument("--interface", required=True)
    parser.add_argument("--peer", action="append", default=[])
    parser.add_argument("--pose-fd", type=int, required=True)
    parser.add_argument("--view-fd", type=int)
    parser.add_argument("--faults", action="store_true")
    args = parser.parse_args(argv)
    # A Ctrl-C reaches the whole process group; the parent decides when the camera ends.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    report = functools.partial(write_message, take_standard_output())

    world = CameraWorld(open_scene(args.scene), people=args.people, seed=args.seed)
    poses = SnapshotReader(args.pose_fd, world.state_size)

    noise = SensorNoise(args.width, args.height, args.seed)

    def render() -> bytes | None:
        state = poses.read()
        return None if state is None else encode_jpeg(noise.add(world.render(state, args.width, args.height)))

    bus = Bus(DdsConfig(args.domain, args.interface, tuple(args.peer)))
    server = ServiceServer(bus, ids.VIDEO_SERVICE)
    waitset = bus.waitset(server.reader)
    view = PictureView(args.view_fd)
    hub, alive, check_ns = VideoHub(server, render, report, view.show), input_is_open, _PARENT_CHECK_NS
    if args.faults:
        from sim_hil.protocols.unitree.camera_faults import FaultyVideoHub  # not loaded where no fault may be injected

        size, check_ns = (args.width, args.height), _FAULTS_CHECK_NS
        hub = faulty = FaultyVideoHub(server, render, report, view.show, size=size, commands_fd=sys.stdin.fileno())
        alive = faulty.listen
    # BrokenPipeError: the parent died between two looks at stdin.
    with contextlib.closing(world), contextlib.closing(poses), contextlib.suppress(BrokenPipeError):
        report({"event": "ready"})
        while alive():
            waitset.wait(check_ns)
            hub.serve()
            if view.is_due:
                hub.show_unasked()
    return 0


if __name__ == "__main__":
    sys.exit(main())
