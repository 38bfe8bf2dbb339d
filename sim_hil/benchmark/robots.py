"""The benchmark's robots as planners see them."""

from __future__ import annotations

from sim_hil import carter_urdf, go2

_RADII_M = {"go2": go2.RADIUS_M, "carter": carter_urdf.RADIUS_M}


def footprint_m(robot: str) -> float:
    """Radius of the circle that a robot sweeps when it turns, m: the clearance of its shortest feasible path.

    Raises ValueError for an unknown robot.
    """
    if robot not in _RADII_M:
        raise ValueError(f"unknown robot {robot!r}, expected one of {', '.join(_RADII_M)}")
    return _RADII_M[robot]
