"""Configuration of stage `imitate`: delays, semantic states, samples, losses and training."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Final

from tools.train.config.collect import TRACE_EVERY
from tools.train.config.optim import OptimConfig
from tools.train.config.sft import DrawConfig

TIC_VLA, POINT_GOAL = "tic-vla", "point-goal"
LONGEST_S: Final = 60.0
"""Upper limit of a delay, s."""


@dataclass(frozen=True)
class DelayConfig:
    """Delays in training: uniform from `low_s` to `high_s` (paper, Algorithm 1), or those of a device's profile."""

    low_s: float = 0.0
    high_s: float = 10.0
    profile: str = ""
    """A file of `edge-calib latency`; empty: uniform."""
    near_share: float = 0.0
    """Share of delays drawn uniformly from `low_s` to `near_s`: the policy learns to use semantic states from recent
    ones. Ignored with a profile."""
    near_s: float = 4.0

    def __post_init__(self) -> None:
        if not 0 <= self.low_s < self.high_s <= LONGEST_S:
            raise ValueError(
                f"expected 0 <= low_s < high_s <= {LONGEST_S:g} s, found {self.low_s:g} and {self.high_s:g}"
            )
        if not 0 <= self.near_share <= 1:
            raise ValueError(f"near_share: expected 0 to 1, found {self.near_share:g}")
        if self.near_share and not self.low_s < self.near_s <= self.high_s:
            raise ValueError(f"near_s: expected above low_s and up to high_s, found {self.near_s:g}")


@dataclass(frozen=True)
class WeightConfig:
    """Factors on the probability of drawing a frame; factors of all conditions that a frame meets are multiplied."""

    turn: float = 2.0
    """Frames whose label turns by more than 0.5 rad within 3 s."""
    people: float = 2.0
    """Frames with a person in view within 6 m."""
    goal: float = 2.0
    goal_m: float = 4.0
    """Distance to the goal below which `goal` applies, m."""
    recovery: float = 1.5
    """Frames in whose next 5 s another source than the expert commands, so that the label leads back."""
    policy: float = 1.0
    """Frames of a policy's drive (DAgger)."""
    stuck: float = 1.0
    """Frames where the robot has stood for 1 s and the label moves: with too few of them a policy stands forever."""

    def __post_init__(self) -> None:
        factors = (self.turn, self.people, self.goal, self.recovery, self.policy, self.stuck)
        if not all(0 < factor <= 100 for factor in factors) or not 0 <= self.goal_m <= 100:
            raise ValueError("expected factors above 0, up to 100, and goal_m from 0 to 100")


@dataclass(frozen=True)
class SampleConfig:
    """Composition of a sample: semantic state, its text and noise."""

    group: int = 4
    """Frames that share one semantic state and its keys and values: fewer vary more, more are faster."""
    reasoning: bool = True
    """False: states end after the prompt, without decoded text."""
    cut_text: float = 0.1
    """Share of states with truncated text: a power budget may stop decoding at any token."""
    prompt_only: float = 0.05
    """Share of states without text, as in mode `no-reasoning`."""
    text_only: float = 0.0
    """Share of states with a masked prompt: the prompt names the side of a turn, only the text tells when to turn."""
    standing_start: float = 0.5
    """Factor on the probability of delays that reach before the drive's first frame."""
    longest_told_s: float = 10.0
    """Upper clip of the Δt input, s, as on the robot (the targets' `runtime.max_delay_s`)."""
    offset_noise_m_per_m: float = 0.02
    """Noise of the motion offset, one standard deviation, m per metre driven since the anchor (paper, Table 14)."""
    offset_noise_deg_per_m: float = 1.0
    """Noise of the heading offset, one standard deviation, degrees per metre driven since the anchor."""
    blind: float = 0.0
    """Share of samples without the current image, so that the policy must use the semantic state: the expert's images
    alone almost determine its path."""
    weights: WeightConfig = field(default_factory=WeightConfig)

    def __post_init__(self) -> None:
        if not 1 <= self.group <= 64:
            raise ValueError(f"group: expected 1 to 64 frames, found {self.group}")
        of_text = self.cut_text, self.prompt_only, self.text_only
        if not (min(of_text) >= 0 and sum(of_text) <= 1):
            raise ValueError("expected cut_text, prompt_only and text_only from 0 on, together 1 at most")
        if not (0 <= self.standing_start <= 1 and 0 <= self.blind <= 1):
            raise ValueError("expected standing_start and blind from 0 to 1")
        if not 0 < self.longest_told_s <= 600:
            raise ValueError(f"longest_told_s: expected above 0 and up to 600 s, found {self.longest_told_s:g}")
        if not (0 <= self.offset_noise_m_per_m <= 1 and 0 <= self.offset_noise_deg_per_m <= 90):
            raise ValueError("expected offset_noise_m_per_m from 0 to 1 and offset_noise_deg_per_m from 0 to 90")

    def undisturbed(self) -> SampleConfig:
        """Return the configuration for evaluation: equal frame weights and no noise."""
        even = WeightConfig(turn=1.0, people=1.0, goal=1.0, recovery=1.0)
        return replace(
            self, blind=0.0, cut_text=0.0, prompt_only=0.0, text_only=0.0, standing_start=0.0, offset_noise_m_per_m=0.0,
            offset_noise_deg_per_m=0.0, weights=even,
        )  # fmt: skip


@dataclass(frozen=True)
class KvConfig:
    """Semantic states that are computed and cached."""

    draws: int = 1
    """States of each anchor, each with its own instruction wording and previous progress."""
    own_share: float = 0.0
    """Share of states with text that the model decodes; the others have the true text (paper appendix B)."""
    own_share_policy: float = 0.8
    """The same along a policy's drives (DAgger). Off the route the true text leads back, which is not available on the
    robot."""
    max_new_tokens: int = 72
    """Upper limit of decoded tokens."""
    every: int = TRACE_EVERY
    """Frames between two anchors."""
    batch: int = 32
    words: DrawConfig = field(default_factory=lambda: DrawConfig(waypoints_only=0.0))

    def __post_init__(self) -> None:
        if not (1 <= self.draws <= 64 and self.batch >= 1 and self.max_new_tokens >= 0):
            raise ValueError("expected 1 to 64 draws, a batch and max_new_tokens from 0 on")
        if not all(0 <= share <= 1 for share in (self.own_share, self.own_share_policy)):
            raise ValueError("expected own_share and own_share_policy from 0 to 1")
        if self.every < 1 or self.every % TRACE_EVERY:
            raise ValueError(f"expected every to be a multiple of {TRACE_EVERY} frames, found {self.every}")


@dataclass(frozen=True)
class LossConfig:
    """Loss of the query head and the point-goal network: smooth L1 of the integrated poses (equation 4), and walls."""

    beta: float = 1.0
    """Error below which the loss is quadratic, m and rad; torch's default, the paper states none."""
    heading_weight: float = 1.0
    """Weight of an error of 1 rad relative to an error of 1 m."""

    walls: float = 0.0
    """Weight of each metre that a plan is too close to walls (`tools.train.scenes.walls`); 0: walls are ignored. Heads
    with another objective do not use it."""
    room_m: float = 0.2
    """Distance to walls below which a plan is too close, m, unless the expert's plan is as close."""

    def __post_init__(self) -> None:
        if not (0 < self.beta <= 100 and 0 <= self.heading_weight <= 100):
            raise ValueError("expected beta above 0 and heading_weight from 0 on, both up to 100")
        if not (0 <= self.walls <= 100 and 0 <= self.room_m <= 1):
            raise ValueError("expected walls from 0 to 100 and room_m from 0 to 1")


@dataclass(frozen=True)
class ImitateEvalConfig:
    """Size of the evaluation after imitation."""

    samples: int = 4096
    batch: int = 64
    edges_s: tuple[float, ...] = (0.0, 1.0, 2.0, 3.0, 5.0, 7.0, 10.0)
    """Edges of the delay bins, s; the last bin includes its upper edge."""
    own_words: bool = True
    """Also evaluate with text that the language model decoded itself."""

    def __post_init__(self) -> None:
        if self.samples < 1 or self.batch < 1:
            raise ValueError("expected samples and a batch from 1 on")
        if len(self.edges_s) < 2 or any(a >= b for a, b in pairwise(self.edges_s)) or self.edges_s[0] < 0:
            raise ValueError(f"edges_s: expected two or more rising ages from 0 s on, found {self.edges_s}")


@dataclass(frozen=True)
class ImitateConfig:
    """Imitation learning with delayed inference."""

    policy: str = TIC_VLA
    """tic-vla, or point-goal: the paper's behaviour cloning baseline from image, state and goal, without language."""
    samples: int = 384_000
    """Total number of samples (the paper: 10 epochs of frames 3 s apart)."""
    batch: int = 64
    """Samples per step over all ranks (the paper: 16 on each of 8)."""
    go_on_share: float = 0.5
    """Share of `samples` after a DAgger round, starting from the previous weights; 0: train anew with all samples."""
    inject_delay: bool = True
    """False: semantic states have no delay (the crosses in the paper's Table 2)."""
    delays: DelayConfig = field(default_factory=DelayConfig)
    sample: SampleConfig = field(default_factory=SampleConfig)
    states: KvConfig = field(default_factory=KvConfig)
    mirrored: float = 0.3
    """Share of samples from mirrored drives, at whole seconds."""
    loss: LossConfig = field(default_factory=LossConfig)
    optim: OptimConfig = field(default_factory=lambda: OptimConfig(bf16=True))
    """Table 8; bfloat16 is nearly twice as fast on two cores."""
    held_samples: int = 1024
    """Samples from held-out layouts whose loss is computed every `held_steps` steps and at the end."""
    held_steps: int = 500
    checkpoint_steps: int = 500
    evaluate: ImitateEvalConfig = field(default_factory=ImitateEvalConfig)

    def __post_init__(self) -> None:
        if self.policy not in (TIC_VLA, POINT_GOAL):
            raise ValueError(f"policy: expected {TIC_VLA} or {POINT_GOAL}, found {self.policy!r}")
        if min(self.samples, self.batch, self.held_steps, self.checkpoint_steps) < 1 or self.held_samples < 0:
            raise ValueError("expected samples, batch, held_steps and checkpoint_steps from 1, held_samples from 0 on")
        if self.batch % self.sample.group:
            raise ValueError(f"batch: expected a multiple of sample.group ({self.sample.group}), found {self.batch}")
        if not (0 <= self.go_on_share <= 1 and 0 <= self.mirrored < 1):
            raise ValueError("expected go_on_share from 0 to 1 and mirrored from 0 to below 1")
