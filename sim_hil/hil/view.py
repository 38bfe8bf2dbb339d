"""The live view of `edge-hil`: the simulated robot's camera, true pose, velocities, contacts and injected faults."""

from __future__ import annotations

import math
import time
from typing import Final

import numpy as np

from edge.core.geometry import SE2
from edge.flightlog.standard_messages import transforms, velocity
from edge.live.feed import LiveFeed
from sim_hil.protocols.front_end import FrontEnd, FrontEndOptions
from sim_hil.simulation.physics import Simulation

RATE_HZ: Final = 10
NEAR_M: Final = 10.0
"""Distance of people who are shown, m."""
_TOUCHES: Final = "touches "


class HilView:
    """Puts what the simulation knows into a live view; no method waits."""

    def __init__(self, feed: LiveFeed) -> None:
        """Take ownership of `feed`, which `close` closes."""
        self._feed = feed
        self._active: set[str] = set()

    def start(self, options: FrontEndOptions) -> None:
        """Name the robot and its world."""
        record = {"robot": f"simulated {options.robot}", "instruction": f"in {options.scene.name}", "mount": None}
        self._feed.put("/run", time.monotonic_ns(), record)

    def show(self, simulation: Simulation, front_end: FrontEnd) -> None:
        """Put the present state; call it RATE_HZ times a second."""
        now_ns, truth, people = time.monotonic_ns(), simulation.truth(), simulation.people()
        x_m, y_m, theta_rad = float(truth.position_m[0]), float(truth.position_m[1]), float(truth.rpy_rad[2])
        near = people[np.hypot(people[:, 0] - x_m, people[:, 1] - y_m) < NEAR_M]
        touching = sorted(simulation.touching)
        put = self._feed.put
        put("/truth", now_ns, {"pose": (x_m, y_m, theta_rad), "people": near, "touching": touching})
        cos, sin = math.cos(theta_rad), math.sin(theta_rad)
        vx, vy = (float(value) for value in truth.velocity_world_mps[:2])
        measured = (cos * vx + sin * vy, cos * vy - sin * vx, float(truth.gyro_radps[2]))
        put("/velocity", now_ns, velocity(simulation.commanded, measured))
        put("/tf", now_ns, transforms(now_ns, SE2(x_m, y_m, theta_rad), None))
        active = {f"injected {name}" for name in front_end.injected()} | {_TOUCHES + label for label in touching}
        if simulation.fell:
            active.add("fell")
        self._put_changes(now_ns, active)

    def close(self) -> None:
        """End the view."""
        self._feed.close()

    def _put_changes(self, now_ns: int, active: set[str]) -> None:
        for name in sorted(active ^ self._active):
            change = "raised" if name in active else "cleared"
            action = "LIMIT" if name.startswith("injected") else "ZERO"
            record = {"name": name, "row": None, "action": action, "change": change, "detail": "", "state": ""}
            self._feed.put("/fault", now_ns, record)
        self._active = active
