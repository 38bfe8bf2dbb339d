"""Groups of two to four people who walk together: abreast where there is room, otherwise in single file."""

from __future__ import annotations

from math import pi

import numpy as np

from sim_hil.crowd.state import Activity, Array, Crowd
from sim_hil.crowd.walkable_map import CrowdMap

_SIZES, _SHARES = (1, 2, 3, 4), (0.80, 0.14, 0.04, 0.02)  # group sizes and their shares
# Positions of the followers ahead and to the left of the leader, m, for groups of two, three and four.
_ABREAST = {
    2: ((0.0, -0.75),),
    3: ((-0.1, -0.72), (-0.1, 0.72)),
    4: ((0.0, -0.75), (-0.95, 0.05), (-0.95, -0.75)),
}
_FILE_M = 0.85
_CIRCLE_M = {2: 0.42, 3: 0.52, 4: 0.62}
_LOST_M, _OWN_WAY_S = 3.5, 4.0
_WAIT_M, _WAIT_S = 2.0, 10.0  # leaders wait for followers further behind than this, for at most this time
_TICK_S = 0.1


class Groups:
    """Assignment of people to groups, fixed for a crowd's life; leaders precede their followers."""

    def __init__(self, crowd: Crowd, rng: np.random.Generator, *, alone: bool) -> None:
        self.size = np.ones(crowd.n, dtype=np.int64)
        person = 0
        while person < crowd.n:
            size = int(rng.choice(_SIZES, p=_SHARES))
            size = 1 if alone else min(size, crowd.n - person)
            members = np.arange(person, person + size)
            self.size[members] = size
            crowd.group[members] = person
            crowd.leader[members[1:]] = person
            crowd.place_in_group[members] = np.arange(size)
            if size > 1:
                # A group walks at the speed of its slowest member and keeps closer to the middle of its route.
                crowd.free_mps[members] = min(float(crowd.free_mps[members].min()), 1.15)
                crowd.lane_m[members] *= 0.5
            person += size
        self._followers = np.flatnonzero(crowd.leader >= 0)
        self._leaders = crowd.leader[self._followers]
        places = [_ABREAST[int(self.size[k])][int(crowd.place_in_group[k]) - 1] for k in self._followers]
        self._radius = np.array([_CIRCLE_M[int(self.size[k])] for k in self._followers])
        self._slots = np.array(places, dtype=np.float64).reshape(-1, 2)
        self._furthest, self._waited_s = np.zeros(crowd.n), np.zeros(crowd.n)
        self.settled = np.zeros(crowd.n, dtype=np.bool_)  # followers who stay in place while the others talk
        self.onward_s = np.zeros(crowd.n)  # time until which a follower walks alone, s
        self._c, self._s = np.cos(crowd.heading), np.sin(crowd.heading)  # direction of the leaders

    def patience(self) -> Array:
        """Return the share of their speed at which leaders walk [n], so that followers keep up."""
        return np.clip(1.75 - 0.5 * self._furthest, np.where(self._waited_s < _WAIT_S, 0.0, 0.35), 1.0)

    def set_preferred(self, crowd: Crowd, ways: CrowdMap, preferred_vx: Array, preferred_vy: Array) -> None:
        """Set the preferred velocities of followers: to their place beside the leader or in the talking circle."""
        who, lead = self._followers, self._leaders
        if not len(who):
            return
        crowd.activity[who] = Activity.FOLLOW
        x, y = crowd.x[who], crowd.y[who]
        self._bound(preferred_vx, preferred_vy)
        c, s = self._c[lead], self._s[lead]
        ahead, left = self._slots[:, 0], self._slots[:, 1]
        sx = crowd.x[lead] + c * ahead - s * left
        sy = crowd.y[lead] + s * ahead + c * left
        narrow = ways.gaps_at(sx, sy) < 0.42
        behind = -_FILE_M * crowd.place_in_group[who]
        sx = np.where(narrow, crowd.x[lead] + c * behind, sx)
        sy = np.where(narrow, crowd.y[lead] + s * behind, sy)

        talks = crowd.activity[lead] >= Activity.HOLD
        facing = np.where(talks, crowd.facing[lead], 0.0)
        radius = self._radius
        turn = facing + pi + 2 * pi * crowd.place_in_group[who] / self.size[who]
        middle_x = crowd.target_x[lead] + np.cos(facing) * radius
        middle_y = crowd.target_y[lead] + np.sin(facing) * radius
        sx = np.where(talks, middle_x + np.cos(turn) * radius, sx)
        sy = np.where(talks, middle_y + np.sin(turn) * radius, sy)

        dx, dy = sx - x, sy - y
        gap = np.sqrt(dx * dx + dy * dy) + 1e-9
        self._furthest[:] = 0.0
        np.maximum.at(self._furthest, lead, np.hypot(x - crowd.x[lead], y - crowd.y[lead]))
        self._waited_s = np.where(self._furthest > _WAIT_M, self._waited_s + _TICK_S, 0.0)
        lead_x, lead_y = np.where(talks, 0.0, crowd.vx[lead]), np.where(talks, 0.0, crowd.vy[lead])
        want_x, want_y = lead_x + 0.8 * dx, lead_y + 0.8 * dy
        # Out of sight or in front of the leader: follow the leader's route instead of the straight line.
        off_x, off_y = x - crowd.x[lead], y - crowd.y[lead]
        in_front = ~talks & (off_x * c + off_y * s > 0.2) & (np.abs(off_y * c - off_x * s) < 0.55)
        ahead_of_all = in_front & (off_x * off_x + off_y * off_y > _WAIT_M * _WAIT_M)
        in_front |= ~talks & (self.onward_s[who] > crowd.now_s)
        lost = np.flatnonzero((gap > _LOST_M) | in_front | ~ways.sees(x, y, sx, sy))
        self.settled[who] &= talks
        stays = self.settled[who]
        stays |= ahead_of_all & (self.onward_s[who] <= crowd.now_s)  # wait for the others
        want_x[stays] = want_y[stays] = 0.0
        lost = lost[~stays[lost]]
        if len(lost):
            tx, ty = ways.ahead(crowd.spot[lead[lost]], x[lost], y[lost])
            norm = np.hypot(tx - x[lost], ty - y[lost]) + 1e-9
            # A follower in front of the leader walks ahead instead of back through the leader.
            haste = np.where(in_front[lost], 0.6, 2.0) / norm
            want_x[lost], want_y[lost] = (tx - x[lost]) * haste, (ty - y[lost]) * haste
        want = np.sqrt(want_x * want_x + want_y * want_y) + 1e-9
        most = 1.3 * crowd.free_mps[who]
        pace = np.where(talks & (gap < 0.25), 0.0, np.minimum(want, most))
        pace = np.where(pace < 0.1, 0.0, pace)
        preferred_vx[who], preferred_vy[who] = want_x / want * pace, want_y / want * pace
        still = talks & ((gap < 0.6) | (pace == 0.0))
        crowd.facing[who] = np.where(still, np.arctan2(middle_y - y, middle_x - x), np.nan)
        crowd.gesture[who] = np.where(still, 1.0, 0.0)

    def lose_patience(self, crowd: Crowd, person: int) -> None:
        """Let a follower who cannot reach the group stay while it stands, and walk alone for a while when it walks."""
        self.settled[person] = True
        self.onward_s[person] = crowd.now_s + _OWN_WAY_S

    def _bound(self, preferred_vx: Array, preferred_vy: Array) -> None:
        """Turn the formations towards the leaders' preferred velocities, which may differ from their headings."""
        norm = np.sqrt(preferred_vx * preferred_vx + preferred_vy * preferred_vy)
        goes = norm > 0.1
        self._c[goes] += 0.15 * (preferred_vx[goes] / norm[goes] - self._c[goes])
        self._s[goes] += 0.15 * (preferred_vy[goes] / norm[goes] - self._s[goes])
        length = np.sqrt(self._c * self._c + self._s * self._s) + 1e-9
        self._c /= length
        self._s /= length
