"""The numbers of stage `sft`: what is drawn for a sample of the language model, and the training on it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from tools.train.config.collect import TourConfig
from tools.train.config.optim import OptimConfig

AROUND: Final = 3
"""Frames before and after an anchor at which its words still hold."""


@dataclass(frozen=True)
class DrawConfig:
    """What is drawn for each sample."""

    waypoints_only: float = 0.2
    """Share of answers that are waypoints without reasoning."""
    before_min_s: float = 0.3
    before_max_s: float = 4.0
    """The last generation's newest frame is so long ago: what a generation takes."""
    before_late: float = 0.15
    before_latest_s: float = 10.0
    """A share of generations takes longer, up to this."""
    before_wrong: float = 0.25
    """Share of wrong words about the progress so far: a model that trusted them blindly could never mend a mistake."""
    way_turn_rad: float = 0.035
    way_scale: float = 0.02
    way_point_m: float = 0.05
    """Standard deviations of what odometry tells of the way, beyond what it was recorded with."""

    def __post_init__(self) -> None:
        if not (0 <= self.waypoints_only <= 1 and 0 <= self.before_wrong < 1 and 0 <= self.before_late <= 1):
            raise ValueError("expected waypoints_only and before_late from 0 to 1 and before_wrong from 0 to below 1")
        if not 0 < self.before_min_s <= self.before_max_s <= self.before_latest_s <= 60:
            raise ValueError("expected 0 < before_min_s <= before_max_s <= before_latest_s <= 60")
        if min(self.way_turn_rad, self.way_scale, self.way_point_m) < 0:
            raise ValueError("expected way_turn_rad, way_scale and way_point_m from 0 on")


@dataclass(frozen=True)
class ShowConfig:
    """How much what is shown differs from what was recorded."""

    shift_frames: int = AROUND
    """The newest frame is up to so many earlier or later (0.1 s each)."""
    jitter_frames: int = 2
    """And the older ones up to so many beyond that, each on its own."""
    noise: float = 0.1
    """Standard deviation of what is added to a visual token's numbers, in units of theirs."""
    drop: float = 0.1
    """Share of visual tokens that are blank."""

    def __post_init__(self) -> None:
        if not 0 <= self.shift_frames <= AROUND or not 0 <= self.jitter_frames <= 5:
            raise ValueError(f"expected shift_frames from 0 to {AROUND} and jitter_frames from 0 to 5")
        if not (0 <= self.noise <= 1 and 0 <= self.drop < 1):
            raise ValueError("expected noise from 0 to 1 and drop from 0 to below 1")


@dataclass(frozen=True)
class RetellConfig:
    """How many other ways are told of each drive."""

    ways: int = 0
    """At most; 0: none."""
    tries: int = 24
    """Goals that are looked at for them, by chance."""

    def __post_init__(self) -> None:
        if not 0 <= self.ways <= 64 or not 0 <= self.tries <= 1000:
            raise ValueError(f"expected 0 to 64 ways and 0 to 1000 tries, found {self.ways}, {self.tries}")


@dataclass(frozen=True)
class EvalConfig:
    """How much is looked at."""

    anchors: int = 384
    """Anchors that are answered with the right words before them."""
    epoch_anchors: int = 64
    """The same after every epoch, for a curve."""
    drives: int = 64
    """Drives along which the model hears only itself."""
    gap_s: float = 2.0
    """Between two generations of such a drive: the mean of the benchmark's latency profile. Whole seconds."""
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
    """Samples of all ranks together."""
    words: DrawConfig = field(default_factory=DrawConfig)
    shown: ShowConfig = field(default_factory=ShowConfig)
    retold: RetellConfig = field(default_factory=RetellConfig)
    """Other instructions under which every drive is shown too."""
    tours: TourConfig = field(default_factory=TourConfig)
    """Robots that were carried along told ways, whose words are learned beside those of the drives."""
    tours_again: float = 0.25
    """Share of them that is learned again, others each time, where it goes on after a round of DAgger."""
    mirrored: float = 0.5
    """Share of samples that are of the drives as a mirror shows them: other places to speak of."""
    go_on_share: float = 0.4
    go_on_lr_share: float = 0.3
    """Of epochs and of the learning rate, after a round of DAgger, from the weights before; 0: from the beginning."""
    deciding: int = 2
    """How often an anchor that decides (`tools.train.samples.anchors`) is shown in an epoch; the others once."""
    optim: OptimConfig = field(
        default_factory=lambda: OptimConfig(lr=1e-3, final_lr_share=0.02, warmup_steps=200, bf16=True)
    )
    """The paper's 2e-5 (Table 8) is for a language model that can speak; ours begins from nothing."""
    held_anchors: int = 512
    """Anchors of held-out layouts whose loss is looked at after every epoch."""
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
