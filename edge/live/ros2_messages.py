"""A run's records as ROS 2 messages: odometry, transforms, pictures, plan, diagnostics, reasoning text, Δt. Pure.

Frames as in REP 105: `odom`; `base_link`, on the floor below the robot; `camera_optical`, z into the picture. Stamps
are of the computer's wall clock, as other nodes have them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple

from edge.core.geometry import SE2
from edge.flightlog.standard_messages import BASE, CAMERA, ODOM, Json, StandardMessages
from edge.safety.faults.row import Action
from edge.safety.faults.table import FAULTS
from firmware_bridge.ros2.messages.common import (
    Float64_,
    Header_,
    Point_,
    Pose_,
    PoseStamped_,
    PoseWithCovariance_,
    Quaternion_,
    String_,
    Time_,
    Transform_,
    TransformStamped_,
    Twist_,
    TwistWithCovariance_,
    Vector3_,
)
from firmware_bridge.ros2.messages.navigation import (
    DiagnosticArray_,
    DiagnosticStatus_,
    KeyValue_,
    Odometry_,
    Path_,
    TFMessage_,
)
from firmware_bridge.ros2.messages.sensors import CameraInfo_, CompressedImage_, RegionOfInterest_

KINDS: Final[Mapping[str, Any]] = {
    "odom": Odometry_,
    "tf": TFMessage_,
    "camera/image/compressed": CompressedImage_,
    "camera/camera_info": CameraInfo_,
    "plan": Path_,
    "diagnostics": DiagnosticArray_,
    "reasoning": String_,
    "delta_t": Float64_,
}
"""Type of every topic."""
FRAMES: Final = {ODOM: "odom", BASE: "base_link", CAMERA: "camera_optical"}
OK, WARN, ERROR, STALE = 0, 1, 2, 3
"""Levels of diagnostic_msgs/DiagnosticStatus."""
SILENT_NS: Final = 2_000_000_000
"""Age of the newest tick at which the run counts as stale."""
_NO_COVARIANCE: Final = [0.0] * 36
_MALFORMED: Final = (LookupError, TypeError, ValueError, AttributeError, OverflowError)
_NS_PER_S: Final = 1_000_000_000
_MAX_STAMP_NS: Final = (2**31) * _NS_PER_S - 1


class Published(NamedTuple):
    """One message and its topic, a key of KINDS."""

    topic: str
    message: Any


class Ros2Messages:
    """Builder of one run's messages; for one thread. `robot`: name for the diagnostics."""

    def __init__(self, robot: str) -> None:
        self._robot = robot
        self._standard = StandardMessages()
        self._calibration: Json | None = None
        self._newest: dict[str, tuple[int, Mapping[str, Any]]] = {}

    def of(self, topic: str, stamp_ns: int, record: Mapping[str, Any] | bytes, clock_ns: int) -> list[Published]:
        """Return the messages of a record; none for a malformed one.

        `stamp_ns`: monotonic; `clock_ns`: wall clock less monotonic clock, ns.
        """
        found: list[Published] = []
        try:
            for message in self._standard.of(topic, stamp_ns, record):
                if message.topic == "/camera/calibration":
                    self._calibration = message.payload
                elif message.topic == "/tf":
                    found.append(Published("tf", _transforms(message.payload, clock_ns)))
                elif message.topic == "/plan":
                    found.append(Published("plan", _path(message.payload, clock_ns)))
            if isinstance(record, bytes):
                return found + self._pictures(stamp_ns + clock_ns, record)
            self._newest[topic] = (stamp_ns, record)
            if topic == "/odometry" and record["pose"] is not None:
                found.append(Published("odom", odometry(record, stamp_ns + clock_ns)))
            elif topic == "/semantic":
                found.append(Published("reasoning", String_(_text(record["text"]))))
            elif topic == "/tick" and record["delay_s"] is not None:
                found.append(Published("delta_t", Float64_(float(record["delay_s"]))))
        except _MALFORMED:
            pass  # the other messages of the record are whole
        return found

    def diagnostics(self, now_ns: int, clock_ns: int) -> Published:
        """Return the state of the run, its power and its battery at `now_ns`, monotonic."""
        statuses = [self._driving(now_ns)]
        for name, topic in (("power", "/power"), ("battery", "/battery")):
            if topic in self._newest:
                statuses.append(self._status(name, OK, "", _numbers(self._newest[topic][1])))
        return Published("diagnostics", DiagnosticArray_(header(now_ns + clock_ns, ""), statuses))

    def _driving(self, now_ns: int) -> DiagnosticStatus_:
        stamp_ns, tick = self._newest.get("/tick", (0, {}))
        if now_ns - stamp_ns > SILENT_NS:
            return self._status("driving", STALE, "the run has no new tick", [])
        given = tick.get("active")
        active = [str(name) for name in given] if isinstance(given, list) else []
        level = max((_level(name) for name in active), default=OK)
        message = ", ".join(active) or str(tick.get("reason") or "driving")
        names = ("supervisor", "delay_s", "frame_age_ms", "duration_ms", "late_ms", "speed_scale", "generation")
        return self._status("driving", level, message, [(name, tick.get(name)) for name in names])

    def _status(self, name: str, level: int, message: str, values: Sequence[tuple[str, Any]]) -> DiagnosticStatus_:
        pairs = [KeyValue_(key, _text(value)) for key, value in values if value is not None]
        return DiagnosticStatus_(level, f"tic_vla: {name}", _text(message), self._robot, pairs)

    def _pictures(self, stamp_ns: int, jpeg: bytes) -> list[Published]:
        stamped = header(stamp_ns, FRAMES[CAMERA])
        found = [Published("camera/image/compressed", CompressedImage_(stamped, "jpeg", jpeg))]
        if self._calibration is not None:
            found.append(Published("camera/camera_info", _camera_info(self._calibration, stamped)))
        return found


def header(stamp_ns: int, frame: str) -> Header_:
    """Return a header with a stamp of the wall clock. Raises ValueError for one that a header cannot have."""
    if not 0 <= stamp_ns <= _MAX_STAMP_NS:
        raise ValueError(f"stamp: expected one of a ROS 2 header, found {stamp_ns}")
    return Header_(Time_(stamp_ns // _NS_PER_S, stamp_ns % _NS_PER_S), frame)


def odometry(record: Mapping[str, Any], stamp_ns: int) -> Odometry_:
    """Return the fused pose in `odom` and the robot's velocity in `base_link`; covariances are 0: not estimated."""
    pose = SE2(*(float(value) for value in record["pose"]))
    vx, vy, wz = (float(value) for value in record["velocity"])
    at = Pose_(Point_(pose.x_m, pose.y_m, 0.0), _turn(pose.theta_rad))
    speed = Twist_(Vector3_(vx, vy, 0.0), Vector3_(0.0, 0.0, wz))
    return Odometry_(
        header(stamp_ns, FRAMES[ODOM]),
        FRAMES[BASE],
        PoseWithCovariance_(at, _NO_COVARIANCE),
        TwistWithCovariance_(speed, _NO_COVARIANCE),
    )


def _transforms(content: Json, clock_ns: int) -> TFMessage_:
    return TFMessage_(
        [
            TransformStamped_(
                header(_stamp_ns(each) + clock_ns, FRAMES[each["parent_frame_id"]]),
                FRAMES[each["child_frame_id"]],
                Transform_(Vector3_(**each["translation"]), Quaternion_(**each["rotation"])),
            )
            for each in content["transforms"]
        ]
    )


def _path(content: Json, clock_ns: int) -> Path_:
    stamped = header(_stamp_ns(content) + clock_ns, FRAMES[content["frame_id"]])
    poses = [Pose_(Point_(**each["position"]), Quaternion_(**each["orientation"])) for each in content["poses"]]
    return Path_(stamped, [PoseStamped_(stamped, pose) for pose in poses])


def _camera_info(calibration: Json, stamped: Header_) -> CameraInfo_:
    return CameraInfo_(
        stamped,
        calibration["height"],
        calibration["width"],
        "plumb_bob",
        d=[0.0] * 5,
        k=calibration["K"],
        r=calibration["R"],
        p=calibration["P"],
        binning_x=0,
        binning_y=0,
        roi=RegionOfInterest_(0, 0, 0, 0, False),
    )


def _level(fault: str) -> int:
    known = FAULTS.get(fault)
    return WARN if known is not None and known.action is Action.LIMIT else ERROR


def _numbers(record: Mapping[str, Any]) -> list[tuple[str, Any]]:
    return [(key, value) for key, value in record.items() if isinstance(value, (int, float, str))]


def _stamp_ns(content: Json) -> int:
    return int(content["timestamp"]["sec"]) * _NS_PER_S + int(content["timestamp"]["nsec"])


def _turn(theta_rad: float) -> Quaternion_:
    return Quaternion_(0.0, 0.0, math.sin(theta_rad / 2), math.cos(theta_rad / 2))


def _text(value: object) -> str:
    """Return a value as text that the wire can carry: UTF-8, without the byte that ends a text."""
    return str(value).replace("\0", "").encode(errors="replace").decode()
