"""What the action expert learns to do from a frame on: 5 s of poses, 0.1 s apart, in the robot's frame.

Either what the expert then drove, or what it had chosen: its own plan of 4 s, followed on along the way. The latter is
the label wherever somebody else had a hand in what was driven.
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
from tools.train.drives.windows import relative

Array = NDArray[np.float64]

_ARRIVED_M: Final = 0.4  # of the way's end
_STANDS_M: Final = 0.02  # a last step of this length is standing


def chosen_future(pose: SE2, choice: Choice, route: Array) -> Array:
    """[50, 3] in the robot's frame at `pose`: the plan that was chosen there, then on along `route` ([n, 2] m, world).

    Beyond the plan's end it keeps the plan's last speed and distance to the way; at the way's end it stands.
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
    # Who has arrived stands: the plan, made to drive on, would turn on the spot there.
    arrived = np.flatnonzero(np.hypot(*(future[:, :2] - route[-1]).T) < _ARRIVED_M)
    if len(arrived) and len(route) > 1:
        future[arrived[0] :] = future[arrived[0]]
    return relative(here, future)


def _followed(before: Array, end: Array, later_s: Array, route: Array) -> Array:
    """[n, 3] in the world: where one is `later_s` after the pose `end`, going on along the way as since `before`."""
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
    # It keeps beside the way as it was, and turns as the way does.
    turned = np.interp(marks, along, turns) - turns[nearest]
    return np.column_stack((on_way + (end[:2] - route[nearest]), end[2] + turned))


def driven_future(pose: Array, k: int, last: int) -> Array:
    """[n, 3] in the robot's frame at k: the poses ([N, 3] in the world) of frames k + 1 up to `last`, 50 at most."""
    return relative(pose[k], pose[k + 1 : min(k + FUTURE_STEPS, last) + 1])


def label_futures(pose: Array, chosen: Array, by: NDArray[np.uint8], *, goes_on: bool) -> tuple[Array, Array]:
    """Labels of a whole drive: futures [N, 50, 3], and how many steps of each are known [N].

    `pose` [N, 3] driven; `chosen` [N, 50, 3] what the expert chose at each frame; `by` [N] who commanded. Frames whose
    next 5 s were all the expert's take what was driven; at the drive's end what it had chosen there goes on if
    `goes_on`, else the rest is not known.
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
    """[n, 3]: poses in the frame of `there`, a pose in the world, as seen from `here`."""
    c, s = np.cos(there[2]), np.sin(there[2])
    x = there[0] + c * poses[:, 0] - s * poses[:, 1]
    y = there[1] + s * poses[:, 0] + c * poses[:, 1]
    return relative(here, np.stack((x, y, there[2] + poses[:, 2]), axis=1))
