"""Configuration of stage `imitate`: delays, semantic states, samples, losses and training."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Annotated, TypeAlias

from tools.train.config.checks import Checked, Count, Fraction, Natural, OptimConfig, Range, Share
from tools.train.config.collect import TRACE_EVERY
from tools.train.config.sft import DrawConfig

TIC_VLA, POINT_GOAL = "tic-vla", "point-goal"
Factor: TypeAlias = Annotated[float, Range(0, 100, above=True)]


@dataclass(frozen=True)
class DelayConfig(Checked):
    """Delays in training: uniform from `low_s` to `high_s` (paper, Algorithm 1), or those of a device's profile."""

    low_s: Annotated[float, Range(0, 60)] = 0.0
    high_s: Annotated[float, Range(0, 60)] = 10.0
    profile: str = ""
    """A file of `edge-calib latency`; empty: uniform."""
    near_share: Share = 0.0
    """Share of delays drawn uniformly from `low_s` to `near_s`: the policy learns to use semantic states from recent
    ones. Ignored with a profile."""
    near_s: float = 4.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.low_s < self.high_s:
            raise ValueError(f"expected low_s < high_s, found {self.low_s:g} and {self.high_s:g}")
        if self.near_share and not self.low_s < self.near_s <= self.high_s:
            raise ValueError(f"near_s: expected above low_s and up to high_s, found {self.near_s:g}")


@dataclass(frozen=True)
class WeightConfig(Checked):
    """Factors on the probability of drawing a frame; factors of all conditions that a frame meets are multiplied."""

    turn: Factor = 2.0
    """Frames whose label turns by more than 0.5 rad within 3 s."""
    people: Factor = 2.0
    """Frames with a person in view within 6 m."""
    goal: Factor = 2.0
    goal_m: Annotated[float, Range(0, 100)] = 4.0
    """Distance to the goal below which `goal` applies, m."""
    recovery: Factor = 1.5
    """Frames in whose next 5 s another source than the expert commands, so that the label leads back."""
    policy: Factor = 1.0
    """Frames of a policy's drive (DAgger)."""
    stuck: Factor = 1.0
    """Frames where the robot has stood for 1 s and the label moves: with too few of them a policy stands forever."""


@dataclass(frozen=True)
class SampleConfig(Checked):
    """Composition of a sample: semantic state, its text and noise."""

    group: Annotated[int, Range(1, 64)] = 4
    """Frames that share one semantic state and its keys and values: fewer vary more, more are faster."""
    reasoning: bool = True
    """False: states end after the prompt, without decoded text."""
    cut_text: Share = 0.1
    """Share of states with truncated text: a power budget may stop decoding at any token."""
    prompt_only: Share = 0.05
    """Share of states without text, as in mode `no-reasoning`."""
    text_only: Share = 0.0
    """Share of states with a masked prompt: the prompt names the side of a turn, only the text tells when to turn."""
    standing_start: Share = 0.5
    """Factor on the probability of delays that reach before the drive's first frame."""
    longest_told_s: Annotated[float, Range(0, 600, above=True)] = 10.0
    """Upper clip of the Δt input, s, as on the robot (the targets' `runtime.max_delay_s`)."""
    offset_noise_m_per_m: Share = 0.02
    """Noise of the motion offset, one standard deviation, m per metre driven since the anchor (paper, Table 14)."""
    offset_noise_deg_per_m: Annotated[float, Range(0, 90)] = 1.0
    """Noise of the heading offset, one standard deviation, degrees per metre driven since the anchor."""
    blind: Share = 0.0
    """Share of samples without the current image, so that the policy must use the semantic state: the expert's images
    alone almost determine its path."""
    weights: WeightConfig = field(default_factory=WeightConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.cut_text + self.prompt_only + self.text_only > 1:
            raise ValueError("expected cut_text, prompt_only and text_only, together 1 at most")

    def undisturbed(self) -> SampleConfig:
        """Return the configuration for evaluation: equal frame weights and no noise."""
        even = WeightConfig(turn=1.0, people=1.0, goal=1.0, recovery=1.0)
        return replace(
            self, blind=0.0, cut_text=0.0, prompt_only=0.0, text_only=0.0, standing_start=0.0, offset_noise_m_per_m=0.0,
            offset_noise_deg_per_m=0.0, weights=even,
        )  # fmt: skip


@dataclass(frozen=True)
class KvConfig(Checked):
    """Semantic states that are computed and cached."""

    draws: Annotated[int, Range(1, 64)] = 1
    """States of each anchor, each with its own instruction wording and previous progress."""
    own_share: Share = 0.0
    """Share of states with text that the model decodes; the others have the true text (paper appendix B)."""
    own_share_policy: Share = 0.8
    """The same along a policy's drives (DAgger). Off the route the true text leads back, which is not available on the
    robot."""
    max_new_tokens: Natural = 72
    """Upper limit of decoded tokens."""
    every: Count = TRACE_EVERY
    """Frames between two anchors."""
    batch: Count = 32
    words: DrawConfig = field(default_factory=lambda: DrawConfig(waypoints_only=0.0))

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.every % TRACE_EVERY:
            raise ValueError(f"expected every to be a multiple of {TRACE_EVERY} frames, found {self.every}")


@dataclass(frozen=True)
class LossConfig(Checked):
    """Loss of the query head and the point-goal network: smooth L1 of the integrated poses (equation 4), and walls."""

    beta: Factor = 1.0
    """Error below which the loss is quadratic, m and rad; torch's default, the paper states none."""
    heading_weight: Annotated[float, Range(0, 100)] = 1.0
    """Weight of an error of 1 rad relative to an error of 1 m."""

    walls: Annotated[float, Range(0, 100)] = 0.0
    """Weight of each metre that a plan is too close to walls (`tools.train.drives.walls`); 0: walls are ignored. Heads
    with another objective do not use it."""
    room_m: Annotated[float, Range(0, 1)] = 0.2
    """Distance to walls below which a plan is too close, m, unless the expert's plan is as close."""


@dataclass(frozen=True)
class ImitateEvalConfig(Checked):
    """Size of the evaluation after imitation."""

    samples: Count = 4096
    batch: Count = 64
    edges_s: tuple[float, ...] = (0.0, 1.0, 2.0, 3.0, 5.0, 7.0, 10.0)
    """Edges of the delay bins, s; the last bin includes its upper edge."""
    own_words: bool = True
    """Also evaluate with text that the language model decoded itself."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.edges_s) < 2 or any(a >= b for a, b in pairwise(self.edges_s)) or self.edges_s[0] < 0:
            raise ValueError(f"edges_s: expected two or more rising ages from 0 s on, found {self.edges_s}")


@dataclass(frozen=True)
class ImitateConfig(Checked):
    """Imitation learning with delayed inference."""

    policy: str = TIC_VLA
    """tic-vla, or point-goal: the paper's behaviour cloning baseline from image, state and goal, without language."""
    samples: Count = 384_000
    """Total number of samples (the paper: 10 epochs of frames 3 s apart)."""
    batch: Count = 64
    """Samples per step over all ranks (the paper: 16 on each of 8)."""
    go_on_share: Share = 0.5
    """Share of `samples` after a DAgger round, starting from the previous weights; 0: train anew with all samples."""
    inject_delay: bool = True
    """False: semantic states have no delay (the crosses in the paper's Table 2)."""
    delays: DelayConfig = field(default_factory=DelayConfig)
    sample: SampleConfig = field(default_factory=SampleConfig)
    states: KvConfig = field(default_factory=KvConfig)
    mirrored: Fraction = 0.3
    """Share of samples from mirrored drives, at whole seconds."""
    loss: LossConfig = field(default_factory=LossConfig)
    optim: OptimConfig = field(default_factory=lambda: OptimConfig(bf16=True))
    """Table 8; bfloat16 is nearly twice as fast on two cores."""
    held_samples: Natural = 1024
    """Samples from held-out layouts whose loss is computed every `held_steps` steps and at the end."""
    held_steps: Count = 500
    checkpoint_steps: Count = 500
    evaluate: ImitateEvalConfig = field(default_factory=ImitateEvalConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.policy not in (TIC_VLA, POINT_GOAL):
            raise ValueError(f"policy: expected {TIC_VLA} or {POINT_GOAL}, found {self.policy!r}")
        if self.batch % self.sample.group:
            raise ValueError(f"batch: expected a multiple of sample.group ({self.sample.group}), found {self.batch}")
