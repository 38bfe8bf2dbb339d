"""State of a crowd as arrays with one entry per person."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]


class Activity:
    """Activities of a person; plain integers, because arrays of them are compared often."""

    WALK: Final = 0  # walking to a spot
    FOLLOW: Final = 1  # following the leader of a group
    HOLD: Final = 2  # standing at a spot: looking, talking, on the phone
    QUEUE: Final = 3  # in a queue
    SIT: Final = 4  # sitting, sitting down or getting up


class Crowd:
    """State of n people: positions m, velocities m/s, headings rad; traits are drawn once from `rng`."""

    def __init__(self, n: int, rng: np.random.Generator) -> None:
        self.n = n
        self.now_s = 0.0
        self.x, self.y, self.vx, self.vy = (np.zeros(n) for _ in range(4))
        self.chosen_vx, self.chosen_vy = np.zeros(n), np.zeros(n)  # the chosen velocity, m/s
        self.meet_s = np.full(n, 1e3)  # time to collision at that velocity, s
        self.heading, self.facing = np.zeros(n), np.full(n, np.nan)  # facing: desired heading while standing
        self.phase, self.swing = rng.uniform(0.0, 1.0, n), np.zeros(n)
        self.sitting, self.gesture = np.zeros(n), np.zeros(n)

        # Traits: free walking speed of adults, 1.2 +- 0.2 m/s indoors; patience, attention and habits differ.
        self.free_mps = np.clip(rng.normal(1.18, 0.17, n), 0.75, 1.55)
        self.patience_s = rng.uniform(2.5, 6.0, n)
        self.inattentive = rng.uniform(0.0, 1.0, n) < 0.12  # eyes on the phone while walking
        self.free_mps[self.inattentive] *= 0.85
        self.reaction_s = rng.uniform(0.25, 0.6, n) + np.where(self.inattentive, 0.3, 0.0)
        self.sight_m = np.where(self.inattentive, rng.uniform(1.6, 2.4, n), rng.uniform(5.0, 9.0, n))
        self.sight_cos = np.cos(np.where(self.inattentive, np.radians(40.0), np.radians(95.0)))
        self.personal_m = rng.uniform(0.85, 1.1, n)  # preferred distance from the robot's body axis
        self.lane_m = np.clip(rng.normal(0.30, 0.15, n), 0.0, 0.6)  # preferred offset to the right of the route
        self.stride = rng.uniform(0.94, 1.06, n)

        self.activity = np.zeros(n, dtype=np.int64)
        self.spot = np.full(n, -1, dtype=np.int64)  # current destination
        self.target_x, self.target_y = np.zeros(n), np.zeros(n)
        self.preferred_vx, self.preferred_vy = np.zeros(n), np.zeros(n)  # velocity without others, m/s; 0: stands
        self.until_s = np.zeros(n)
        self.leader = np.full(n, -1, dtype=np.int64)
        self.group = np.arange(n, dtype=np.int64)
        self.place_in_group = np.zeros(n, dtype=np.int64)
        self.anchor_x, self.anchor_y = np.zeros(n), np.zeros(n)  # position at the last progress
        self.blocked_s = np.zeros(n)  # time since then in which the person tried to move, s
        self.stuck_s, self.squeeze_s = np.zeros(n), np.zeros(n)

        self.seen_s, self.lost_s = np.zeros(n), np.zeros(n)
        self.aware = np.zeros(n, dtype=np.bool_)
