"""The numbers of stage `imitate`: delays, semantic states, samples, losses and the training on them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Final

from tools.train.config.collect import TRACE_EVERY
from tools.train.config.optim import OptimConfig
from tools.train.config.sft import DrawConfig

TIC_VLA, POINT_GOAL = "tic-vla", "point-goal"
LONGEST_S: Final = 60.0


@dataclass(frozen=True)
class DelayConfig:
    """Ages to train under: uniform from `low_s` to `high_s` (paper, Algorithm 1), or those of a device's profile."""

    low_s: float = 0.0
    high_s: float = 10.0
    profile: str = ""
    """A file of `edge-calib latency`; empty: uniform."""
    near_share: float = 0.0
    """Share of ages that are uniform up to `near_s` instead: it is by fresh words that a policy learns to listen. Of a
    profile's it is not used."""
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
    stuck: float = 1.0
    """It has stood for a second and its label does not: a policy that sees this too seldom stands for good."""

    def __post_init__(self) -> None:
        factors = (self.turn, self.people, self.goal, self.recovery, self.policy, self.stuck)
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
    prompt_only: float = 0.05
    """Share of states of a prompt without any text: what the mode without reasoning drives by."""
    text_only: float = 0.0
    """Share of states whose prompt is hidden: of a turn it tells the side, and only the text tells when."""
    standing_start: float = 0.5
    """Chance of an age that reaches beyond the drive's first frame, as a factor on that of any other age."""
    longest_told_s: float = 10.0
    """Δt beyond this is told as this, as the robot tells it (the targets' `runtime.max_delay_s`)."""
    offset_noise_m_per_m: float = 0.02
    """Of the motion offset, in m for each metre driven since the state, one standard deviation (paper, Table 14)."""
    offset_noise_deg_per_m: float = 1.0
    blind: float = 0.0
    """Share of samples without the picture of now, so that what is said has to be heard: an expert's pictures alone
    nearly tell its way."""
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
        """The same with every frame alike, every age exact and nothing disturbed: what is evaluated on."""
        even = WeightConfig(turn=1.0, people=1.0, goal=1.0, recovery=1.0)
        return replace(
            self, blind=0.0, cut_text=0.0, prompt_only=0.0, text_only=0.0, standing_start=0.0, offset_noise_m_per_m=0.0,
            offset_noise_deg_per_m=0.0, weights=even,
        )  # fmt: skip


@dataclass(frozen=True)
class KvConfig:
    """Which states are kept."""

    draws: int = 1
    """States of each anchor, each with words and a `before` of its own."""
    own_share: float = 0.0
    """Share of states with the text that the model says itself; the others have the true one (paper appendix B)."""
    own_share_policy: float = 0.8
    """The same along a policy's drives (DAgger): off the way the truth leads back, but on the robot nobody says it."""
    max_new_tokens: int = 72
    """Of its own texts."""
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
    """Equation 4, of the query head and of the point-goal network: smooth L1 of the integrated poses; and walls."""

    beta: float = 1.0
    """Below this error it is quadratic, m and rad; torch's own value, the paper names none."""
    heading_weight: float = 1.0
    """Of an error of one radian beside one of a metre."""

    walls: float = 0.0
    """Of each metre that a plan comes too near to walls (`tools.train.scenes.walls`); 0: these are not looked at. Heads
    that learn by another objective leave it out."""
    room_m: float = 0.2
    """Nearer than this is too near, unless the expert's own plan comes as near."""

    def __post_init__(self) -> None:
        if not (0 < self.beta <= 100 and 0 <= self.heading_weight <= 100):
            raise ValueError("expected beta above 0 and heading_weight from 0 on, both up to 100")
        if not (0 <= self.walls <= 100 and 0 <= self.room_m <= 1):
            raise ValueError("expected walls from 0 to 100 and room_m from 0 to 1")


@dataclass(frozen=True)
class ImitateEvalConfig:
    """How much is looked at."""

    samples: int = 4096
    batch: int = 64
    edges_s: tuple[float, ...] = (0.0, 1.0, 2.0, 3.0, 5.0, 7.0, 10.0)
    """Ages are told apart by these; the last bin holds its upper edge."""
    own_words: bool = True
    """Look also at what becomes of it when the language model has said the texts itself."""

    def __post_init__(self) -> None:
        if self.samples < 1 or self.batch < 1:
            raise ValueError("expected samples and a batch from 1 on")
        if len(self.edges_s) < 2 or any(a >= b for a, b in pairwise(self.edges_s)) or self.edges_s[0] < 0:
            raise ValueError(f"edges_s: expected two or more rising ages from 0 s on, found {self.edges_s}")


@dataclass(frozen=True)
class ImitateConfig:
    """Imitation learning with delayed inference."""

    policy: str = TIC_VLA
    """Or point-goal: the paper's behaviour cloning baseline, from picture, state and goal, told nothing."""
    samples: int = 384_000
    """Samples in all (the paper: 10 epochs of frames 3 s apart)."""
    batch: int = 64
    """Samples of one step, of all ranks together (the paper: 16 on each of 8)."""
    go_on_share: float = 0.5
    """Of `samples` after a round of DAgger, from the weights before it; 0: from the beginning with all of them."""
    inject_delay: bool = True
    """False: states are always those of now (the crosses in the paper's Table 2)."""
    delays: DelayConfig = field(default_factory=DelayConfig)
    sample: SampleConfig = field(default_factory=SampleConfig)
    states: KvConfig = field(default_factory=KvConfig)
    mirrored: float = 0.3
    """Share of samples that are of the drives as a mirror shows them, at whole seconds."""
    loss: LossConfig = field(default_factory=LossConfig)
    optim: OptimConfig = field(default_factory=lambda: OptimConfig(bf16=True))
    """Table 8; in bfloat16, which is nearly twice as fast on two cores."""
    held_samples: int = 1024
    """Of held-out layouts, whose loss is looked at every `held_steps` steps and at the end."""
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
