"""Inputs of the parts: a Go2's states and the pictures of a camera that drives over a textured floor."""

from __future__ import annotations

import math
from functools import cache

import cv2
import numpy as np
import numpy.typing as npt

from firmware_bridge.unitree.messages.idl import IMUState_, PathPoint_, SportModeState_, TimeSpec_

WIDTH_PX, HEIGHT_PX = 320, 180
PICTURES = 64
"""Number of pictures before they repeat."""
_STEP_PX = 4
"""Shift of the texture between two pictures, px: some 5 cm on the floor."""
_STATE_PERIOD_NS = 20_000_000


def sport_state(number: int) -> SportModeState_:
    """Return the state of a robot on a circle; states are 20 ms apart."""
    t_s = number * _STATE_PERIOD_NS / 1e9
    theta = math.remainder(0.3 * t_s, math.tau)
    imu = IMUState_(
        [math.cos(theta / 2), 0.0, 0.0, math.sin(theta / 2)], [0.0, 0.0, 0.3], [0.0, 0.0, 9.8], [0.0, 0.0, theta], 40
    )
    seconds, nanoseconds = divmod(1_000_000_000 + number * _STATE_PERIOD_NS, 1_000_000_000)
    return SportModeState_(
        stamp=TimeSpec_(seconds, nanoseconds),
        error_code=0,
        imu_state=imu,
        mode=3,
        progress=0.0,
        gait_type=1,
        foot_raise_height=0.09,
        position=[math.sin(theta), 1.0 - math.cos(theta), 0.3],
        body_height=0.3,
        velocity=[0.3, 0.0, 0.0],
        yaw_speed=0.3,
        range_obstacle=[0.0] * 4,
        foot_force=[40 + number % 5] * 4,
        foot_position_body=[0.1] * 12,
        foot_speed_body=[0.0] * 12,
        path_point=[PathPoint_(*([0.0] * 7)) for _ in range(10)],
    )


@cache
def _texture() -> npt.NDArray[np.uint8]:
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 256, (HEIGHT_PX // 6, (WIDTH_PX + PICTURES * _STEP_PX) // 6, 3)).astype(np.uint8)
    size = (WIDTH_PX + PICTURES * _STEP_PX, HEIGHT_PX)
    return np.asarray(cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC), dtype=np.uint8)


@cache
def _jpeg(number: int) -> bytes:
    start = number * _STEP_PX
    picture = np.ascontiguousarray(_texture()[:, start : start + WIDTH_PX])
    return bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes())


def picture(number: int) -> bytes:
    """Return a picture as JPEG; the texture moves to and fro."""
    phase = number % (2 * PICTURES - 2)
    return _jpeg(min(phase, 2 * PICTURES - 2 - phase))
