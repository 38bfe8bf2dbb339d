"""Labels of the action expert: the next 5 s of poses, 0.1 s apart, in the robot frame.

A label is either the expert's driven path or its plan: 4 s, extended along the route. The plan is the label wherever
another source than the expert commanded within these 5 s.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.core.geometry import SE2
from sim_hil.benchmark.policies.expert_motion import STEP_S, Choice
from sim_hil.benchmark.policies.expert_route import SPACING_M
from tools.train.config.collect import RATE_HZ
from tools.train.drives.drive import EXPERT, FUTURE_STEPS

Array = NDArray[np.float64]

_ARRIVED_M: Final = 0.4  # distance to the route's end that counts as arrived
_STANDS_M: Final = 0.02  # a last step shorter than this counts as standing


def chosen_future(pose: SE2, choice: Choice, route: Array) -> Array:
    """Return the expert's plan at `pose`, extended along `route` ([n, 2] m, world): [50, 3] in the robot frame.

    Beyond the plan's end it keeps the plan's last speed and distance to the route; at the route's end it stands.
    """
    here = np.array(pose.as_tuple())
    plan = np.column_stack((choice.future, choice.headings_rad))
    known = np.vstack((here[None], plan))
    known[:, 2] = np.unwrap(known[:, 2])
    times = np.arange(len(known)) * STEP_S
    wanted = (np.arange(FUTURE_STEPS) + 1) / RATE_HZ
    on_plan = wanted <= times[-1] + 1e-9
    future = np.stack([np.interp(wanted, times, known[:, axis]) for axis in range(3)], axis=1)
    future[~on_plan] = _followed(known[-2], known[-1], wanted[~on_plan] - times[-1], route)
    # After arrival the robot stands: the plan, made for driving on, would turn on the spot.
    arrived = np.flatnonzero(np.hypot(*(future[:, :2] - route[-1]).T) < _ARRIVED_M)
    if len(arrived) and len(route) > 1:
        future[arrived[0] :] = future[arrived[0]]
    return relative(here, future)


def _followed(before: Array, end: Array, later_s: Array, route: Array) -> Array:
    """Return poses [n, 3] in the world `later_s` after `end`, along the route with the speed from `before` to `end`."""
    step = end[:2] - before[:2]
    ahead = float(step @ (np.cos(end[2]), np.sin(end[2])))
    still = np.repeat(end[None], len(later_s), axis=0)
    if ahead < _STANDS_M or len(route) < 2:
        return still
    gaps = np.hypot(route[:, 0] - end[0], route[:, 1] - end[1])
    nearest = int(np.argmin(gaps))
    along = np.arange(len(route)) * SPACING_M
    marks = np.minimum(nearest * SPACING_M + later_s * ahead / STEP_S, along[-1])
    on_way = np.stack([np.interp(marks, along, route[:, axis]) for axis in range(2)], axis=1)
    ways = np.diff(route, axis=0, append=2 * route[-1:] - route[-2:-1])
    turns = np.unwrap(np.arctan2(ways[:, 1], ways[:, 0]))
    # It keeps its lateral offset to the route and turns with the route.
    turned = np.interp(marks, along, turns) - turns[nearest]
    return np.column_stack((on_way + (end[:2] - route[nearest]), end[2] + turned))


def driven_future(pose: Array, k: int, last: int) -> Array:
    """Return poses [n, 3] of frames k + 1 to `last`, at most 50, in the robot frame at k.

    `pose` [N, 3]: all poses of the drive in the world.
    """
    return relative(pose[k], pose[k + 1 : min(k + FUTURE_STEPS, last) + 1])


def label_futures(pose: Array, chosen: Array, by: NDArray[np.uint8], *, goes_on: bool) -> tuple[Array, Array]:
    """Compute the labels of a whole drive: futures [N, 50, 3] and the number of known steps of each [N].

    `pose` [N, 3]: driven poses; `chosen` [N, 50, 3]: the expert's plan at each frame; `by` [N]: source of each command.
    Frames whose next 5 s were commanded by the expert take the driven path. At the drive's end the last plan continues
    it if `goes_on`, else the rest is unknown.
    """
    count = len(pose)
    futures = np.zeros((count, FUTURE_STEPS, 3))
    steps = np.full(count, FUTURE_STEPS)
    for k in range(count):
        if np.any(by[k : k + FUTURE_STEPS] != EXPERT):
            futures[k] = chosen[k]
            continue
        driven = driven_future(pose, k, count - 1)
        missing = FUTURE_STEPS - len(driven)
        futures[k, : len(driven)] = driven
        if missing and goes_on:
            futures[k, len(driven) :] = _seen_from(pose[k], pose[-1], chosen[-1, :missing])
        elif missing:
            steps[k] = len(driven)
            futures[k, len(driven) :] = driven[-1] if len(driven) else 0.0
    return futures, steps


def _seen_from(here: Array, there: Array, poses: Array) -> Array:
    """Transform poses [n, 3] from the frame of `there` to that of `here`; both are poses in the world."""
    c, s = np.cos(there[2]), np.sin(there[2])
    x = there[0] + c * poses[:, 0] - s * poses[:, 1]
    y = there[1] + s * poses[:, 0] + c * poses[:, 1]
    return relative(here, np.stack((x, y, there[2] + poses[:, 2]), axis=1))


def relative(origin: Array, poses: Array) -> Array:
    """Transform poses [n, 3] (x m, y m, theta rad) to the frame of `origin` [3], a pose in the same frame."""
    poses = np.asarray(poses, np.float64).reshape(-1, 3)
    c, s = np.cos(origin[2]), np.sin(origin[2])
    dx, dy = poses[:, 0] - origin[0], poses[:, 1] - origin[1]
    turned = (poses[:, 2] - origin[2] + np.pi) % (2 * np.pi) - np.pi
    return np.stack((c * dx + s * dy, c * dy - s * dx, turned), axis=1)
