"""Telemetry of the rover: one function per message, a tilt filter, and a schedule with rates that a station may change.

The local frame is the base's pose at switch-on: "north" is its heading, east is to its right, z points down. There is
no GPS: latitude and longitude are computed from the local position and an invented origin.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import atan2, cos, exp, hypot, pi, radians, sin, tan
from types import MappingProxyType
from typing import Final

from pymavlink.dialects.v20 import common

from edge.core.geometry import wrap_angle
from sim_hil.protocols.mavlink.autopilots import PX4, Autopilot
from sim_hil.protocols.mavlink.setpoints import heading_degrees
from sim_hil.protocols.mavlink.vehicle import Vehicle
from sim_hil.protocols.mavlink.wire import Message
from sim_hil.robots.carter.drive import COUNTS_PER_TURN
from sim_hil.robots.carter.sensors import Sensors
from sim_hil.robots.carter.urdf import WHEEL_RADIUS_M

MAX_HZ: Final = 50.0  # rate of sensor readings
# Same origin as in PX4's simulation, a place that users recognise as simulated.
ORIGIN_LATITUDE_DEG: Final = 47.397742
ORIGIN_LONGITUDE_DEG: Final = 8.545594
ORIGIN_ALTITUDE_M: Final = 488.0
_EARTH_RADIUS_M: Final = 6_371_000.0
_TIME_CONSTANT_S: Final = 1.5  # our choice: longer than the base's acceleration phases
_NAN: Final = float("nan")
_SENSORS: Final = (
    common.MAV_SYS_STATUS_SENSOR_3D_GYRO
    | common.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    | common.MAV_SYS_STATUS_SENSOR_BATTERY
    | common.MAV_SYS_STATUS_SENSOR_MOTOR_OUTPUTS
    | common.MAV_SYS_STATUS_SENSOR_XY_POSITION_CONTROL
    | common.MAV_SYS_STATUS_PREARM_CHECK
)


@dataclass(frozen=True)
class Snapshot:
    """Data for reports at one instant; angles in the base's axes (x forward, y left, z up)."""

    stamp_s: float
    sensors: Sensors
    roll_rad: float
    pitch_rad: float
    vehicle: Vehicle
    broken: int
    low_charge: float  # 0 to 1
    autopilot: Autopilot = PX4

    @property
    def boot_ms(self) -> int:
        """Time since switch-on, ms, in the format of most messages."""
        return round(self.stamp_s * 1e3) & 0xFFFFFFFF

    @property
    def boot_us(self) -> int:
        """Return the time since switch-on, us."""
        return round(self.stamp_s * 1e6)

    @property
    def yaw_rad(self) -> float:
        """Yaw, clockwise from the local frame's north."""
        return -wrap_angle(self.sensors.T_odom_base.theta_rad)

    @property
    def north_east_m(self) -> tuple[float, float]:
        """Position in the local frame."""
        return self.sensors.T_odom_base.x_m, -self.sensors.T_odom_base.y_m

    @property
    def velocity_mps(self) -> tuple[float, float]:
        """Velocity (north, east) in the local frame."""
        return self.sensors.v_mps * cos(self.yaw_rad), self.sensors.v_mps * sin(self.yaw_rad)

    @property
    def rates_radps(self) -> tuple[float, float, float]:
        """Body rates in MAVLink's axes."""
        x, y, z = self.sensors.gyro_radps
        return x, -y, -z

    @property
    def quaternion(self) -> tuple[float, float, float, float]:
        """Attitude quaternion (w, x, y, z) in MAVLink's axes."""
        r, p, y = self.roll_rad / 2, -self.pitch_rad / 2, self.yaw_rad / 2
        return (
            cos(r) * cos(p) * cos(y) + sin(r) * sin(p) * sin(y),
            sin(r) * cos(p) * cos(y) - cos(r) * sin(p) * sin(y),
            cos(r) * sin(p) * cos(y) + sin(r) * cos(p) * sin(y),
            cos(r) * cos(p) * sin(y) - sin(r) * sin(p) * cos(y),
        )

    @property
    def latitude_longitude_deg(self) -> tuple[float, float]:
        """Latitude and longitude relative to the invented origin."""
        north, east = self.north_east_m
        shrink = cos(radians(ORIGIN_LATITUDE_DEG))
        return (
            ORIGIN_LATITUDE_DEG + north / _EARTH_RADIUS_M * 180 / pi,
            ORIGIN_LONGITUDE_DEG + east / (_EARTH_RADIUS_M * shrink) * 180 / pi,
        )


def heartbeat(vehicle: Vehicle, autopilot: Autopilot = PX4) -> Message:
    """Return the heartbeat; it announces an autopilot whose modes clients know.

    An active failsafe of an armed rover is a critical state, as with PX4 (its HEARTBEAT stream) and ArduPilot.
    """
    base_mode = vehicle.mode.base_flags | (common.MAV_MODE_FLAG_SAFETY_ARMED if vehicle.armed else 0)
    if vehicle.estop:
        status = common.MAV_STATE_EMERGENCY
    else:
        armed = common.MAV_STATE_CRITICAL if vehicle.failsafe else common.MAV_STATE_ACTIVE
        status = armed if vehicle.armed else common.MAV_STATE_STANDBY
    return common.MAVLink_heartbeat_message(
        common.MAV_TYPE_GROUND_ROVER, autopilot.number, base_mode, autopilot.custom_mode(vehicle.mode), status, 3
    )


def _heartbeat(now: Snapshot) -> Message:
    return heartbeat(now.vehicle, now.autopilot)


def _sys_status(now: Snapshot) -> Message:
    sensors = now.sensors
    healthy = _SENSORS | common.MAV_SYS_STATUS_GEOFENCE  # else MAVProxy reports a breach of a fence that does not exist
    if now.vehicle.obstacle_to_arming() is not None:
        healthy &= ~common.MAV_SYS_STATUS_PREARM_CHECK
    return common.MAVLink_sys_status_message(
        _SENSORS, _SENSORS, healthy, 0,
        min(65534, round(sensors.voltage_v * 1000)), min(32767, round(sensors.current_a * 100)),
        round(sensors.charge_percent), 0, min(65535, now.broken), 0, 0, 0, 0,
    )  # fmt: skip


def _attitude(now: Snapshot) -> Message:
    return common.MAVLink_attitude_message(now.boot_ms, now.roll_rad, -now.pitch_rad, now.yaw_rad, *now.rates_radps)


def _attitude_quaternion(now: Snapshot) -> Message:
    return common.MAVLink_attitude_quaternion_message(now.boot_ms, *now.quaternion, *now.rates_radps)


def _local_position(now: Snapshot) -> Message:
    return common.MAVLink_local_position_ned_message(now.boot_ms, *now.north_east_m, 0.0, *now.velocity_mps, 0.0)


def _odometry(now: Snapshot) -> Message:
    north, east = now.north_east_m
    return common.MAVLink_odometry_message(
        now.boot_us, common.MAV_FRAME_LOCAL_FRD, common.MAV_FRAME_BODY_FRD, north, east, 0.0, now.quaternion,
        now.sensors.v_mps, 0.0, 0.0, now.rates_radps[0], now.rates_radps[1], -now.sensors.w_radps,
        (_NAN,) * 21, (_NAN,) * 21, 0, common.MAV_ESTIMATOR_TYPE_NAIVE, 0,
    )  # fmt: skip


def _global_position(now: Snapshot) -> Message:
    latitude, longitude = now.latitude_longitude_deg
    vn, ve = now.velocity_mps
    return common.MAVLink_global_position_int_message(
        now.boot_ms, round(latitude * 1e7), round(longitude * 1e7), round(ORIGIN_ALTITUDE_M * 1000), 0,
        round(vn * 100), round(ve * 100), 0, round(heading_degrees(now.yaw_rad) * 100) % 36000,
    )  # fmt: skip


def _vfr_hud(now: Snapshot) -> Message:
    wanted = now.vehicle.wanted()
    throttle = 0 if wanted is None else round(100 * min(1.0, abs(wanted[0]) / 1.5))
    speed = hypot(*now.velocity_mps)
    heading = round(heading_degrees(now.yaw_rad)) % 360
    return common.MAVLink_vfr_hud_message(speed, speed, heading, throttle, ORIGIN_ALTITUDE_M, 0.0)


def _battery(now: Snapshot) -> Message:
    sensors = now.sensors
    volts = [min(65534, round(sensors.voltage_v * 1000))] + [65535] * 9
    low = sensors.charge_percent <= 100 * now.low_charge
    return common.MAVLink_battery_status_message(
        0, common.MAV_BATTERY_FUNCTION_ALL, common.MAV_BATTERY_TYPE_LION, 32767, volts,
        round(sensors.current_a * 100), -1, -1, round(sensors.charge_percent), 0,
        common.MAV_BATTERY_CHARGE_STATE_LOW if low else common.MAV_BATTERY_CHARGE_STATE_OK,
    )  # fmt: skip


def _extended_sys_state(now: Snapshot) -> Message:
    return common.MAVLink_extended_sys_state_message(common.MAV_VTOL_STATE_UNDEFINED, common.MAV_LANDED_STATE_ON_GROUND)


def _wheel_distance(now: Snapshot) -> Message:
    distances_m = [count * 2 * pi * WHEEL_RADIUS_M / COUNTS_PER_TURN for count in now.sensors.wheel_counts]
    return common.MAVLink_wheel_distance_message(now.boot_us, 2, distances_m + [0.0] * 14)


def _system_time(now: Snapshot) -> Message:
    return common.MAVLink_system_time_message(0, now.boot_ms)  # 0: time of day unknown


def _highres_imu(now: Snapshot) -> Message:
    ax, ay, az = now.sensors.accel_mps2
    gyro_and_accel = 0x3F
    return common.MAVLink_highres_imu_message(
        now.boot_us, ax, -ay, -az, *now.rates_radps, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, gyro_and_accel, 0
    )


def _origin(now: Snapshot) -> Message:
    return common.MAVLink_gps_global_origin_message(
        round(ORIGIN_LATITUDE_DEG * 1e7), round(ORIGIN_LONGITUDE_DEG * 1e7), round(ORIGIN_ALTITUDE_M * 1000), 0
    )


def _home(now: Snapshot) -> Message:
    return common.MAVLink_home_position_message(
        round(ORIGIN_LATITUDE_DEG * 1e7), round(ORIGIN_LONGITUDE_DEG * 1e7), round(ORIGIN_ALTITUDE_M * 1000),
        0.0, 0.0, 0.0, (1.0, 0.0, 0.0, 0.0), _NAN, _NAN, _NAN, 0,
    )  # fmt: skip


def autopilot_version(system: int) -> Message:
    """Return the rover's capabilities; the version is 1.0.0."""
    capabilities = (
        common.MAV_PROTOCOL_CAPABILITY_MAVLINK2
        | common.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
        | common.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
        | common.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
        | common.MAV_PROTOCOL_CAPABILITY_FLIGHT_TERMINATION
    )
    version = 1 << 24 | common.FIRMWARE_VERSION_TYPE_OFFICIAL
    return common.MAVLink_autopilot_version_message(
        capabilities, version, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, system
    )


@dataclass(frozen=True)
class Stream:
    """Function that makes a message, and its default rate, Hz; 0: only on request."""

    make: Callable[[Snapshot], Message]
    rate_hz: float


STREAMS: Final[Mapping[int, Stream]] = MappingProxyType(
    {
        common.MAVLINK_MSG_ID_HEARTBEAT: Stream(_heartbeat, 1.0),
        common.MAVLINK_MSG_ID_SYS_STATUS: Stream(_sys_status, 1.0),
        common.MAVLINK_MSG_ID_SYSTEM_TIME: Stream(_system_time, 1.0),
        common.MAVLINK_MSG_ID_ATTITUDE: Stream(_attitude, 20.0),
        common.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: Stream(_attitude_quaternion, 0.0),
        common.MAVLINK_MSG_ID_LOCAL_POSITION_NED: Stream(_local_position, 20.0),
        common.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: Stream(_global_position, 5.0),
        common.MAVLINK_MSG_ID_VFR_HUD: Stream(_vfr_hud, 4.0),
        common.MAVLINK_MSG_ID_HIGHRES_IMU: Stream(_highres_imu, 0.0),
        common.MAVLINK_MSG_ID_BATTERY_STATUS: Stream(_battery, 0.5),
        common.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: Stream(_extended_sys_state, 1.0),
        common.MAVLINK_MSG_ID_ODOMETRY: Stream(_odometry, 50.0),
        common.MAVLINK_MSG_ID_WHEEL_DISTANCE: Stream(_wheel_distance, 10.0),
        common.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: Stream(_origin, 0.0),
        common.MAVLINK_MSG_ID_HOME_POSITION: Stream(_home, 0.0),
    }
)


class TiltFilter:
    """Complementary filter in the base's axes: x forward, y left, z up."""

    def __init__(self) -> None:
        self.roll_rad = self.pitch_rad = 0.0
        self._last_s: float | None = None

    def step(self, time_s: float, gyro_radps: tuple[float, ...], accel_mps2: tuple[float, ...]) -> None:
        """Add a sensor reading; times must not decrease."""
        ax, ay, az = accel_mps2
        roll, pitch = atan2(ay, az), atan2(-ax, hypot(ay, az))
        if self._last_s is None:
            self.roll_rad, self.pitch_rad = roll, pitch
        else:
            elapsed_s = time_s - self._last_s
            share = 1 - exp(-elapsed_s / _TIME_CONSTANT_S)
            wx, wy, wz = gyro_radps
            turn = wy * sin(self.roll_rad) + wz * cos(self.roll_rad)
            self.roll_rad += elapsed_s * (wx + tan(max(-1.4, min(1.4, self.pitch_rad))) * turn)  # a base on its side
            self.pitch_rad += elapsed_s * (wy * cos(self.roll_rad) - wz * sin(self.roll_rad))
            self.roll_rad += share * (roll - self.roll_rad)
            self.pitch_rad += share * (pitch - self.pitch_rad)
        self._last_s = time_s


class Schedule:
    """Schedule of the periodic messages."""

    def __init__(self, without: tuple[int, ...] = ()) -> None:
        """`without`: numbers of messages that this rover does not have."""
        self._without = without
        usual = {number: stream for number, stream in STREAMS.items() if number not in without}
        self._periods_s = {number: 1 / stream.rate_hz for number, stream in usual.items() if stream.rate_hz}
        self._next_s = dict.fromkeys(self._periods_s, 0.0)

    def interval_us(self, number: int) -> int | None:
        """Return the interval in the format of MESSAGE_INTERVAL, us; -1: not sent; None: no such message."""
        if number not in STREAMS:
            return None
        period = self._periods_s.get(number)
        return -1 if period is None else round(period * 1e6)

    def set_interval(self, number: int, interval_us: float, now_s: float) -> bool:
        """Set a message's interval, us, at most MAX_HZ; 0: default, -1: never.

        Returns False for an unknown message, a bad interval and the heartbeat, whose rate is fixed.
        """
        known = number in STREAMS and number not in self._without
        if not known or number == common.MAVLINK_MSG_ID_HEARTBEAT or not -1 <= interval_us < 1e9:
            return False
        usual = STREAMS[number].rate_hz
        self._periods_s.pop(number, None)
        self._next_s.pop(number, None)
        if interval_us > 0 or (interval_us == 0 and usual):
            self._periods_s[number] = max(interval_us / 1e6, 1 / MAX_HZ) if interval_us > 0 else 1 / usual
            self._next_s[number] = now_s
        return True

    def due(self, now_s: float) -> list[int]:
        """Return the numbers of the messages to send now."""
        numbers = [number for number, at_s in self._next_s.items() if now_s >= at_s]
        for number in numbers:
            # Relative to the last due time, to keep the rate; after a pause relative to now, to avoid a burst.
            self._next_s[number] = max(self._next_s[number] + self._periods_s[number], now_s)
        return numbers
