"""Configuration of stage `sft`: samples of the language model and the training on them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Final, TypeAlias

from tools.train.config.checks import Checked, Count, Fraction, Natural, OptimConfig, Positive, Range, Share
from tools.train.config.collect import TourConfig

Deviation: TypeAlias = Annotated[float, Range(0)]
AROUND: Final = 3
"""Frames before and after an anchor for which its text is still true."""


@dataclass(frozen=True)
class DrawConfig(Checked):
    """Random variation of each sample's text."""

    waypoints_only: Share = 0.2
    """Share of answers with waypoints and without reasoning text."""
    before_min_s: Positive = 0.3
    before_max_s: float = 4.0
    """Range of the time since the previous generation's newest frame, s: the duration of a generation."""
    before_late: Share = 0.15
    before_latest_s: float = 10.0
    """Share of generations that take longer, and their upper limit, s."""
    before_wrong: Fraction = 0.25
    """Share of prompts with wrong previous progress, so that the model learns to correct mistakes."""
    before_unaware: Share = 0.5
    """Share of the prompts of frames off the route whose previous progress is that of a robot that does not know it: it
    counts the missed turn as done, or has not counted the opening that it missed."""
    before_own: Share = 0.7
    """Share of the prompts of a policy's drives whose previous progress is that of its own text."""
    way_turn_rad: Deviation = 0.035
    way_scale: Deviation = 0.02
    way_point_m: Deviation = 0.05
    """Standard deviations of the noise added to the past motion from odometry: rad, share and m."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.before_min_s <= self.before_max_s <= self.before_latest_s <= 60:
            raise ValueError("expected before_min_s <= before_max_s <= before_latest_s <= 60")


@dataclass(frozen=True)
class ShowConfig(Checked):
    """Random variation of each sample's frames."""

    shift_frames: Annotated[int, Range(0, AROUND)] = AROUND
    """Largest shift of the newest frame, frames of 0.1 s."""
    jitter_frames: Annotated[int, Range(0, 5)] = 2
    """Largest additional shift of each older frame, frames."""
    noise: Share = 0.1
    """Standard deviation of the noise added to visual tokens, relative to theirs."""
    drop: Fraction = 0.1
    """Share of visual tokens set to zero."""


@dataclass(frozen=True)
class RelabelConfig(Checked):
    """Relabelling of drives and tours with instructions for other goals."""

    ways: Annotated[int, Range(0, 64)] = 0
    """Upper limit of other instructions per drive; 0: none."""
    tour_ways: Annotated[int, Range(0, 64)] = 0
    """The same per tour."""
    tries: Annotated[int, Range(0, 1000)] = 24
    """Random goals that are tried per drive or tour."""
    off_m: Annotated[float, Range(1, 20)] = 3.0
    """A relabel ends at this distance from its route, m: the farther, the more of it shows a robot that is lost."""
    turned: bool = False
    """Whether other routes may begin behind or beside the robot; their instructions begin with a turn on the spot."""


@dataclass(frozen=True)
class EvalConfig(Checked):
    """Size of the evaluation after fine-tuning."""

    anchors: Natural = 384
    """Anchors decoded with the true previous progress."""
    epoch_anchors: Natural = 64
    """Anchors decoded after every epoch, for a curve."""
    drives: Natural = 64
    """Drives decoded with the model's own previous progress."""
    gap_s: Annotated[float, Range(1)] = 2.0
    """Time between two generations of such a drive, whole seconds: the mean of the benchmark's latency profile."""
    max_new_tokens: Count = 72
    batch: Count = 48

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.gap_s != round(self.gap_s):
            raise ValueError(f"expected gap_s to be whole seconds from 1 on, found {self.gap_s}")


@dataclass(frozen=True)
class SftConfig(Checked):
    """Supervised fine-tuning of the language model."""

    epochs: Count = 8
    batch: Count = 32
    """Samples per step over all ranks."""
    words: DrawConfig = field(default_factory=DrawConfig)
    shown: ShowConfig = field(default_factory=ShowConfig)
    retold: RelabelConfig = field(default_factory=RelabelConfig)
    """Other instructions for every drive."""
    tours: TourConfig = field(default_factory=TourConfig)
    """Tours whose text is learned in addition to that of the drives."""
    tours_again: Share = 0.25
    """Share of the tours, another one each time, that is used after a DAgger round."""
    mirrored: Share = 0.5
    """Share of samples from mirrored drives."""
    go_on_share: Share = 0.4
    go_on_lr_share: Annotated[float, Range(0, 1, above=True)] = 0.3
    """Shares of the epochs and of the learning rate after a DAgger round, starting from the previous weights;
    go_on_share 0: train anew."""
    deciding: Annotated[int, Range(1, 16)] = 2
    """Repetitions per epoch of an anchor near a change of progress (`tools.train.samples.anchors`); others have one."""
    optim: OptimConfig = field(
        default_factory=lambda: OptimConfig(lr=1e-3, final_lr_share=0.02, warmup_steps=200, bf16=True)
    )
    """The paper's 2e-5 (Table 8) is for a pretrained language model; ours is trained from scratch."""
    held_anchors: Natural = 512
    """Anchors of held-out layouts whose loss is computed after every epoch."""
    checkpoint_steps: Count = 200
    """Steps between two checkpoints."""
    evaluate: EvalConfig = field(default_factory=EvalConfig)
