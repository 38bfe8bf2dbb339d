"""Samples of imitation under delay (paper, Algorithm 1): a frame, an older semantic state, their delay and offset.

Frame k is drawn by weight and the delay Δt from its distribution; the semantic state belongs to frame k - 10 Δt, where
one is cached, so that Δt and the motion offset are exact. The robot stood before a drive's first frame: a delay that
reaches beyond it uses the first state, as in the first generation of every instruction. Frames that share a state are
drawn together.

Inputs come from frame k and earlier; only the label lies in the future.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from math import radians
from pathlib import Path
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from edge.core.geometry import SE2
from edge.inference.latency_profile import LatencyProfile, load_profile
from edge.state.reasoning_text import Waypoints
from edge.state.semantic import waypoints_now
from export.model.config import TicVlaConfig
from tools.train.config.collect import RATE_HZ
from tools.train.config.imitate import DelayConfig, SampleConfig
from tools.train.drives.walls import nothing_near
from tools.train.samples.action_batch import Around, Group
from tools.train.samples.drive_frames import DriveFrames
from tools.train.samples.kv_cache import CachedState
from tools.train.samples.language_batch import FrameTokens

_MOST_TIMES: Final = 1000  # larger profiles are reduced to this many quantiles
_ROUNDING: Final = 1e-12  # probabilities below this are set to zero


@dataclass(frozen=True)
class Delays:
    """Distribution of the delay Δt in units of 0.1 s, the spacing of frames."""

    mass: Array
    """[J]: probability that Δt, rounded, is j units; the sum is 1."""

    def __post_init__(self) -> None:
        whole = float(self.mass.sum())
        if self.mass.ndim != 1 or not len(self.mass) or np.any(self.mass < 0) or not math.isclose(whole, 1.0):
            raise ValueError(f"delays: expected probabilities with sum 1, found {self.mass.shape} with sum {whole:g}")

    @staticmethod
    def of(config: DelayConfig) -> Delays:
        """Build the distribution of a configuration. Raises LatencyError for an unusable profile."""
        return Delays.of_profile(load_profile(Path(config.profile))) if config.profile else Delays.uniform(config)

    @staticmethod
    def none() -> Delays:
        """Return the distribution without delay."""
        return Delays(np.ones(1))

    @staticmethod
    def uniform(config: DelayConfig) -> Delays:
        """Return U(low_s, high_s), mixed with U(low_s, near_s)."""
        edges, low_s = _edges(config.high_s), config.low_s
        reached = np.clip((edges - low_s) / (config.high_s - low_s), 0.0, 1.0)
        if config.near_share:
            reached += config.near_share * (np.clip((edges - low_s) / (config.near_s - low_s), 0.0, 1.0) - reached)
        return _of_cdf(reached)

    @staticmethod
    def of_profile(profile: LatencyProfile) -> Delays:
        """Return the delays of a device's runner, generation after generation, from its measured latencies."""
        times = np.array(profile.generation_s)
        ages = times - np.array(profile.anchor_after_s or (0.0,))
        if times.max() <= 0:
            return Delays.none()
        times, ages = _thinned(times), _thinned(ages)
        edges = _edges(float(ages.max() + times.max()))
        # The time e since the release has the density P(L' > e) / E[L'] (renewal theory).
        below = np.cumsum(times) / times.sum()
        elapsed = np.maximum(edges[:, None] - ages[None], 0.0)
        shorter = np.searchsorted(times, elapsed, side="right")
        share = np.where(shorter > 0, below[shorter - 1], 0.0) + elapsed * (len(times) - shorter) / times.sum()
        return _of_cdf(share.mean(axis=1))

    @property
    def beyond(self) -> Array:
        """Probabilities [J] that Δt is more than j units; exactly 0 beyond the longest delay."""
        return np.append(np.cumsum(self.mass[:0:-1])[::-1], 0.0)

    @property
    def mean_s(self) -> float:
        """Mean delay, s."""
        return float(self.mass @ np.arange(len(self.mass))) / RATE_HZ


def _thinned(values: Array) -> Array:
    """Sort values, and reduce them to evenly spaced quantiles if there are more than _MOST_TIMES."""
    ordered = np.sort(values)
    if len(ordered) <= _MOST_TIMES:
        return ordered
    return ordered[np.linspace(0, len(ordered) - 1, _MOST_TIMES).round().astype(np.int64)]


def _edges(longest_s: float) -> Array:
    """Return the upper edges, s, of the bins of 0.1 s up to `longest_s`."""
    return (np.arange(math.ceil(longest_s * RATE_HZ - 1e-9) + 1) + 0.5) / RATE_HZ


def _of_cdf(reached: Array) -> Delays:
    """Build a distribution from the probabilities of being below each upper edge; the last is 1 up to rounding."""
    mass = np.diff(reached, prepend=0.0)
    mass[mass < _ROUNDING] = 0.0
    return Delays(mass / mass.sum())


Array = NDArray[np.float64]


class SampleError(ValueError):
    """Drives without samples, or a network that cannot be trained on them; one line."""


class States(Protocol):
    """Cached semantic states of drives (see `KvCache`)."""

    draws: int
    """Number of states of each anchor."""

    def anchors(self, drive_id: str) -> tuple[int, ...]:
        """Return the frames that have a state, evenly spaced."""
        ...

    def at(self, drive_id: str, k: int, draw: int = 0) -> CachedState:
        """Return state number `draw` of the generation whose newest frame is k."""
        ...


@dataclass(frozen=True)
class Source:
    """Visual tokens and semantic states of drives, by their ids."""

    tokens: FrameTokens
    states: States


@dataclass(frozen=True)
class SampleChoice:
    """Frames `ks` of drive number `drive` with the state of frame `anchor`, and their delays `ages` in 0.1 s."""

    drive: int
    anchor: int
    ks: tuple[int, ...]
    ages: tuple[int, ...]


class Samples:
    """Draws groups of samples; all random numbers come from the given generator, in a fixed order."""

    def __init__(
        self,
        drives: Iterable[DriveFrames],
        tokens: FrameTokens,
        states: States,
        delays: Delays,
        config: SampleConfig,
        model: TicVlaConfig,
        *,
        mirror: Source | None = None,
        drop: bool = True,
    ) -> None:
        """`mirror`: of mirrored drives; `drop`: apply the network's dropout of K‖V and state.

        Raises SampleError if no frame can be drawn.
        """
        if round(model.action.step_s * RATE_HZ, 6) != 1:
            raise SampleError(f"action.step_s: expected 0.1, the spacing of the labels, found {model.action.step_s:g}")
        self.drives = tuple(drives)
        self.config = config
        self._plain, self._mirror, self._delays = Source(tokens, states), mirror, delays
        self._by_waypoints = model.action.semantic_interface == "waypoints"
        self._near_walls = any(drive.walls is not None for drive in self.drives)
        self._drop_kv, self._drop_state = (model.action.kv_dropout, model.action.state_dropout) if drop else (0.0, 0.0)
        # With a single possible delay, all frames of one state would be the same frame.
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
            raise SampleError("no frame has both a label and a semantic state at a possible delay")

    def _source(self, drive: DriveFrames) -> Source:
        return self._mirror if drive.in_mirror and self._mirror is not None else self._plain

    def _anchors(self, drive: DriveFrames) -> tuple[int, ...]:
        """Return the frames with usable states; the semantic interface `waypoints` requires waypoints in the text."""
        states = self._source(drive).states
        anchors = states.anchors(drive.id)
        if not self._by_waypoints:
            return anchors
        draws = range(states.draws)
        return tuple(k for k in anchors if all(states.at(drive.id, k, draw).waypoints is not None for draw in draws))

    def _chances(self, drive: DriveFrames) -> tuple[Array, dict[int, float], float]:
        """Return probabilities of a drive.

        They are each frame's weight divided by the probability of meeting a state, each state's probability, and the
        probability of a delay that reaches before the first frame.
        """
        mass, beyond = self._delays.mass, self._delays.beyond
        anchors = self._anchors(drive)
        if not anchors:
            return np.zeros(len(drive)), {}, 0.0
        # One state represents all delays up to the next state.
        every = int(np.diff(anchors).min()) if len(anchors) > 1 else RATE_HZ
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

    def choose(self, rng: np.random.Generator) -> SampleChoice:
        """Draw a state, then the frames that use it."""
        index, anchor, stood = self._places[_pick(self._upto, rng.uniform())]
        share, mass, beyond = self._share[index], self._delays.mass, self._delays.beyond
        if not stood:
            span = share[anchor : anchor + len(mass)]
            upto = np.cumsum(span * mass[: len(span)])
            ages = [_pick(upto, u) for u in rng.uniform(size=self.group)]
            return SampleChoice(index, anchor, tuple(anchor + age for age in ages), tuple(ages))
        span = share[: len(beyond)]
        upto = np.cumsum(span * beyond[: len(span)])
        ks = [_pick(upto, u) for u in rng.uniform(size=self.group)]
        older = [
            k + 1 + _pick(np.cumsum(mass[k + 1 :]), u) for k, u in zip(ks, rng.uniform(size=self.group), strict=True)
        ]
        return SampleChoice(index, 0, tuple(ks), tuple(older))

    def take(self, chosen: SampleChoice, rng: np.random.Generator) -> Group:
        """Assemble the network's inputs and labels of a choice."""
        drive, count = self.drives[chosen.drive], len(chosen.ks)
        which, cut, end = rng.uniform(size=3)
        noise = rng.standard_normal((count, 3))
        keep_state = rng.uniform(size=count) >= self._drop_state
        source = self._source(drive)
        state = source.states.at(drive.id, chosen.anchor, int(which * source.states.draws))
        ks = list(chosen.ks)
        offsets = [self._offset(drive, chosen.anchor, k, row) for k, row in zip(ks, noise, strict=True)]
        delays_s = [min(age / RATE_HZ, self.config.longest_told_s) for age in chosen.ages]
        latency = [(delay_s, *offset.as_tuple()) for delay_s, offset in zip(delays_s, offsets, strict=True)]
        guidance: NDArray[np.floating]
        if self._by_waypoints:
            assert state.waypoints is not None  # `_anchors` excludes states without waypoints
            guidance = np.concatenate([waypoints_now(state.waypoints, offset) for offset in offsets])
            keep = np.ones(guidance.shape[:2], bool)
        else:
            rows = state.kv[: self._length(state, cut, end)]
            guidance = np.array(rows)[None]
            keep = rng.uniform(size=guidance.shape[:2]) >= self._drop_kv
            # The same random number as in `_length`: a state is shortened, or its prompt is masked, or it is whole.
            if self.config.reasoning and self.config.cut_text <= cut < self.config.cut_text + self.config.text_only:
                keep[:, : state.prompt_tokens] = False
        frames = source.tokens.frames(drive.id)
        visual = np.stack([frames[k] for k in ks])
        if self.config.blind:
            visual[rng.uniform(size=count) < self.config.blind] = 0
        return Group(
            visual_tokens=visual,
            state=drive.state[ks],
            latency=np.array(latency, np.float32),
            guidance=guidance,
            goal=drive.goal[ks],
            keep_guidance=keep,
            keep_state=keep_state,
            target=drive.target[ks],
            known=np.arange(drive.target.shape[1]) < drive.known[ks][:, None],
            around=self._around(drive, ks) if self._near_walls else None,
        )

    @staticmethod
    def _around(drive: DriveFrames, ks: list[int]) -> Around:
        """Return the walls around the robot in frames `ks`."""
        if drive.walls is None:
            return Around(nothing_near(len(ks)), np.zeros((len(ks), 2), np.float32))
        body = drive.walls.body
        return Around(drive.walls.patches(ks), np.full((len(ks), 2), (body.reach_m, body.radius_m), np.float32))

    def waypoints_of(self, chosen: SampleChoice) -> Waypoints | None:
        """Return the waypoints in a choice's state, m in the robot frame at the anchor; None if it has none."""
        drive = self.drives[chosen.drive]
        return self._source(drive).states.at(drive.id, chosen.anchor).waypoints

    def draw(self, rng: np.random.Generator) -> Group:
        """Draw a choice and assemble it."""
        return self.take(self.choose(rng), rng)

    def _length(self, state: CachedState, cut: float, end: float) -> int:
        """Return how many tokens of a state the policy receives."""
        decoded = len(state.kv) - state.prompt_tokens
        if not self.config.reasoning or cut >= 1 - self.config.prompt_only:
            return state.prompt_tokens
        return state.prompt_tokens + (int(end * (decoded + 1)) if cut < self.config.cut_text else decoded)

    def _offset(self, drive: DriveFrames, anchor: int, k: int, noise: Array) -> SE2:
        way_m = float(drive.way_m[k] - drive.way_m[anchor])
        shift, turn = self.config.offset_noise_m_per_m * way_m, radians(self.config.offset_noise_deg_per_m) * way_m
        exact = drive.offset(anchor, k)
        return SE2(exact.x_m + shift * noise[0], exact.y_m + shift * noise[1], exact.theta_rad + turn * noise[2])


def _pick(upto: Array, uniform: float) -> int:
    """Return the index for `uniform` in [0, 1) by cumulative weights; an index of zero weight is never drawn."""
    return int(np.searchsorted(upto, uniform * upto[-1], side="right"))


class NoStates:
    """Replaces the cache for a policy without semantics: every frame has a state of one token of zeros."""

    draws = 1

    def __init__(self, frames: Mapping[str, int], width: int) -> None:
        """`frames`: number of frames of each drive."""
        self._frames = frames
        self._state = CachedState(np.zeros((1, width), np.float16), 1, "", own=False)

    def anchors(self, drive_id: str) -> tuple[int, ...]:
        """Return all frames."""
        return tuple(range(self._frames[drive_id]))

    def at(self, drive_id: str, k: int, draw: int = 0) -> CachedState:
        """Return the same state for every frame."""
        return self._state
