"""Samples of imitation under delay (paper, Algorithm 1): a frame, an older semantic state, and how far apart they are.

Frame k is drawn by weight, the age Δt from its distribution, and the state is that of frame k - 10 Δt: one that has a
state, so that Δt and the motion offset are exact. Before a drive's first frame the robot stood there: an age that
reaches beyond it meets the first state, as every instruction's first generation does. Frames that act on one state are
drawn together, because they share its keys and values.

A sample's inputs are of frame k and before; only its label is of the future.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from math import hypot, radians
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.geometry import SE2
from edge.guidance import waypoints_now
from edge.reasoning_text import Waypoints
from export.model.config import TicVlaConfig
from tools.train.action_batch import Group
from tools.train.delays import Delays
from tools.train.drive import EXPERT, FUTURE_STEPS, RATE_HZ, Drive
from tools.train.kv_cache import CachedState, KvCache
from tools.train.language_batch import FrameTokens
from tools.train.trace_words import NOBODY

Array = NDArray[np.float64]

LEAST_KNOWN: Final = RATE_HZ  # steps: a label that ends before the controller's target, 1 s ahead, says too little
TURN_RAD: Final = 0.5
_LABEL_STEPS: Final = 30
_STANDS: Final = 0.1  # m/s and rad/s


class SampleError(ValueError):
    """Drives that give no samples, or a network that cannot learn from them; one line."""


@dataclass(frozen=True)
class WeightConfig:
    """How often frames are drawn, as factors on an ordinary one's chance; those that hold are multiplied."""

    turn: float = 2.0
    """Its label turns by more than 0.5 rad within 3 s."""
    people: float = 2.0
    """Somebody is in view within 6 m."""
    goal: float = 2.0
    goal_m: float = 4.0
    """The goal is nearer than this."""
    recovery: float = 1.5
    """Something other than the expert commands within the next 5 s, so that the label leads back."""
    policy: float = 1.0
    """Its drive is a policy's (DAgger)."""

    def __post_init__(self) -> None:
        factors = (self.turn, self.people, self.goal, self.recovery, self.policy)
        if not all(0 < factor <= 100 for factor in factors) or not 0 <= self.goal_m <= 100:
            raise ValueError("expected factors above 0, up to 100, and goal_m from 0 to 100")


@dataclass(frozen=True)
class SampleConfig:
    """What a sample is made of beside its frame."""

    group: int = 4
    """Frames that act on one state and share its keys and values: fewer vary more, more are faster."""
    reasoning: bool = True
    """False: states end with their prompt, as those of a model that says nothing."""
    cut_text: float = 0.1
    """Share of states whose text ends early: a power budget may cut it at any token."""
    standing_start: float = 0.5
    """Chance of an age that reaches beyond the drive's first frame, as a factor on that of any other age."""
    offset_noise_m_per_m: float = 0.02
    """Of the motion offset, in m for each metre driven since the state, one standard deviation (paper, Table 14)."""
    offset_noise_deg_per_m: float = 1.0
    weights: WeightConfig = field(default_factory=WeightConfig)

    def __post_init__(self) -> None:
        if not 1 <= self.group <= 64:
            raise ValueError(f"group: expected 1 to 64 frames, found {self.group}")
        if not (0 <= self.cut_text <= 1 and 0 <= self.standing_start <= 1):
            raise ValueError("expected cut_text and standing_start from 0 to 1")
        if not (0 <= self.offset_noise_m_per_m <= 1 and 0 <= self.offset_noise_deg_per_m <= 90):
            raise ValueError("expected offset_noise_m_per_m from 0 to 1 and offset_noise_deg_per_m from 0 to 90")

    def undisturbed(self) -> SampleConfig:
        """The same with every frame alike, every age exact and nothing disturbed: what is evaluated on."""
        even = WeightConfig(turn=1.0, people=1.0, goal=1.0, recovery=1.0)
        return replace(
            self, cut_text=0.0, standing_start=0.0, offset_noise_m_per_m=0.0, offset_noise_deg_per_m=0.0, weights=even
        )


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

    def __len__(self) -> int:
        return len(self.state)

    @property
    def stood(self) -> bool:
        """Whether the robot stands in its first frame, so that it may have stood there before."""
        return bool(hypot(*self.state[0, :2]) < _STANDS and abs(self.state[0, 2]) < _STANDS)

    @staticmethod
    def of(drive: Drive, steps: int, weights: WeightConfig) -> DriveFrames:
        """Of a drive whose pictures need not be loaded. Raises SampleError for more steps than a label has."""
        if not LEAST_KNOWN <= steps <= FUTURE_STEPS:
            raise SampleError(f"action.steps: expected {LEAST_KNOWN} to {FUTURE_STEPS}, found {steps}")
        future = drive.future.astype(np.float64)
        # A pose's heading is within half a turn; a plan's is the sum of its steps and may go beyond.
        start = np.zeros((len(drive), 1))
        future[..., 2] = np.unwrap(np.concatenate([start, future[..., 2]], axis=1), axis=1)[:, 1:]
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
        )

    def offset(self, anchor: int, k: int) -> SE2:
        """The motion from frame `anchor` to frame k as odometry tells it, in the robot's frame at `anchor`."""
        T_odom_anchor, T_odom_base = (SE2(*map(float, self.pose_odom[i])) for i in (anchor, k))
        return T_odom_anchor.inverse() @ T_odom_base


def _weights(drive: Drive, future: Array, goal: Array, config: WeightConfig) -> Array:
    known = np.arange(_LABEL_STEPS) < drive.future_steps[:, None]
    turns = np.max(np.abs(future[:, :_LABEL_STEPS, 2]) * known, axis=1) > TURN_RAD
    near = np.hypot(*goal.T) < config.goal_m
    people = np.zeros(len(drive), bool)
    for k in range(len(drive)):
        trace = drive.trace_at(k)
        people[k] = trace is not None and trace["motion"] != NOBODY
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
        (drive.about.driver.startswith("policy:"), config.policy),
    ):
        weight[np.broadcast_to(holds, weight.shape)] *= factor
    weight[drive.future_steps < LEAST_KNOWN] = 0.0
    return weight


@dataclass(frozen=True)
class Chosen:
    """Frames `ks` of drive number `drive` that act on the state of frame `anchor`, `ages` tenths of a second old."""

    drive: int
    anchor: int
    ks: tuple[int, ...]
    ages: tuple[int, ...]


class Samples:
    """Draws groups of samples; all that is random comes from the generator that is given, and in a fixed order."""

    def __init__(
        self,
        drives: Iterable[DriveFrames],
        tokens: FrameTokens,
        cache: KvCache,
        delays: Delays,
        config: SampleConfig,
        model: TicVlaConfig,
        *,
        drop: bool = True,
    ) -> None:
        """`drop`: with the network's dropouts of K‖V and state. Raises SampleError where there is nothing to draw."""
        if round(model.action.step_s * RATE_HZ, 6) != 1:
            raise SampleError(f"action.step_s: labels are 0.1 s apart, found {model.action.step_s:g}")
        self.drives = tuple(drives)
        self.config = config
        self._tokens, self._cache, self._delays = tokens, cache, delays
        self._by_waypoints = model.action.semantic_interface == "waypoints"
        self._drop_kv, self._drop_state = (model.action.kv_dropout, model.action.state_dropout) if drop else (0.0, 0.0)
        # Frames of one state that are all the same age are all the same frame.
        self.group = config.group if np.count_nonzero(delays.mass) > 1 else 1
        self._share: list[Array] = []
        places: list[tuple[int, int, bool]] = []
        chances: list[float] = []
        for index, drive in enumerate(self.drives):
            share, of_anchor, standing = self._chances(drive)
            self._share.append(share)
            for anchor, chance in of_anchor.items():
                places.append((index, anchor, False))
                chances.append(chance)
            if standing > 0:
                places.append((index, 0, True))
                chances.append(standing)
        self._places = places
        self._upto = np.cumsum(chances)
        if not chances or self._upto[-1] <= 0:
            raise SampleError("no frame has both a label and a semantic state that is as old as it should be")

    def _anchors(self, drive_id: str) -> tuple[int, ...]:
        """Frames with states that can guide: a text without waypoints cannot, where they are the guidance."""
        anchors = self._cache.anchors(drive_id)
        if not self._by_waypoints:
            return anchors
        draws = range(self._cache.draws)
        return tuple(
            k for k in anchors if all(self._cache.at(drive_id, k, draw).waypoints is not None for draw in draws)
        )

    def _chances(self, drive: DriveFrames) -> tuple[Array, dict[int, float], float]:
        """Each frame's weight by all chances to meet a state of it; chance of each state; that of standing starts."""
        mass, beyond = self._delays.mass, self._delays.beyond
        anchors = self._anchors(drive.id)
        if not anchors:
            return np.zeros(len(drive)), {}, 0.0
        # One state stands for as many tenths of a second as there are up to the next one.
        every = anchors[1] - anchors[0] if len(anchors) > 1 else RATE_HZ
        met = np.zeros(len(drive))
        for anchor in anchors:
            span = met[anchor : anchor + len(mass)]
            span += every * mass[: len(span)]
        standing = np.zeros(len(drive))
        if drive.stood and anchors[0] == 0:
            upto = min(len(beyond), len(drive))
            standing[:upto] = self.config.standing_start * beyond[:upto]
        whole = met + standing
        share = np.divide(drive.weight, whole, out=np.zeros(len(drive)), where=whole > 0)
        of_anchor: dict[int, float] = {}
        for anchor in anchors:
            span = share[anchor : anchor + len(mass)]
            of_anchor[anchor] = float(every * (span @ mass[: len(span)]))
        return share, of_anchor, float(share @ standing)

    def choose(self, rng: np.random.Generator) -> Chosen:
        """A state by its chance, then frames that act on it by theirs."""
        index, anchor, stood = self._places[_pick(self._upto, rng.uniform())]
        share, mass, beyond = self._share[index], self._delays.mass, self._delays.beyond
        if not stood:
            span = share[anchor : anchor + len(mass)]
            upto = np.cumsum(span * mass[: len(span)])
            ages = [_pick(upto, u) for u in rng.uniform(size=self.group)]
            return Chosen(index, anchor, tuple(anchor + age for age in ages), tuple(ages))
        span = share[: len(beyond)]
        upto = np.cumsum(span * beyond[: len(span)])
        ks = [_pick(upto, u) for u in rng.uniform(size=self.group)]
        older = [
            k + 1 + _pick(np.cumsum(mass[k + 1 :]), u) for k, u in zip(ks, rng.uniform(size=self.group), strict=True)
        ]
        return Chosen(index, 0, tuple(ks), tuple(older))

    def take(self, chosen: Chosen, rng: np.random.Generator) -> Group:
        """What the network is given of a choice, and the labels."""
        drive, count = self.drives[chosen.drive], len(chosen.ks)
        which, cut, end = rng.uniform(size=3)
        noise = rng.standard_normal((count, 3))
        keep_state = rng.uniform(size=count) >= self._drop_state
        state = self._cache.at(drive.id, chosen.anchor, int(which * self._cache.draws))
        ks = list(chosen.ks)
        offsets = [self._offset(drive, chosen.anchor, k, row) for k, row in zip(ks, noise, strict=True)]
        latency = [(age / RATE_HZ, *offset.as_tuple()) for age, offset in zip(chosen.ages, offsets, strict=True)]
        if self._by_waypoints:
            guidance = self._waypoints(state, offsets)
            keep = np.ones(guidance.shape[:2], bool)
        else:
            rows = state.kv[: self._length(state, cut, end)]
            guidance = np.array(rows)[None]
            keep = rng.uniform(size=guidance.shape[:2]) >= self._drop_kv
        frames = self._tokens.frames(drive.id)
        return Group(
            visual_tokens=np.stack([frames[k] for k in ks]),
            state=drive.state[ks],
            latency=np.array(latency, np.float32),
            guidance=guidance,
            goal=drive.goal[ks],
            keep_guidance=keep,
            keep_state=keep_state,
            target=drive.target[ks],
            known=np.arange(drive.target.shape[1]) < drive.known[ks][:, None],
        )

    def said(self, chosen: Chosen) -> Waypoints | None:
        """Waypoints of the state that a choice acts on, m in the anchor's robot frame; None where it has none."""
        return self._cache.at(self.drives[chosen.drive].id, chosen.anchor).waypoints

    def draw(self, rng: np.random.Generator) -> Group:
        """Choose and take."""
        return self.take(self.choose(rng), rng)

    def _length(self, state: CachedState, cut: float, end: float) -> int:
        """Tokens of a state that the policy is given."""
        said = len(state.kv) - state.prompt_tokens
        if not self.config.reasoning:
            return state.prompt_tokens
        return state.prompt_tokens + (int(end * (said + 1)) if cut < self.config.cut_text else said)

    def _offset(self, drive: DriveFrames, anchor: int, k: int, noise: Array) -> SE2:
        way_m = float(drive.way_m[k] - drive.way_m[anchor])
        shift, turn = self.config.offset_noise_m_per_m * way_m, radians(self.config.offset_noise_deg_per_m) * way_m
        exact = drive.offset(anchor, k)
        return SE2(exact.x_m + shift * noise[0], exact.y_m + shift * noise[1], exact.theta_rad + turn * noise[2])

    def _waypoints(self, state: CachedState, offsets: Sequence[SE2]) -> NDArray[np.float32]:
        points = state.waypoints
        assert points is not None  # `_anchors` has left the others out
        return np.concatenate([waypoints_now(points, offset) for offset in offsets])


def _pick(upto: Array, uniform: float) -> int:
    """Index drawn by cumulated chances; `uniform` in [0, 1). One that has no chance is never drawn."""
    return int(np.searchsorted(upto, uniform * upto[-1], side="right"))
