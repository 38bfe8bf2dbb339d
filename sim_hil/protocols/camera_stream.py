"""Camera of a robot whose protocol carries no images: MJPEG over HTTP, from a separate process.

A browser, ffmpeg or OpenCV can read it; the server listens on the loopback interface only.
  GET /stream.mjpg   multipart/x-mixed-replace, one JPEG per part, at most at the camera's rate
  GET /frame.jpg     the next image whose rendering begins after the request
Every image has the header "X-Capture-Ns": time.monotonic_ns of the rendered pose. Without a client nothing is rendered.
`CameraStream` is the parent's handle: it passes the pose to the process through shared memory.
"""

from __future__ import annotations

import contextlib
import signal
import socket
import sys
import threading
import time
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final, TextIO

from firmware_bridge.system.terminal import CommandParser
from sim_hil.layouts.scenes import open_scene
from sim_hil.processes.child_process import Message, input_is_open, take_standard_output, write_message
from sim_hil.protocols.front_end import FrontEndOptions
from sim_hil.protocols.render_process import PictureView, RenderProcess, encode_jpeg
from sim_hil.protocols.snapshot import SnapshotReader, TornSnapshotError
from sim_hil.simulation.camera import CameraWorld
from sim_hil.simulation.sensor_noise import SensorNoise

RATE_HZ: Final = 15.0
_BOUNDARY: Final = "frame"
_IDLE_S: Final = 0.05
_FRAME_TIMEOUT_S: Final = 5.0
_SEND_TIMEOUT_S: Final = 5.0


@dataclass(frozen=True)
class Picture:
    """One JPEG, its sequence number, and time.monotonic_ns of the rendered pose."""

    number: int
    captured_ns: int
    jpeg: bytes


class Shutter:
    """Exchange between HTTP clients and the rendering thread, which renders only while a client waits."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting = 0
        self._picture: Picture | None = None

    def next_after(self, number: int, timeout_s: float) -> Picture | None:
        """Wait for an image newer than `number` and return it; None after `timeout_s`."""
        with self._changed:
            self._waiting += 1
            try:
                self._changed.wait_for(lambda: self._picture is not None and self._picture.number > number, timeout_s)
            finally:
                self._waiting -= 1
            picture = self._picture
            return picture if picture is not None and picture.number > number else None

    @property
    def newest(self) -> int:
        """Number of the newest image, 0 before the first."""
        with self._changed:
            return 0 if self._picture is None else self._picture.number

    @property
    def wanted(self) -> bool:
        """Whether a client waits for an image."""
        return self._waiting > 0

    def show(self, captured_ns: int, jpeg: bytes) -> None:
        """Pass a new image to all waiting clients."""
        with self._changed:
            number = 1 if self._picture is None else self._picture.number + 1
            self._picture = Picture(number, captured_ns, jpeg)
            self._changed.notify_all()


def listen(port: int) -> socket.socket:
    """Open a listening socket on the loopback interface; `port` 0: any free port. Raises OSError with one line."""
    try:
        return socket.create_server(("127.0.0.1", port))
    except OSError as error:
        raise OSError(f"camera: port {port}: expected a free port, {error.strerror}; choose another") from error


class CameraServer(ThreadingHTTPServer):
    """HTTP server on a listening socket, of which it takes ownership."""

    daemon_threads = True

    def __init__(self, listening: socket.socket, shutter: Shutter) -> None:
        self.shutter = shutter
        super().__init__(listening.getsockname(), _Handler, bind_and_activate=False)
        self.socket.close()
        self.socket = listening


class _Handler(BaseHTTPRequestHandler):
    server: CameraServer
    timeout = _SEND_TIMEOUT_S  # a client that stops reading is disconnected

    def do_GET(self) -> None:
        """Send one image or a stream of images."""
        if self.path == "/frame.jpg":
            with contextlib.suppress(OSError):
                self._frame()
        elif self.path == "/stream.mjpg":
            with contextlib.suppress(OSError):  # the client disconnected or stopped reading
                self._stream()
        else:
            self.send_error(404, "expected /stream.mjpg or /frame.jpg")

    def _frame(self) -> None:
        shutter, asked_ns = self.server.shutter, time.monotonic_ns()
        picture = shutter.next_after(shutter.newest, _FRAME_TIMEOUT_S)
        if picture is not None and picture.captured_ns < asked_ns:  # its rendering had begun for an earlier request
            picture = shutter.next_after(picture.number, _FRAME_TIMEOUT_S)
        if picture is None:
            self.send_error(503, "no image")
            return
        self.send_response(200)
        self._describe(picture)
        self.wfile.write(picture.jpeg)

    def _describe(self, picture: Picture) -> None:
        self.send_header("Content-Type", "image/jpeg")
        self.send_header("Content-Length", str(len(picture.jpeg)))
        self.send_header("X-Capture-Ns", str(picture.captured_ns))
        self.end_headers()

    def _stream(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={_BOUNDARY}")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        number = self.server.shutter.newest
        while True:
            picture = self.server.shutter.next_after(number, _FRAME_TIMEOUT_S)
            if picture is None:
                continue
            number = picture.number
            head = f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(picture.jpeg)}\r\n"
            head += f"X-Capture-Ns: {picture.captured_ns}\r\n\r\n"
            self.wfile.write(head.encode("ascii") + picture.jpeg + b"\r\n")

    def log_message(self, format: str, *args: Any) -> None:
        """Do not log requests."""


class CameraStream(RenderProcess):
    """Camera process with an HTTP server; counts its pictures."""

    def __init__(self, options: FrontEndOptions, port: int, state_length: int) -> None:
        """Start the process; `port`: 0 for any free port. Raises OSError if the port is in use."""
        # The parent opens the socket, so that a port in use is reported at once and a free port is known.
        with listen(port) as listening:
            self.port = int(listening.getsockname()[1])
            more = ["--robot", options.robot, "--listen-fd", str(listening.fileno())]
            super().__init__("sim_hil.protocols.camera_stream", options, more, state_length, (listening.fileno(),))
        self.pictures = 0

    @property
    def url(self) -> str:
        """URL of the stream."""
        return f"http://127.0.0.1:{self.port}/stream.mjpg"

    def events(self) -> list[Message]:
        """Events since the last call; counts the pictures among them. Raises CameraProcessError."""
        events = super().events()
        self.pictures += sum(event["event"] == "picture" for event in events)
        return events


def _render_while_parent_lives(
    world: CameraWorld,
    poses: SnapshotReader,
    shutter: Shutter,
    size: tuple[int, int],
    noise: SensorNoise,
    pipe: TextIO,
    view: PictureView,
) -> None:
    period_ns, next_ns = round(1e9 / RATE_HZ), time.monotonic_ns()
    while input_is_open():
        left_s = (next_ns - time.monotonic_ns()) / 1e9
        wanted = shutter.wanted
        if not (wanted or view.is_due) or left_s > 0:
            time.sleep(min(_IDLE_S, max(left_s, 0.002)))
            continue
        next_ns = max(next_ns + period_ns, time.monotonic_ns())
        captured_ns = time.monotonic_ns()
        try:
            state = poses.read()
        except TornSnapshotError as error:
            # The physics is blocked or ended; the loop's condition distinguishes the two.
            sys.stderr.write(f"edge-hil camera: image skipped: {error}\n")
            continue
        if state is not None:
            jpeg = encode_jpeg(noise.add(world.render(state, *size)))
            view.show(jpeg)
            if wanted:
                shutter.show(captured_ns, jpeg)
                write_message(pipe, {"event": "picture"})


def main(argv: list[str] | None = None) -> int:
    """Run the camera process until stdin closes."""
    parser = CommandParser(prog="edge-hil camera", description="started by edge-hil")
    parser.add_argument("--scene", required=True)
    parser.add_argument("--robot", required=True)
    for name in ("people", "seed", "width", "height", "listen-fd", "pose-fd"):
        parser.add_argument(f"--{name}", type=int, required=True)
    parser.add_argument("--view-fd", type=int)
    args = parser.parse_args(argv)
    # Ctrl-C reaches the whole process group, but the parent decides when the camera ends.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    pipe, shutter, size = take_standard_output(), Shutter(), (args.width, args.height)
    server = CameraServer(socket.socket(fileno=args.listen_fd), shutter)
    world = CameraWorld(open_scene(args.scene), people=args.people, seed=args.seed, robot=args.robot)
    poses = SnapshotReader(args.pose_fd, world.state_size)
    noise = SensorNoise(args.width, args.height, args.seed)
    threading.Thread(target=server.serve_forever, name="camera-http", daemon=True).start()
    # BrokenPipeError: the parent died between two checks of stdin.
    with contextlib.closing(world), contextlib.closing(poses), contextlib.suppress(BrokenPipeError):
        write_message(pipe, {"event": "ready"})
        _render_while_parent_lives(world, poses, shutter, size, noise, pipe, PictureView(args.view_fd))
    return 0


if __name__ == "__main__":
    sys.exit(main())
