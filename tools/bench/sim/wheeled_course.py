"""Floor with boxes, ramps and a Carter, for the benchmark and the tests of the wheeled base."""

from __future__ import annotations

import math
from pathlib import Path

from sim_hil.robots.bullet import pybullet
from sim_hil.robots.carter.body import Carter, CarterTruth
from sim_hil.robots.carter.drive import WheelCalibration
from tools.bench.sim.locomotion_runs import Vec3, add_box, open_physics


class World:
    """Floor with boxes, and a Carter at the origin."""

    def __init__(self, folder: Path, rate_hz: int = 240, calibration: WheelCalibration | None = None) -> None:
        """Build the world; `folder` is for files that are needed only here."""
        self.client, self.dt_s = open_physics(rate_hz), 1.0 / rate_hz
        self.box((0, 0, -0.5), (60, 60, 1))
        self.robot = Carter(self.client, folder, (0.0, 0.0, 0.0), self.dt_s, calibration=calibration)
        self.steps = 0

    def box(self, centre: Vec3, size: Vec3, pitch_rad: float = 0.0, grip: float = 0.9) -> None:
        """Add a solid box; `pitch_rad` rotates it about y."""
        add_box(self.client, centre, size, pitch_rad, grip)

    def ramp(self, start_x: float, degrees: float, length_m: float) -> None:
        """Add a ramp that rises along x from the floor at `start_x`."""
        a = math.radians(degrees)
        x, z = length_m / 2 * math.cos(a) + 0.5 * math.sin(a), length_m / 2 * math.sin(a) - 0.5 * math.cos(a)
        self.box((start_x + x, 0, z), (length_m, 6, 1), -a)

    def close(self) -> None:
        """Release the physics client."""
        pybullet.disconnect(physicsClientId=self.client)

    def run(self, seconds: float, v: float | None = None, w: float = 0.0) -> CarterTruth:
        """Advance the simulation, with a command every 0.1 s if `v` is given; returns the final truth."""
        for step in range(round(seconds / self.dt_s)):
            if v is not None and step % round(0.1 / self.dt_s) == 0:
                self.robot.command(v, 0.0, w)
            self.robot.drive()
            pybullet.stepSimulation(physicsClientId=self.client)
            self.robot.observe()
            self.steps += 1
        return self.truth()

    def truth(self) -> CarterTruth:
        """Return the current ground truth."""
        return self.robot.truth(self.steps * self.dt_s)

    def go(self) -> World:
        """Let the robot settle, then power it on."""
        self.run(0.2)
        self.robot.stand()
        return self


def forward_mps(truth: CarterTruth) -> float:
    """Return the speed along the heading, m/s."""
    heading = float(truth.rpy_rad[2])
    vx, vy, _ = truth.velocity_world_mps
    return float(math.cos(heading) * vx + math.sin(heading) * vy)
