"""A drive as imitation needs it beside tokens and semantic states: poses, labels, and how often a frame is drawn."""

from __future__ import annotations

from dataclasses import dataclass
from math import hypot
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.core.geometry import SE2
from tools.train.config.collect import RATE_HZ
from tools.train.config.imitate import WeightConfig
from tools.train.drives.drive import EXPERT, FUTURE_STEPS, POLICY_DRIVER, Drive
from tools.train.scenes.trace_sentences import NO_PEOPLE
from tools.train.scenes.walls import Walls

Array = NDArray[np.float64]

LEAST_KNOWN: Final = RATE_HZ  # steps: a label that ends before the controller's target, 1 s ahead, says too little
TURN_RAD: Final = 0.5
_LABEL_STEPS: Final = 30
_STANDS: Final = 0.1  # m/s and rad/s
_BACKS_OFF_M: Final = 0.05
_LEADS_M: Final = 0.3


class DriveFramesError(ValueError):
    """A network whose plans have no label; one line."""


@dataclass(frozen=True)
class DriveFrames:
    """What samples need of a drive, but for tokens and states; N frames."""

    id: str
    pose_odom: Array
    """[N, 3] x m, y m, theta rad."""
    way_m: Array
    """[N]: driven since the first frame, by odometry."""
    state: NDArray[np.float32]
    """[N, 3]."""
    goal: NDArray[np.float32]
    """[N, 2]: where the goal is, m in the robot's frame; for point-goal policies alone."""
    target: NDArray[np.float32]
    """[N, steps, 3]: the label; headings are not wrapped."""
    known: NDArray[np.int16]
    """[N]: steps of the label that are real."""
    weight: Array
    """[N]: chance to be drawn, not normalised; 0 where too little of the label is known."""
    walls: Walls | None = None
    """Around it; None where nobody asks for them or they are not known."""

    def __len__(self) -> int:
        return len(self.state)

    @property
    def stood(self) -> bool:
        """Whether the robot stands in its first frame, so that it may have stood there before."""
        return bool(hypot(*self.state[0, :2]) < _STANDS and abs(self.state[0, 2]) < _STANDS)

    @staticmethod
    def of(drive: Drive, steps: int, weights: WeightConfig, walls: Walls | None = None) -> DriveFrames:
        """Of a drive whose pictures need not be loaded. Raises DriveFramesError for more steps than a label has."""
        if not LEAST_KNOWN <= steps <= FUTURE_STEPS:
            raise DriveFramesError(f"action.steps: expected {LEAST_KNOWN} to {FUTURE_STEPS}, found {steps}")
        future = drive.future.astype(np.float64)
        # A pose's heading is within half a turn; a plan's is the sum of its steps and may go beyond.
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
        """The motion from frame `anchor` to frame k as odometry tells it, in the robot's frame at `anchor`."""
        T_odom_anchor, T_odom_base = (SE2(*map(float, self.pose_odom[i])) for i in (anchor, k))
        return T_odom_anchor.inverse() @ T_odom_base


def _never_backwards(future: Array) -> None:
    """Let labels stand, and turn as the expert turns, where it backs off: the controller cannot, in place.

    Told of a target behind it, it would turn towards that, which is as a rule away from where the expert turns.
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
    # Of the frames k .. k + 49; the 0 that was appended is what stands before frame 0.
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
    """[N]: frames before which the robot has stood for a second, and from which the label leads away within 3 s."""
    moves = np.append(0, np.cumsum((np.hypot(*state[:, :2].T) >= _STANDS) | (np.abs(state[:, 2]) >= _STANDS)))
    ks = np.arange(len(state))
    stood = (ks >= RATE_HZ) & (moves[ks + 1] == moves[np.maximum(ks - RATE_HZ, 0)])
    leads: NDArray[np.bool_] = np.hypot(*future[:, _LABEL_STEPS - 1, :2].T) >= _LEADS_M
    stuck: NDArray[np.bool_] = stood & (leads | (np.abs(future[:, _LABEL_STEPS - 1, 2]) > TURN_RAD))
    return stuck
