"""The camera node of the simulated ROS 2 base as a process of its own: JPEG pictures and the lens's intrinsics.

Started by the front end; it communicates with its parent through three descriptors: the pose and the robot's clock in
shared memory (`snapshot.py`), events as JSON lines on what was stdout at the start, and an end of file on stdin when
the parent has gone. Without a subscriber nothing is rendered.
"""

from __future__ import annotations

import contextlib
import signal
import sys
import time
from typing import Final, TextIO

from cyclonedds.pub import DataWriter

from firmware_bridge.core.config import DdsConfig
from firmware_bridge.dds.binding import has_reader
from firmware_bridge.dds.bus import DDS_ERRORS, Bus
from firmware_bridge.ros2.messages.sensors import CameraInfo_, CompressedImage_
from firmware_bridge.system.terminal import CommandParser
from sim_hil.layouts.scenes import open_scene
from sim_hil.processes.child_process import input_is_open, take_standard_output, write_message
from sim_hil.protocols.render_process import PictureView, encode_jpeg
from sim_hil.protocols.ros2.topics import CAMERA_FRAME, CAMERA_INFO_TOPIC, IMAGE_TOPIC, camera_info, header
from sim_hil.protocols.snapshot import SnapshotReader, TornSnapshotError
from sim_hil.simulation.camera import CameraWorld
from sim_hil.simulation.sensor_noise import SensorNoise

RATE_HZ: Final = 15.0
_IDLE_S: Final = 0.05


class CameraNode:
    """Renders the newest pose and publishes it with the stamp of that pose."""

    def __init__(
        self, bus: Bus, world: CameraWorld, poses: SnapshotReader, noise: SensorNoise, view: PictureView
    ) -> None:
        self._world, self._poses, self._noise, self._view = world, poses, noise, view
        self._images: DataWriter[CompressedImage_] = bus.writer(IMAGE_TOPIC, CompressedImage_)
        self._lens: DataWriter[CameraInfo_] = bus.writer(CAMERA_INFO_TOPIC, CameraInfo_)

    @property
    def wanted(self) -> bool:
        """Whether a node subscribes to pictures or intrinsics, or the live view lacks one."""
        return has_reader(self._images) or has_reader(self._lens) or self._view.is_due

    def publish(self, width: int, height: int) -> bool:
        """Render and publish one picture; False without a pose. Raises TornSnapshotError."""
        state = self._poses.read()
        if state is None:
            return False
        stamp_s = float(state[-1])
        jpeg = encode_jpeg(self._noise.add(self._world.render(state[:-1], width, height)))
        self._view.show(jpeg)
        with contextlib.suppress(*DDS_ERRORS):  # a network that is away for a moment costs this picture only
            self._images.write(CompressedImage_(header(stamp_s, CAMERA_FRAME), "jpeg", jpeg))
            self._lens.write(camera_info(width, height, stamp_s))
        return True


def _publish_while_parent_lives(node: CameraNode, size: tuple[int, int], pipe: TextIO) -> None:
    period_ns, next_ns = round(1e9 / RATE_HZ), time.monotonic_ns()
    while input_is_open():
        left_s = (next_ns - time.monotonic_ns()) / 1e9
        if not node.wanted or left_s > 0:
            time.sleep(min(_IDLE_S, max(left_s, 0.002)))
            continue
        next_ns = max(next_ns + period_ns, time.monotonic_ns())
        try:
            if node.publish(*size):
                write_message(pipe, {"event": "picture"})
        except TornSnapshotError as error:
            # The physics is blocked or ended; the loop's condition distinguishes the two.
            sys.stderr.write(f"edge-hil camera: image skipped: {error}\n")


def main(argv: list[str] | None = None) -> int:
    """Run the camera process until stdin closes."""
    parser = CommandParser(prog="edge-hil camera", description="started by edge-hil")
    for name in ("scene", "interface"):
        parser.add_argument(f"--{name}", required=True)
    parser.add_argument("--peer", action="append", default=[])
    for name in ("people", "seed", "width", "height", "domain", "pose-fd"):
        parser.add_argument(f"--{name}", type=int, required=True)
    parser.add_argument("--view-fd", type=int)
    args = parser.parse_args(argv)
    # Ctrl-C reaches the whole process group, but the parent decides when the camera ends.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    pipe = take_standard_output()
    world = CameraWorld(open_scene(args.scene), people=args.people, seed=args.seed, robot="carter")
    poses = SnapshotReader(args.pose_fd, world.state_size + 1)
    bus = Bus(DdsConfig(args.domain, args.interface, tuple(args.peer)))
    node = CameraNode(bus, world, poses, SensorNoise(args.width, args.height, args.seed), PictureView(args.view_fd))
    # BrokenPipeError: the parent died between two checks of stdin.
    with contextlib.closing(world), contextlib.closing(poses), contextlib.suppress(BrokenPipeError):
        write_message(pipe, {"event": "ready"})
        _publish_while_parent_lives(node, (args.width, args.height), pipe)
    return 0


if __name__ == "__main__":
    sys.exit(main())
