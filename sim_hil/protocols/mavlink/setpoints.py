"""Setpoints of SET_POSITION_TARGET_LOCAL_NED and joystick inputs, converted to commands of a two-wheeled base.

In MAVLink's frames y points right, z points down and a positive yaw turns right; the base's positive yaw turns left.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, cos, hypot, isfinite, pi, sin
from typing import Final

from pymavlink.dialects.v20 import common

from edge.core.geometry import wrap_angle
from sim_hil.protocols.mavlink.wire import Message

LOCAL_FRAMES: Final = (common.MAV_FRAME_LOCAL_NED, common.MAV_FRAME_LOCAL_OFFSET_NED)
BODY_FRAMES: Final = (common.MAV_FRAME_BODY_NED, common.MAV_FRAME_BODY_OFFSET_NED, common.MAV_FRAME_BODY_FRD)
_IGNORE_POSITION: Final = 1 | 2 | 4
_IGNORE_VELOCITY: Final = 8 | 16
_IGNORE_ACCELERATION: Final = 64 | 128 | 256
_FORCE: Final = 512
_IGNORE_YAW: Final = 1024
_IGNORE_YAW_RATE: Final = 2048
# Our choice: an error of 1 rad commands 1.5 rad/s. The speed is the component of the velocity along the heading.
_YAW_GAIN_PER_S: Final = 1.5
_STILL_MPS: Final = 0.02


class SetpointError(ValueError):
    """A setpoint that the base cannot follow; the message fits a STATUSTEXT."""


@dataclass(frozen=True)
class Setpoint:
    """Velocity setpoint in the local frame (north, east) or the body frame (forward, right); at most one yaw input."""

    local: bool
    vx_mps: float
    vy_mps: float
    yaw_rad: float | None = None
    yaw_rate_radps: float | None = None

    def command(self, yaw_rad: float) -> tuple[float, float]:
        """Return speed (m/s, forward) and yaw rate (rad/s, left) for a base with yaw `yaw_rad` in the local frame."""
        ahead, direction = self.vx_mps, None
        if self.local:
            ahead = self.vx_mps * cos(yaw_rad) + self.vy_mps * sin(yaw_rad)
            if hypot(self.vx_mps, self.vy_mps) > _STILL_MPS:
                direction = atan2(self.vy_mps, self.vx_mps)
        if self.yaw_rate_radps is not None:
            return ahead, 0.0 - self.yaw_rate_radps  # avoids -0.0
        aim = direction if self.yaw_rad is None else self.yaw_rad
        if aim is None:
            return ahead, 0.0
        return ahead, -_YAW_GAIN_PER_S * wrap_angle(aim - yaw_rad)


def read_setpoint(message: Message) -> Setpoint:
    """Read a SET_POSITION_TARGET_LOCAL_NED. Raises SetpointError unless it is a velocity setpoint."""
    mask, frame = message.type_mask, message.coordinate_frame
    if frame not in LOCAL_FRAMES + BODY_FRAMES:
        raise SetpointError(f"setpoint: frame {frame}: expected one of {LOCAL_FRAMES + BODY_FRAMES}")
    if mask & _IGNORE_VELOCITY:
        raise SetpointError(f"setpoint: type mask {mask}: expected a velocity")
    if mask & _IGNORE_POSITION != _IGNORE_POSITION or mask & _IGNORE_ACCELERATION != _IGNORE_ACCELERATION:
        raise SetpointError(f"setpoint: type mask {mask}: no position, no acceleration")
    if mask & _FORCE:
        raise SetpointError(f"setpoint: type mask {mask}: no force")
    yaw = None if mask & _IGNORE_YAW else message.yaw
    rate = None if mask & _IGNORE_YAW_RATE else message.yaw_rate
    if not all(isfinite(value) for value in (message.vx, message.vy, yaw or 0.0, rate or 0.0)):
        raise SetpointError("setpoint: expected finite numbers")
    if rate is not None:
        yaw = None
    if frame in BODY_FRAMES and yaw is not None:
        raise SetpointError("setpoint: yaw in a body frame: expected a yaw rate")
    return Setpoint(frame in LOCAL_FRAMES, message.vx, message.vy, yaw, rate)


@dataclass(frozen=True)
class Sticks:
    """Position of both sticks, -1 to 1: forward and right."""

    ahead: float = 0.0
    right: float = 0.0

    def __post_init__(self) -> None:
        if not (-1.0 <= self.ahead <= 1.0 and -1.0 <= self.right <= 1.0):
            raise SetpointError(f"sticks: expected -1 to 1, found {self.ahead}, {self.right}")


def manual_sticks(message: Message) -> Sticks:
    """Read a MANUAL_CONTROL: x drives forward, r turns. Raises SetpointError."""
    x, r = (0 if value == 32767 else value for value in (message.x, message.r))  # 32767: no such axis
    return Sticks(x / 1000, r / 1000)


def override_sticks(message: Message) -> Sticks | None:
    """Read an RC_CHANNELS_OVERRIDE: channel 1 steering, 3 throttle, 1000..2000; None if both are released."""
    steering, throttle = message.chan1_raw, message.chan3_raw
    if all(value in (0, 65535) for value in (steering, throttle)):
        return None
    values = []
    for value in (throttle, steering):
        middle = 1500 if value in (0, 65535) else max(1000, min(2000, value))
        values.append((middle - 1500) / 500)
    return Sticks(values[0], values[1])


def heading_degrees(yaw_rad: float) -> float:
    """Convert a yaw to a compass heading: 0 to 360 degrees, clockwise from north."""
    return (yaw_rad * 180 / pi) % 360
