"""Interface of simulated robots: a body that follows velocity commands and reports its ground truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class BaseTruth:
    """Ground truth of one instant that every robot has; the base frame is x forward, y left, z up.

    velocity [3] in the world frame; gyro [3] and accel [3] in the body frame, accel as an IMU measures it (9.81 up at
    rest); rpy [3] is roll, pitch, heading; `commanded` is the velocity in force: vx m/s, vy m/s, wz rad/s.
    """

    time_s: float
    position_m: Array
    quaternion_wxyz: Array
    rpy_rad: Array
    velocity_world_mps: Array
    gyro_radps: Array
    accel_mps2: Array
    commanded: tuple[float, float, float]


class Robot(Protocol):
    """One robot in one physics client: `drive()` right before every stepSimulation, `observe()` right after it."""

    @property
    def body(self) -> int:
        """PyBullet's id of the body."""

    @property
    def radius_m(self) -> float:
        """Radius of the circle that the robot covers when it turns in place, m; for planners."""

    @property
    def ready(self) -> bool:
        """Whether the robot would follow a velocity command now."""

    def drive(self) -> None:
        """Set the motors for the step that follows."""

    def observe(self) -> None:
        """Read the body after a step."""

    def pose(self) -> tuple[tuple[float, float, float], float]:
        """Base position, m, and heading, rad."""

    def up(self) -> float:
        """World z of the base's up axis: 1 upright, -1 on its back."""

    def command(self, vx_mps: float, vy_mps: float, wz_radps: float) -> None:
        """Command a velocity in the body frame for 1 s; a base that cannot move sideways ignores `vy_mps`."""

    def stand(self) -> None:
        """Get ready to move, as its controller would; takes simulated time, see `ready`. May be repeated."""

    def truth(self, time_s: float) -> BaseTruth:
        """Return the current ground truth, stamped `time_s`."""

    def render_state(self) -> tuple[float, ...]:
        """Return base position, m, quaternion xyzw, and the joint angles that a renderer needs."""
