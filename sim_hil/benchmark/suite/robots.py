"""Planner parameters of the benchmark's robots: radius and maximum step height."""

from __future__ import annotations

from sim_hil.robots.carter import urdf as carter_urdf
from sim_hil.robots.go2 import body as go2
from sim_hil.scene.nav_grid import NavGrid
from sim_hil.scene.scene import Scene

_RADII_M = {"go2": go2.RADIUS_M, "carter": carter_urdf.RADIUS_M}
# Height of a step that is no obstacle, m: the Go2 climbs the bumps of 5 cm in the scenes, the casters of Carter cannot.
_STEPS_M = {"go2": 0.06, "carter": 0.03}
ROUTE_CLEARANCE_M = 0.4  # robot radius for which routes are described, whichever robot drives


def footprint_m(robot: str) -> float:
    """Return the radius of the circle that a robot sweeps when it turns, m: the clearance of its shortest path."""
    return _RADII_M[robot]


def max_step_m(robot: str) -> float:
    """Return the height of a step that the robot can climb, m; higher steps are obstacles."""
    return _STEPS_M[robot]


def robot_grid(scene: Scene, robot: str) -> NavGrid:
    """Return the navigation grid of a scene for a robot."""
    return NavGrid(scene, clearance_m=footprint_m(robot), max_step_m=max_step_m(robot))


def route_grid(scene: Scene) -> NavGrid:
    """Return the navigation grid for describing routes: its free cells are free for every robot."""
    return NavGrid(scene, clearance_m=ROUTE_CLEARANCE_M, max_step_m=min(_STEPS_M.values()))
