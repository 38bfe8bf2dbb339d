"""Roll and pitch from the IMU by a complementary filter of gyro and accelerometer. Pure."""

from __future__ import annotations

from math import atan2, cos, exp, hypot, sin, tan
from typing import Final

_TIME_CONSTANT_S: Final = 1.5  # our choice: longer than the base's acceleration phases


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
