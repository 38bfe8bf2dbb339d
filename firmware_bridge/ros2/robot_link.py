"""The bridge's end of a ROS 2 base: one `Report` of the received messages per step, and written Twists."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any, Final

from cyclonedds.sub import DataReader

from firmware_bridge.core.config import RobotConfig, Ros2Config
from firmware_bridge.core.config_ros2 import RELIABLE
from firmware_bridge.core.robot_state import BatteryState, RobotState, StampOrder
from firmware_bridge.core.sections import ConfigError
from firmware_bridge.core.step_types import Move, Report, Request, StopMotion
from firmware_bridge.dds.binding import has_reader
from firmware_bridge.dds.bus import DDS_ERRORS, Bus, take_each
from firmware_bridge.dds.publishers import PublisherWatch
from firmware_bridge.ros2.messages.common import Header_, Time_, Twist_, TwistStamped_, Vector3_
from firmware_bridge.ros2.messages.navigation import Odometry_
from firmware_bridge.ros2.messages.sensors import BatteryState_, Imu_
from firmware_bridge.ros2.report import Attitude, attitude, battery_state, robot_state

_FAILING_WRITES: Final = 3  # in a row: 60 ms at 50 Hz, inside the 100 ms of fault matrix row 46
_IMU_SILENT_NS: Final = 500_000_000  # our choice: five times the period of a slow IMU
_FEW: Final = 4  # samples of one topic per step: 200 a second, each decoded quickly
_MAX_BYTES: Final = 4096  # an Odometry, the largest message read here, has 720 and two names
_MAX_KEPT_BYTES: Final = 256 * 1024  # times 11, the depth of all readers: far below the service's MemoryMax
_NS_PER_S: Final = 1_000_000_000
_MAX_STAMP_S: Final = 2**31 - 1


class RobotLink:
    """All readers and the only writer of a base; no method waits. Raises DdsError when the domain cannot be joined."""

    def __init__(self, config: RobotConfig, report: Callable[[str], None]) -> None:
        """`report` takes one line at the start when the base does not stop by itself in time."""
        if config.ros2 is None:
            raise ConfigError("missing table [ros2]")
        self._settings = settings = config.ros2
        self._velocity_frame = config.odometry.velocity_frame
        command, odometry = settings.topic(settings.command), settings.topic(settings.odometry)
        self._command_topic = command
        self._bus = bus = Bus(config.network, max_sample_bytes=_MAX_KEPT_BYTES)
        kind: Any = TwistStamped_ if settings.stamped else Twist_
        self._writer = bus.writer(command, kind, reliable=settings.command_reliability == RELIABLE)
        # Best effort, because it sees every publisher's commands.
        self._foreign_commands = bus.reader(command, kind, depth=8, foreign=True)
        self._odometry = bus.reader(odometry, Odometry_, reliable=settings.reliable_inputs)
        self._imu = _optional(bus, settings, settings.imu, Imu_)
        self._battery = _optional(bus, settings, settings.battery, BatteryState_)
        trusted = [settings.topic(name) for name in (settings.odometry, settings.imu, settings.battery) if name]
        self._inputs = PublisherWatch(bus, dict.fromkeys(trusted, 1))
        self._commanders = PublisherWatch(bus, {command: settings.other_command_publishers})
        self._order = StampOrder()
        self._attitude: Attitude | None = None
        self._has_tilt = False  # whether the IMU has reported an orientation
        self._clock: tuple[int, int] | None = None  # the base's newest stamp and when it was received, ns
        self._malformed = self._failed_writes = self._failing = 0
        if settings.supervised:
            report(
                "robot file: ros2.supervised is true: if this bridge dies, the base may drive on; only a person at the"
                " base's own emergency stop ends that"
            )

    def dropped(self) -> tuple[int, int, int]:
        """Return counts so far: impossible messages, odometry out of order, commands that DDS did not accept."""
        return self._malformed, self._order.dropped, self._failed_writes

    def read(self, now_ns: int) -> Report:
        """Return the report of all messages since the last call."""
        self._take_imu()
        state, battery, foreign = self._newest_state(), self._newest_battery(), self._foreign()
        return Report(
            state=state,
            foreign=foreign,
            publishers=self._inputs.surplus(),
            battery=battery,
            writes_fail=self._failing >= _FAILING_WRITES,
            unsafe=self._unsafe(now_ns),
        )

    def write(self, request: Request) -> None:
        """Send a velocity without waiting; a stop is a velocity of zero. A base without modes ignores the rest."""
        if isinstance(request, Move):
            self._send(Twist_(Vector3_(request.vx_mps, request.vy_mps, 0.0), Vector3_(0.0, 0.0, request.wz_radps)))
        elif isinstance(request, StopMotion):
            self._send(Twist_(Vector3_(0.0, 0.0, 0.0), Vector3_(0.0, 0.0, 0.0)))

    def close(self) -> None:
        """Leave the bus."""
        self._bus.close()

    def _send(self, twist: Twist_) -> None:
        message: Any = twist
        if self._settings.stamped:
            message = TwistStamped_(Header_(self._stamp(), self._settings.command_frame), twist)
        try:
            self._writer.write(message)
        except DDS_ERRORS:
            self._failed_writes += 1
            self._failing += 1
        else:
            self._failing = 0

    def _stamp(self) -> Time_:
        """Return the time on the base's own clock, continued from its newest odometry.

        So neither a difference of clocks nor simulated time makes the base drop a command as old. Zero before the
        first odometry and for a base without stamps.
        """
        if self._clock is None or self._clock[0] == 0:
            return Time_(0, 0)
        seconds, rest = divmod(self._clock[0] + time.monotonic_ns() - self._clock[1], _NS_PER_S)
        return Time_(seconds, rest) if seconds <= _MAX_STAMP_S else Time_(0, 0)

    def _take_imu(self) -> None:
        for sample in _few(self._imu):
            found = None if sample is None else attitude(sample, time.monotonic_ns())
            self._malformed += found is None
            self._attitude = found or self._attitude
            self._has_tilt |= found is not None and found.roll_rad is not None

    def _newest_state(self) -> RobotState | None:
        newest = None
        for sample in _few(self._odometry):
            received_ns = time.monotonic_ns()
            state = None if sample is None else robot_state(sample, received_ns, self._velocity_frame, self._attitude)
            if state is None:
                self._malformed += 1
            elif self._order.accept(state):
                newest, self._clock = state, (state.robot_stamp_ns, received_ns)
        return newest

    def _newest_battery(self) -> BatteryState | None:
        battery = None
        for sample in _few(self._battery):
            battery = None if sample is None else battery_state(sample, time.monotonic_ns())
            self._malformed += battery is None
        return battery

    def _foreign(self) -> str | None:
        """Return a sign of another node that commands the base: a publisher of its command topic, or a command."""
        foreign = self._commanders.surplus()
        for sample in _few(self._foreign_commands):
            self._malformed += sample is None
            foreign = f"a command on {self._command_topic}"
        return foreign

    def _unsafe(self, now_ns: int) -> str | None:
        """Return why this base must not drive now; None when nothing speaks against it."""
        if not has_reader(self._writer):
            kind = "TwistStamped" if self._settings.stamped else "Twist"
            return (
                f"no node subscribes to {self._command_topic} as {kind}; start the base's driver, or correct"
                " ros2.command, ros2.stamped and ros2.command_reliability in the robot file"
            )
        if self._imu is not None and (self._attitude is None or now_ns - self._attitude.received_ns > _IMU_SILENT_NS):
            return f"no usable message on {self._settings.topic(self._settings.imu)} for {_IMU_SILENT_NS / 1e6:.0f} ms"
        if self._has_tilt and self._attitude is not None and self._attitude.roll_rad is None:
            # A tilt that cannot be told is not level.
            return f"{self._settings.topic(self._settings.imu)} reports no orientation any more"
        return None


def _optional(bus: Bus, settings: Ros2Config, name: str, kind: Any) -> DataReader[Any] | None:
    return bus.reader(settings.topic(name), kind, reliable=settings.reliable_inputs) if name else None


def _few(reader: DataReader[Any] | None) -> Iterator[Any]:
    return iter(()) if reader is None else take_each(reader, _FEW, _MAX_BYTES)
