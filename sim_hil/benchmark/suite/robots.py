"""Planner parameters of the benchmark's robots: radius and maximum step height."""

from __future__ import annotations

from math import degrees

from sim_hil.robots.carter import body as carter
from sim_hil.robots.carter import urdf as carter_urdf
from sim_hil.robots.go2 import body as go2
from sim_hil.scene.nav_grid import NavGrid
from sim_hil.scene.scene import Scene

_RADII_M = {"go2": go2.RADIUS_M, "carter": carter_urdf.RADIUS_M}
# Height of a step that is no obstacle, m: the Go2 climbs the bumps of 5 cm in the scenes, the casters of Carter cannot.
_STEPS_M = {"go2": 0.06, "carter": 0.03}
ROUTE_CLEARANCE_M = 0.4  # robot radius for which routes are described, whichever robot drives


def camera_mount(robot: str) -> dict[str, float] | None:
    """Return a robot's camera mount with the keys of [mount]; None for the Go2, whose robot file has it."""
    if robot != "carter":
        return None
    forward_m, _, height_m = carter.CAMERA_POSITION_M
    pitch_deg, hfov_deg = degrees(carter.CAMERA_PITCH_RAD), degrees(carter.CAMERA_HFOV_RAD)
    return {"hfov_deg": hfov_deg, "height_m": height_m, "pitch_deg": pitch_deg, "forward_m": forward_m}


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
