"""What the runner reads of a robot of another protocol: the bridge's reports, and a camera of its own."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from edge.robot.cameras.mjpeg import MjpegCamera
from edge.robot.cameras.newest import CameraSource
from edge.robot.cameras.ros2 import Ros2Camera
from edge.robot.cameras.video_capture import VideoCaptureCamera
from edge.robot.inputs import RobotInputs
from edge.robot.reader import open_camera, open_reader
from firmware_bridge.client_link import ClientLink
from firmware_bridge.core.config import OBSERVER_SUFFIX, RobotConfig, Ros2Config, load_robot_config
from firmware_bridge.core.robot_state import BatteryState, CameraError, RobotState
from firmware_bridge.dds.shared_bus import SharedBus
from firmware_bridge.state_client import StateReader
from sim_hil.protocols.camera_stream import CameraServer, Shutter, listen
from tests.edge.robot.test_camera_poller import jpeg
from tests.support.processes import GO2_SIM

MS = 1_000_000


def robot_with(folder: Path, source: str) -> RobotConfig:
    go2 = load_robot_config(GO2_SIM, socket=folder / "bridge.sock")
    camera = replace(go2.camera, source=source)
    return replace(go2, protocol="ros2", ros2=Ros2Config(500, battery="battery"), camera=camera, mount=None)


def until(done: Callable[[], object], meanwhile: Callable[[], object] = lambda: None) -> None:
    deadline = time.monotonic() + 5
    while not done():
        assert time.monotonic() < deadline, "not within 5 s"
        meanwhile()
        time.sleep(0.01)


class TestInputs:
    """`RobotInputs` between a bridge's socket and a camera's HTTP server."""

    @pytest.fixture
    def observers(self, tmp_path: Path) -> Iterator[ClientLink]:
        with closing(ClientLink(Path(f"{tmp_path / 'bridge.sock'}{OBSERVER_SUFFIX}"), places=4)) as link:
            yield link

    @pytest.fixture
    def shutter(self) -> Shutter:
        return Shutter()

    @pytest.fixture
    def inputs(self, tmp_path: Path, observers: ClientLink, shutter: Shutter) -> Iterator[RobotInputs]:
        server = CameraServer(listen(0), shutter)
        threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
        url = f"http://127.0.0.1:{server.socket.getsockname()[1]}/stream.mjpg"
        inputs = RobotInputs(
            robot_with(tmp_path, url), image_px=32, period_ns=20 * MS, commanded=lambda: None, say=lambda _line: None
        )
        inputs.camera.start()
        yield inputs
        inputs.close()
        server.shutdown()
        server.server_close()

    def test_reports_and_pictures_of_the_bridge_and_the_server_make_it_ready(
        self, inputs: RobotInputs, observers: ClientLink, shutter: Shutter
    ) -> None:
        until(lambda: observers.connected, observers.receive)
        until(lambda: shutter.wanted)

        def send() -> None:
            now_ns = time.monotonic_ns()
            observers.send(
                RobotState(now_ns, (1.0, 2.0, 0.1), 0.3, 0.0, 0.0, 1, 0, now_ns, 0.0, 0.0, 0.0, 0.0, (0, 0, 0, 0))
            )
            observers.send(BatteryState(now_ns, 77, 24.0, -1.0))
            shutter.show(now_ns - 9 * MS, jpeg())

        until(lambda: inputs.ready and inputs.battery(), send)
        pose, battery = inputs.history.newest(), inputs.battery()
        assert pose is not None and pose.T_odom_base.x_m == pytest.approx(1.0, abs=0.01)
        assert battery is not None and battery.soc_percent == 77

    def test_a_picture_has_the_stamp_of_its_capture(
        self, inputs: RobotInputs, observers: ClientLink, shutter: Shutter
    ) -> None:
        until(lambda: shutter.wanted)
        captured_ns = time.monotonic_ns() - 300 * MS
        shutter.show(captured_ns, jpeg())
        until(lambda: inputs.camera.newest)
        assert inputs.camera.newest is not None and inputs.camera.newest.stamp_ns == captured_ns

    def test_a_missing_state_is_explained_by_the_bridge(self, inputs: RobotInputs, observers: ClientLink) -> None:
        until(lambda: observers.connected, observers.receive)
        until(lambda: not inputs.reader.link_error)  # type: ignore[attr-defined]
        status: Any = SimpleNamespace(reason="no interface can0")
        assert inputs.why_missing(status) == " (no interface can0)"


def test_without_a_bridge_that_is_why_a_state_is_missing(tmp_path: Path) -> None:
    robot = robot_with(tmp_path, "v4l2:/dev/video99")
    inputs = RobotInputs(robot, image_px=32, period_ns=MS, commanded=lambda: None, say=lambda _line: None)
    until(lambda: "no bridge listens" in inputs.why_missing(None))
    inputs.camera.start()
    inputs.close()


@pytest.mark.parametrize(
    ("source", "kind"),
    [
        ("http://127.0.0.1:9/s", MjpegCamera),
        ("v4l2:/dev/video99", VideoCaptureCamera),
        ("gstreamer:videotestsrc ! appsink", VideoCaptureCamera),
        ("ros2:/camera/image/compressed", Ros2Camera),
        ("ros2raw:/camera/image", Ros2Camera),
    ],
)
def test_the_source_decides_which_camera_is_opened(tmp_path: Path, source: str, kind: type) -> None:
    with closing(open_camera(robot_with(tmp_path, source))) as camera:
        assert isinstance(camera, kind)


def test_a_camera_on_ros_2_shares_the_runners_participant(tmp_path: Path, dds_domain: int) -> None:
    """A second participant of this process in the domain would be refused."""
    robot = robot_with(tmp_path, "ros2:/camera/image/compressed")
    bus = SharedBus(replace(robot.network, domain=dds_domain))
    kept = bus.open()
    with closing(open_camera(robot, bus)) as camera:
        until(lambda: "no node publishes" in error_of(camera))
    assert bus.open() is kept
    bus.close()


def error_of(camera: CameraSource) -> str:
    """Why the camera has no picture."""
    with pytest.raises(CameraError) as error:
        camera.request_frame(0.01)
    return str(error.value)


def test_a_robot_of_another_protocol_is_read_through_the_bridge(tmp_path: Path) -> None:
    reader, camera = open_reader(robot_with(tmp_path, "v4l2:/dev/video99"))
    camera.close()
    with closing(reader):
        assert isinstance(reader, StateReader)
