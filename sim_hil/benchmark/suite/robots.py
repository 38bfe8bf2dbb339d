"""The benchmark's robots as planners see them."""

from __future__ import annotations

from sim_hil.robots.carter import urdf as carter_urdf
from sim_hil.robots.go2 import body as go2
from sim_hil.scene.nav_grid import NavGrid
from sim_hil.scene.scene import Scene

_RADII_M = {"go2": go2.RADIUS_M, "carter": carter_urdf.RADIUS_M}
# Steps of the ground that are no obstacle: the Go2 takes the scenes' bumps of 5 cm, the base's casters do not.
_STEPS_M = {"go2": 0.06, "carter": 0.03}


TELLING_CLEARANCE_M = 0.4  # ways are told for a robot of this radius, which stops at any step, whatever robot drives


def footprint_m(robot: str) -> float:
    """Radius of the circle that a robot sweeps when it turns, m: the clearance of its shortest feasible path.

    Raises ValueError for an unknown robot.
    """
    return _of(robot, _RADII_M)


def max_step_m(robot: str) -> float:
    """Height of a step that the robot gets over, m: higher ones are edges to its shortest feasible path.

    Raises ValueError for an unknown robot.
    """
    return _of(robot, _STEPS_M)


def robot_grid(scene: Scene, robot: str) -> NavGrid:
    """The floor that is free for a robot; raises ValueError for an unknown one."""
    return NavGrid(scene, clearance_m=footprint_m(robot), max_step_m=max_step_m(robot))


def telling_grid(scene: Scene) -> NavGrid:
    """The floor by which ways are told: free for every robot."""
    return NavGrid(scene, clearance_m=TELLING_CLEARANCE_M, max_step_m=min(_STEPS_M.values()))


def _of(robot: str, values: dict[str, float]) -> float:
    if robot not in values:
        raise ValueError(f"unknown robot {robot!r}, expected one of {', '.join(values)}")
    return values[robot]
