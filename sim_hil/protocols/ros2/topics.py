"""Topics of the simulated ROS 2 base, and its reports as messages."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, Final

from firmware_bridge.dds.bus import Bus
from firmware_bridge.ros2.messages.common import (
    Header_,
    Point_,
    Pose_,
    PoseWithCovariance_,
    Quaternion_,
    Time_,
    Transform_,
    TransformStamped_,
    Twist_,
    TwistWithCovariance_,
    Vector3_,
)
from firmware_bridge.ros2.messages.navigation import Odometry_, TFMessage_
from firmware_bridge.ros2.messages.sensors import BatteryState_, CameraInfo_, Imu_, RegionOfInterest_
from sim_hil.robots.carter.body import CAMERA_HFOV_RAD, CAMERA_PITCH_RAD, CAMERA_POSITION_M, CarterTruth
from sim_hil.robots.carter.sensors import (
    ACCEL_NOISE_MPS2,
    GYRO_NOISE_RADPS,
    Sensors,
)

COMMAND_TOPIC: Final = "rt/cmd_vel"
ODOMETRY_TOPIC: Final = "rt/odom"
IMU_TOPIC: Final = "rt/imu"
BATTERY_TOPIC: Final = "rt/battery_state"
TF_TOPIC: Final = "rt/tf"
IMAGE_TOPIC: Final = "rt/camera/image/compressed"
CAMERA_INFO_TOPIC: Final = "rt/camera/camera_info"
ODOM_FRAME: Final = "odom"
BASE_FRAME: Final = "base_link"
CAMERA_FRAME: Final = "camera"
RATES_HZ: Final = {ODOMETRY_TOPIC: 50, TF_TOPIC: 50, IMU_TOPIC: 100, BATTERY_TOPIC: 1}

_POSE_VARIANCE: Final = 1e-3  # our choice: m² and rad² for consumers that refuse zero; the drift is not estimated
_UNKNOWN: Final = math.nan  # sensor_msgs/BatteryState: "If unmeasured NaN"
_DISCHARGING: Final = 2  # POWER_SUPPLY_STATUS_DISCHARGING
# Rotation from the base's axes to those of a picture (REP 103): x right, y down, z into the picture.
_OPTICAL: Final = (-0.5, 0.5, -0.5, 0.5)


def header(stamp_s: float, frame: str) -> Header_:
    """Return a header stamped with the robot's clock."""
    stamp_ns = round(stamp_s * 1e9)
    return Header_(Time_(stamp_ns // 1_000_000_000, stamp_ns % 1_000_000_000), frame)


def odometry(sensors: Sensors, stamp_s: float) -> Odometry_:
    """Return the wheels' odometry: pose in `odom`, velocity in `base_link`."""
    pose = sensors.T_odom_base
    at = Pose_(Point_(pose.x_m, pose.y_m, 0.0), _about_z(pose.theta_rad))
    speed = Twist_(Vector3_(sensors.v_mps, 0.0, 0.0), Vector3_(0.0, 0.0, sensors.w_radps))
    covariance = _diagonal(6, _POSE_VARIANCE)
    stamped = header(stamp_s, ODOM_FRAME)
    return Odometry_(stamped, BASE_FRAME, PoseWithCovariance_(at, covariance), TwistWithCovariance_(speed, covariance))


def imu(sensors: Sensors, truth: CarterTruth, stamp_s: float) -> Imu_:
    """Return gyroscope and accelerometer with their noise, and the true orientation, as from a good filter."""
    w, x, y, z = map(float, truth.quaternion_wxyz)
    return Imu_(
        header(stamp_s, BASE_FRAME),
        Quaternion_(x, y, z, w),
        _diagonal(3, _POSE_VARIANCE),
        Vector3_(*sensors.gyro_radps),
        _diagonal(3, GYRO_NOISE_RADPS**2),
        Vector3_(*sensors.accel_mps2),
        _diagonal(3, ACCEL_NOISE_MPS2**2),
    )


def battery(sensors: Sensors, stamp_s: float) -> BatteryState_:
    """Return charge, voltage and current (negative while discharging)."""
    return BatteryState_(
        header(stamp_s, BASE_FRAME),
        voltage=sensors.voltage_v,
        temperature=_UNKNOWN,
        current=-abs(sensors.current_a),
        charge=_UNKNOWN,
        capacity=_UNKNOWN,
        design_capacity=_UNKNOWN,
        percentage=min(1.0, max(0.0, sensors.charge_percent / 100)),
        power_supply_status=_DISCHARGING,
        power_supply_health=0,
        power_supply_technology=0,
        present=True,
        cell_voltage=[],
        cell_temperature=[],
        location="",
        serial_number="",
    )


def transforms(sensors: Sensors, stamp_s: float) -> TFMessage_:
    """Return odom → base_link → camera; the camera's axes are those of a picture."""
    pose, (x, y, z) = sensors.T_odom_base, CAMERA_POSITION_M
    base = Transform_(Vector3_(pose.x_m, pose.y_m, 0.0), _about_z(pose.theta_rad))
    pitched = (0.0, math.sin(CAMERA_PITCH_RAD / 2), 0.0, math.cos(CAMERA_PITCH_RAD / 2))
    camera = Transform_(Vector3_(x, y, z), Quaternion_(*_product(pitched, _OPTICAL)))
    return TFMessage_(
        [
            TransformStamped_(header(stamp_s, ODOM_FRAME), BASE_FRAME, base),
            TransformStamped_(header(stamp_s, BASE_FRAME), CAMERA_FRAME, camera),
        ]
    )


def camera_info(width: int, height: int, stamp_s: float) -> CameraInfo_:
    """Return the intrinsics of the simulated lens: a pinhole without distortion."""
    focal_px = width / 2 / math.tan(CAMERA_HFOV_RAD / 2)
    cx, cy = width / 2, height / 2
    return CameraInfo_(
        header(stamp_s, CAMERA_FRAME),
        height,
        width,
        "plumb_bob",
        d=[0.0] * 5,
        k=[focal_px, 0.0, cx, 0.0, focal_px, cy, 0.0, 0.0, 1.0],
        r=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p=[focal_px, 0.0, cx, 0.0, 0.0, focal_px, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
        binning_x=0,
        binning_y=0,
        roi=RegionOfInterest_(0, 0, 0, 0, False),
    )


class Reports:
    """Publishers of the base: `messages` makes what is due. All are reliable, as a driver's default profile is."""

    def __init__(self, bus: Bus, rate_hz: int) -> None:
        """`rate_hz`: physics steps a second."""
        kinds: dict[str, Any] = {
            ODOMETRY_TOPIC: Odometry_,
            TF_TOPIC: TFMessage_,
            IMU_TOPIC: Imu_,
            BATTERY_TOPIC: BatteryState_,
        }
        self._writers = {topic: bus.writer(topic, kind) for topic, kind in kinds.items()}
        self._steps = {topic: max(1, rate_hz // hz) for topic, hz in RATES_HZ.items()}
        self.states = 0
        """Odometry reports sent."""

    def due(self, step: int) -> list[str]:
        """Return the topics that are due after this physics step."""
        return [topic for topic, every in self._steps.items() if step % every == 0]

    def messages(
        self, due: Sequence[str], sensors: Sensors, truth: CarterTruth, stamp_s: float
    ) -> Iterator[tuple[str, Any]]:
        """Yield these topics with their messages."""
        for topic in due:
            message: Any
            if topic == ODOMETRY_TOPIC:
                message = odometry(sensors, stamp_s)
                self.states += 1
            elif topic == TF_TOPIC:
                message = transforms(sensors, stamp_s)
            else:
                message = imu(sensors, truth, stamp_s) if topic == IMU_TOPIC else battery(sensors, stamp_s)
            yield topic, message

    def write(self, topic: str, message: Any) -> None:
        """Write one message. Raises a DDS error."""
        self._writers[topic].write(message)


def _about_z(angle_rad: float) -> Quaternion_:
    return Quaternion_(0.0, 0.0, math.sin(angle_rad / 2), math.cos(angle_rad / 2))


def _diagonal(size: int, variance: float) -> list[float]:
    return [variance if i % (size + 1) == 0 else 0.0 for i in range(size * size)]


def _product(a: Sequence[float], b: Sequence[float]) -> tuple[float, float, float, float]:
    """Return the product of two quaternions x, y, z, w."""
    (ax, ay, az, aw), (bx, by, bz, bw) = a, b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )
