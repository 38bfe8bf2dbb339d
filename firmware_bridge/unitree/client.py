"""What the runner reads from a Go2: state as it arrives, camera frames on request. It cannot command anything."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Final

from firmware_bridge.core.config import RobotConfig
from firmware_bridge.core.robot_state import BatteryState, CameraError, RobotState, StampOrder
from firmware_bridge.dds.bus import Bus, take_each
from firmware_bridge.dds.publishers import PublisherWatch
from firmware_bridge.unitree.messages.idl import SportModeState_
from firmware_bridge.unitree.messages.idl_low import LowState_
from firmware_bridge.unitree.messages.ids import (
    GET_IMAGE_SAMPLE,
    LF_LOW_STATE_TOPIC,
    SPORT_STATE_TOPIC,
    VIDEO_SERVICE,
    trusted_publishers,
)
from firmware_bridge.unitree.report import battery_state, robot_state
from firmware_bridge.unitree.rpc import RpcClient, RpcError

_WAIT_NS: Final = 100_000_000  # how soon close() is noticed
_BATTERY_PERIOD_NS: Final = 500_000_000  # decoding a low state costs as much as ten odometry reports
_JPEG_START: Final = b"\xff\xd8"


class Go2Reader:
    """Newest robot state and camera frames of one robot. Raises DdsError when the bus cannot be joined."""

    def __init__(
        self, config: RobotConfig, *, bus: Bus | None = None, on_death: Callable[[str], None] = lambda why: None
    ) -> None:
        """`bus`: use an already open participant (DDS allows one per domain and process).

        `on_death` gets the reason once, in the reading thread, when that ends although nobody closed the reader.
        """
        self.malformed = 0
        """States that were dropped because something in them cannot be."""
        self.malformed_battery = 0
        """Malformed battery reports; they do not affect driving."""
        self._on_death = on_death
        self._velocity_frame = config.odometry.velocity_frame
        self._state: RobotState | None = None
        self._battery: BatteryState | None = None
        self._battery_due_ns = 0
        self._order = StampOrder()
        self._listener: Callable[[RobotState], None] | None = None
        self._publishers: PublisherWatch | None = None
        self._motor_publishers = config.safety.robot_lowcmd_publishers
        self._closing = threading.Event()
        self._bus = bus or Bus(config.network)
        self._owns_bus = bus is None
        self._reader = self._bus.reader(SPORT_STATE_TOPIC, SportModeState_)
        self._low_reader = self._bus.reader(LF_LOW_STATE_TOPIC, LowState_)
        self._waitset = self._bus.waitset(self._reader)
        self._video = RpcClient(self._bus, VIDEO_SERVICE)
        self._thread = threading.Thread(target=self._run, name="go2-state", daemon=True)
        self._thread.start()

    def state(self) -> RobotState | None:
        """The newest state, None before the first; any thread, never waits."""
        return self._state

    @property
    def reordered(self) -> int:
        """States dropped because they were not newer than one already delivered."""
        return self._order.dropped

    def battery(self) -> BatteryState | None:
        """The battery as of at most 0.5 s ago, None before the first report; any thread, never waits.

        The robot does not report when it measured: judge the age by `received_ns`.
        """
        return self._battery

    def surplus_publishers(self) -> str | None:
        """Which topic of the robot has more publishers than it should have; None while discovery knows of none."""
        self._publishers = self._publishers or PublisherWatch(self._bus, trusted_publishers(self._motor_publishers))
        return self._publishers.surplus()

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

    def _run(self) -> None:
        try:
            self._read_states()
        except Exception as error:  # noqa: BLE001 - a dead thread must end the run, whatever killed it
            self._on_death(f"robot state thread died: {type(error).__name__}: {error}")

    def _read_states(self) -> None:
        while not self._closing.is_set():
            self._waitset.wait(_WAIT_NS)
            for sample in take_each(self._reader):
                received_ns = time.monotonic_ns()
                state = None if sample is None else robot_state(sample, received_ns, self._velocity_frame)
                if state is None:
                    self.malformed += 1
                    continue
                if not self._order.accept(state):
                    continue
                self._state = state
                listener = self._listener
                if listener is not None:
                    listener(state)
            self._read_battery(time.monotonic_ns())

    def _read_battery(self, now_ns: int) -> None:
        if now_ns < self._battery_due_ns:
            return
        self._battery_due_ns = now_ns + _BATTERY_PERIOD_NS
        for sample in take_each(self._low_reader):
            battery = None if sample is None else battery_state(sample, now_ns)
            if battery is None:
                self.malformed_battery += 1
            else:
                self._battery = battery
