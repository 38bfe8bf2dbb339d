"""Configuration of stage `sft`: samples of the language model and the training on them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from tools.train.config.collect import TourConfig
from tools.train.config.optim import OptimConfig

AROUND: Final = 3
"""Frames before and after an anchor for which its text is still true."""


@dataclass(frozen=True)
class DrawConfig:
    """Random variation of each sample's text."""

    waypoints_only: float = 0.2
    """Share of answers with waypoints and without reasoning text."""
    before_min_s: float = 0.3
    before_max_s: float = 4.0
    """Range of the time since the previous generation's newest frame, s: the duration of a generation."""
    before_late: float = 0.15
    before_latest_s: float = 10.0
    """Share of generations that take longer, and their upper limit, s."""
    before_wrong: float = 0.25
    """Share of prompts with wrong previous progress, so that the model learns to correct mistakes."""
    way_turn_rad: float = 0.035
    way_scale: float = 0.02
    way_point_m: float = 0.05
    """Standard deviations of the noise added to the past motion from odometry: rad, share and m."""

    def __post_init__(self) -> None:
        if not (0 <= self.waypoints_only <= 1 and 0 <= self.before_wrong < 1 and 0 <= self.before_late <= 1):
            raise ValueError("expected waypoints_only and before_late from 0 to 1 and before_wrong from 0 to below 1")
        if not 0 < self.before_min_s <= self.before_max_s <= self.before_latest_s <= 60:
            raise ValueError("expected 0 < before_min_s <= before_max_s <= before_latest_s <= 60")
        if min(self.way_turn_rad, self.way_scale, self.way_point_m) < 0:
            raise ValueError("expected way_turn_rad, way_scale and way_point_m from 0 on")


@dataclass(frozen=True)
class ShowConfig:
    """Random variation of each sample's frames."""

    shift_frames: int = AROUND
    """Largest shift of the newest frame, frames of 0.1 s."""
    jitter_frames: int = 2
    """Largest additional shift of each older frame, frames."""
    noise: float = 0.1
    """Standard deviation of the noise added to visual tokens, relative to theirs."""
    drop: float = 0.1
    """Share of visual tokens set to zero."""

    def __post_init__(self) -> None:
        if not 0 <= self.shift_frames <= AROUND or not 0 <= self.jitter_frames <= 5:
            raise ValueError(f"expected shift_frames from 0 to {AROUND} and jitter_frames from 0 to 5")
        if not (0 <= self.noise <= 1 and 0 <= self.drop < 1):
            raise ValueError("expected noise from 0 to 1 and drop from 0 to below 1")


@dataclass(frozen=True)
class RelabelConfig:
    """Relabelling of drives with instructions for other goals."""

    ways: int = 0
    """Upper limit of other instructions per drive; 0: none."""
    tries: int = 24
    """Random goals that are tried per drive."""

    def __post_init__(self) -> None:
        if not 0 <= self.ways <= 64 or not 0 <= self.tries <= 1000:
            raise ValueError(f"expected 0 to 64 ways and 0 to 1000 tries, found {self.ways}, {self.tries}")


@dataclass(frozen=True)
class EvalConfig:
    """Size of the evaluation after fine-tuning."""

    anchors: int = 384
    """Anchors decoded with the true previous progress."""
    epoch_anchors: int = 64
    """Anchors decoded after every epoch, for a curve."""
    drives: int = 64
    """Drives decoded with the model's own previous progress."""
    gap_s: float = 2.0
    """Time between two generations of such a drive, whole seconds: the mean of the benchmark's latency profile."""
    max_new_tokens: int = 72
    batch: int = 48

    def __post_init__(self) -> None:
        if min(self.anchors, self.epoch_anchors, self.drives) < 0 or self.batch < 1 or self.max_new_tokens < 1:
            raise ValueError("expected anchors and drives from 0 on, batch and max_new_tokens from 1 on")
        if self.gap_s < 1 or self.gap_s != round(self.gap_s):
            raise ValueError(f"expected gap_s to be whole seconds from 1 on, found {self.gap_s}")


@dataclass(frozen=True)
class SftConfig:
    """Supervised fine-tuning of the language model."""

    epochs: int = 8
    batch: int = 32
    """Samples per step over all ranks."""
    words: DrawConfig = field(default_factory=DrawConfig)
    shown: ShowConfig = field(default_factory=ShowConfig)
    retold: RelabelConfig = field(default_factory=RelabelConfig)
    """Other instructions for every drive."""
    tours: TourConfig = field(default_factory=TourConfig)
    """Tours whose text is learned in addition to that of the drives."""
    tours_again: float = 0.25
    """Share of the tours, another one each time, that is used after a DAgger round."""
    mirrored: float = 0.5
    """Share of samples from mirrored drives."""
    go_on_share: float = 0.4
    go_on_lr_share: float = 0.3
    """Shares of the epochs and of the learning rate after a DAgger round, starting from the previous weights;
    go_on_share 0: train anew."""
    deciding: int = 2
    """Repetitions per epoch of an anchor near a change of progress (`tools.train.samples.anchors`); others have one."""
    optim: OptimConfig = field(
        default_factory=lambda: OptimConfig(lr=1e-3, final_lr_share=0.02, warmup_steps=200, bf16=True)
    )
    """The paper's 2e-5 (Table 8) is for a pretrained language model; ours is trained from scratch."""
    held_anchors: int = 512
    """Anchors of held-out layouts whose loss is computed after every epoch."""
    checkpoint_steps: int = 200
    """Steps between two checkpoints."""
    evaluate: EvalConfig = field(default_factory=EvalConfig)

    def __post_init__(self) -> None:
        if min(self.epochs, self.batch, self.checkpoint_steps) < 1 or self.held_anchors < 0:
            raise ValueError("expected epochs, batch and checkpoint_steps from 1 on and held_anchors from 0 on")
        if not (0 <= self.go_on_share <= 1 and 0 < self.go_on_lr_share <= 1):
            raise ValueError("expected go_on_share from 0 to 1 and go_on_lr_share above 0 to 1")
        if not 1 <= self.deciding <= 16:
            raise ValueError(f"expected deciding to be 1 to 16, found {self.deciding}")
        if not (0 <= self.mirrored <= 1 and 0 <= self.tours_again <= 1):
            raise ValueError("expected mirrored and tours_again to be shares from 0 to 1")
