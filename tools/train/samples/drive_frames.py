"""A drive's data for imitation besides visual tokens and semantic states: poses, labels and weights of frames."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.core.geometry import SE2
from tools.train.config.checks import TrainError
from tools.train.config.collect import RATE_HZ
from tools.train.config.imitate import WeightConfig
from tools.train.drives.drive import EXPERT, FUTURE_STEPS, POLICY_DRIVER, Drive
from tools.train.drives.trace_sentences import NO_PEOPLE
from tools.train.drives.walls import Walls

Array = NDArray[np.float64]

LEAST_KNOWN: Final = RATE_HZ  # fewest known steps of a usable label: up to the controller's target 1 s ahead
TURN_RAD: Final = 0.5  # heading change within 3 s above which a label counts as a turn
_LABEL_STEPS: Final = 30  # steps of a label that its weight depends on
_STANDS: Final = 0.1  # speed, m/s, and yaw rate, rad/s, below which the robot stands
_BACKS_OFF_M: Final = 0.05  # distance behind the robot above which a label moves backwards
_LEADS_M: Final = 0.3  # distance in 3 s above which a label leaves a standing position


@dataclass(frozen=True)
class DriveFrames:
    """A drive's N frames for imitation."""

    id: str
    pose_odom: Array
    """[N, 3] x m, y m, theta rad."""
    way_m: Array
    """[N]: distance driven since the first frame, from odometry."""
    state: NDArray[np.float32]
    """[N, 3] vx m/s, vy m/s, wz rad/s."""
    goal: NDArray[np.float32]
    """[N, 2]: goal, m in the robot frame; for point-goal policies alone."""
    target: NDArray[np.float32]
    """[N, steps, 3]: labels x m, y m, theta rad; headings are not wrapped."""
    known: NDArray[np.int16]
    """[N]: number of known steps of the label."""
    weight: Array
    """[N]: relative probability of drawing the frame; 0 if too few steps of the label are known."""
    walls: Walls | None = None
    """Walls along the drive; None if they are not used or not known."""
    in_mirror: bool = False
    """Whether tokens and states are those of the mirrored drive."""

    def __len__(self) -> int:
        return len(self.state)

    @property
    def stood(self) -> bool:
        """Whether the robot stands in the first frame, so that it may have stood there before."""
        return bool(hypot(*self.state[0, :2]) < _STANDS and abs(self.state[0, 2]) < _STANDS)

    @staticmethod
    def of(drive: Drive, steps: int, weights: WeightConfig, walls: Walls | None = None) -> DriveFrames:
        """Build the frames of a drive; its images are not needed. Raises TrainError for too many steps."""
        if not LEAST_KNOWN <= steps <= FUTURE_STEPS:
            raise TrainError(f"action.steps: expected {LEAST_KNOWN} to {FUTURE_STEPS}, found {steps}")
        future = drive.future.astype(np.float64)
        # A pose's heading is wrapped; a plan's heading is the sum of its steps and is not.
        start = np.zeros((len(drive), 1))
        future[..., 2] = np.unwrap(np.concatenate([start, future[..., 2]], axis=1), axis=1)[:, 1:]
        _never_backwards(future)
        moved = np.hypot(*np.diff(drive.pose_odom[:, :2], axis=0, prepend=drive.pose_odom[:1, :2]).T)
        away = np.array(drive.about.goal_xy) - drive.pose[:, :2]
        c, s = np.cos(drive.pose[:, 2]), np.sin(drive.pose[:, 2])
        goal = np.stack([c * away[:, 0] + s * away[:, 1], c * away[:, 1] - s * away[:, 0]], axis=1)
        return DriveFrames(
            id=drive.id,
            pose_odom=drive.pose_odom,
            way_m=np.cumsum(moved),
            state=drive.state,
            goal=goal.astype(np.float32),
            target=future[:, :steps].astype(np.float32),
            known=drive.future_steps,
            weight=_weights(drive, future, goal, weights),
            walls=walls,
        )

    def offset(self, anchor: int, k: int) -> SE2:
        """Return the odometry's motion from frame `anchor` to frame k, in the robot frame at `anchor`."""
        T_odom_anchor, T_odom_base = (SE2(*map(float, self.pose_odom[i])) for i in (anchor, k))
        return T_odom_anchor.inverse() @ T_odom_base


def _never_backwards(future: Array) -> None:
    """Replace labels that move backwards by turning on the spot, in place: the controller cannot drive backwards.

    With a target behind it, the controller would turn to it, which is usually away from where the expert turns.
    """
    x, y = future[:, LEAST_KNOWN - 1, :2].T
    future[(x < 0) & (np.hypot(x, y) >= _BACKS_OFF_M), :, :2] = 0.0


def _weights(drive: Drive, future: Array, goal: Array, config: WeightConfig) -> Array:
    known = np.arange(_LABEL_STEPS) < drive.future_steps[:, None]
    turns = np.max(np.abs(future[:, :_LABEL_STEPS, 2]) * known, axis=1) > TURN_RAD
    near = np.hypot(*goal.T) < config.goal_m
    people = np.zeros(len(drive), bool)
    for k in range(len(drive)):
        trace = drive.trace_at(k)
        people[k] = trace is not None and trace["motion"] != NO_PEOPLE
    others = np.append(np.cumsum(drive.by != EXPERT), 0)
    until = np.minimum(np.arange(len(drive)) + FUTURE_STEPS, len(drive)) - 1
    # Counts over frames k to k + 49; the appended 0 is the count before frame 0.
    led_back = others[until] > others[np.arange(len(drive)) - 1]
    weight = np.ones(len(drive))
    for holds, factor in (
        (turns, config.turn),
        (people, config.people),
        (near, config.goal),
        (led_back, config.recovery),
        (drive.about.driver.startswith(POLICY_DRIVER), config.policy),
        (_stuck(drive.state, future), config.stuck),
    ):
        weight[np.broadcast_to(holds, weight.shape)] *= factor
    weight[drive.future_steps < LEAST_KNOWN] = 0.0
    return weight


def _stuck(state: NDArray[np.float32], future: Array) -> NDArray[np.bool_]:
    """Return the frames [N] after 1 s of standing from which the label leads away within 3 s."""
    moves = np.append(0, np.cumsum((np.hypot(*state[:, :2].T) >= _STANDS) | (np.abs(state[:, 2]) >= _STANDS)))
    ks = np.arange(len(state))
    stood = (ks >= RATE_HZ) & (moves[ks + 1] == moves[np.maximum(ks - RATE_HZ, 0)])
    leads: NDArray[np.bool_] = np.hypot(*future[:, _LABEL_STEPS - 1, :2].T) >= _LEADS_M
    stuck: NDArray[np.bool_] = stood & (leads | (np.abs(future[:, _LABEL_STEPS - 1, 2]) > TURN_RAD))
    return stuck
