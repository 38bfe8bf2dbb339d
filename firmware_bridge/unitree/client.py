"""What the runner reads from a Go2: state as it arrives, camera frames on request. It cannot command anything."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from firmware_bridge.config import RobotConfig
from firmware_bridge.unitree.dds import Bus, take_each
from firmware_bridge.unitree.idl import SportModeState_
from firmware_bridge.unitree.ids import GET_IMAGE_SAMPLE, SPORT_STATE_TOPIC, VIDEO_SERVICE
from firmware_bridge.unitree.rpc import RpcClient, RpcError

_WAIT_NS: Final = 100_000_000  # how soon close() is noticed
_JPEG_START: Final = b"\xff\xd8"


class CameraError(RuntimeError):
    """No usable camera frame; one line that says why."""


@dataclass(frozen=True)
class RobotState:
    """One odometry report: `T_odom_base` = (x_m, y_m, theta_rad), velocity in the body frame."""

    received_ns: int
    T_odom_base: tuple[float, float, float]
    vx_mps: float
    vy_mps: float
    wz_radps: float
    mode: int
    error_code: int


def robot_state(sample: SportModeState_, received_ns: int, velocity_frame: str) -> RobotState | None:
    """Convert a `rt/sportmodestate` sample; None when a number in it is not finite.

    `velocity_frame` is the frame of `sample.velocity`: the maker's simulator reports it in the odometry frame.
    """
    x_m, y_m = sample.position[0], sample.position[1]
    theta_rad = sample.imu_state.rpy[2]
    vx_mps, vy_mps, wz_radps = sample.velocity[0], sample.velocity[1], sample.yaw_speed
    if not all(map(math.isfinite, (x_m, y_m, theta_rad, vx_mps, vy_mps, wz_radps))):
        return None
    if velocity_frame == "odom":
        cos, sin = math.cos(theta_rad), math.sin(theta_rad)
        vx_mps, vy_mps = cos * vx_mps + sin * vy_mps, cos * vy_mps - sin * vx_mps
    pose = (x_m, y_m, theta_rad)
    return RobotState(received_ns, pose, vx_mps, vy_mps, wz_radps, sample.mode, sample.error_code)


class Go2Reader:
    """Newest robot state and camera frames of one robot. Raises DdsError when the bus cannot be joined."""

    def __init__(self, config: RobotConfig, *, bus: Bus | None = None) -> None:
        """`bus`: use an already open participant (DDS allows one per domain and process)."""
        self.malformed = 0
        self._velocity_frame = config.odometry.velocity_frame
        self._state: RobotState | None = None
        self._listener: Callable[[RobotState], None] | None = None
        self._closing = threading.Event()
        self._bus = bus or Bus(config.dds)
        self._owns_bus = bus is None
        self._reader = self._bus.reader(SPORT_STATE_TOPIC, SportModeState_)
        self._waitset = self._bus.waitset(self._reader)
        self._video = RpcClient(self._bus, VIDEO_SERVICE)
        self._thread = threading.Thread(target=self._read_states, name="go2-state", daemon=True)
        self._thread.start()

    def state(self) -> RobotState | None:
        """The newest state, None before the first; any thread, never waits."""
        return self._state

    def set_state_listener(self, listener: Callable[[RobotState], None] | None) -> None:
        """Call `listener` with every state as it arrives, in the reading thread; it must not block or raise."""
        self._listener = listener

    def request_frame(self, timeout_s: float) -> bytes:
        """Ask for one camera frame and wait for it: JPEG bytes. One caller at a time. Raises CameraError."""
        try:
            frame = self._video.call(GET_IMAGE_SAMPLE, timeout_s=timeout_s).binary
        except RpcError as error:
            raise CameraError(f"camera: {error}") from error
        if not frame.startswith(_JPEG_START):
            raise CameraError(f"camera: expected a JPEG, found {len(frame)} bytes starting {frame[:4]!r}")
        return frame

    def close(self) -> None:
        """Stop the reading thread and leave the bus, unless it was given. No frame may be under way."""
        self._closing.set()
        self._thread.join()
        if self._owns_bus:
            self._bus.close()

    def _read_states(self) -> None:
        while not self._closing.is_set():
            self._waitset.wait(_WAIT_NS)
            for sample in take_each(self._reader):
                received_ns = time.monotonic_ns()
                state = None if sample is None else robot_state(sample, received_ns, self._velocity_frame)
                if state is None:
                    self.malformed += 1
                    continue
                self._state = state
                listener = self._listener
                if listener is not None:
                    listener(state)
