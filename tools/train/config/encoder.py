"""Configuration of stage `encoder`: images, augmentation and training."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Final

from tools.train.config.checks import Checked, Count, Fraction, Jobs, Natural, OptimConfig, Quality, Range, Share
from tools.train.config.collect import CORRIDOR, KINDS

MOST_SCENES: Final = 50_000
"""Upper limit of scenes per split; a layout that cannot be built is replaced by the one this many further on."""
OUTDOORS_LEAST: Final = 20
"""Fewest people in an outdoor scene."""


@dataclass(frozen=True)
class FramesConfig(Checked):
    """Number, scenes and rendering of images. A kind that is listed twice has twice as many scenes."""

    count: Annotated[int, Range(0, 10_000_000)] = 120_000
    """Training images; 0: the encoder is not trained."""
    held: Annotated[int, Range(0, 1_000_000)] = 6_000
    """Held-out images, in layouts that are never trained on."""
    per_scene: Annotated[int, Range(1, 100_000)] = 600
    kinds: tuple[str, ...] = (
        "hospital", "office", "warehouse", "sidewalk", "hospital", "office", "warehouse", "sidewalk",
        "hospital", "office", "warehouse", "sidewalk", "hospital", "office", "warehouse", "corridor",
    )  # fmt: skip
    people_indoors: Annotated[int, Range(0, 200)] = 60
    """Upper limit of people in one scene."""
    people_outdoors: Annotated[int, Range(OUTDOORS_LEAST, 200)] = 120
    moment: Annotated[int, Range(1, 1000)] = 8
    """Images taken before the people move."""
    moment_s: Annotated[float, Range(0, 60, above=True)] = 0.5
    """Duration of each movement, s."""
    sharp_share: Share = 0.3
    """Share of images rendered at twice the size and reduced, which resembles a real camera."""
    jpeg_quality_min: Annotated[int, Range(30, 100)] = 85
    jpeg_quality_max: Quality = 100
    jobs: Jobs = 0
    """Parallel processes; 0: one per core. Does not change the images."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if max(self.count, self.held) > MOST_SCENES * self.per_scene:
            raise ValueError(f"expected {MOST_SCENES} scenes at most; set per_scene higher")
        if not self.kinds or not set(self.kinds) <= set(KINDS):
            raise ValueError(f"kinds: expected some of {', '.join(KINDS)}, found {', '.join(self.kinds) or 'none'}")
        if self.held and set(self.kinds) <= {CORRIDOR}:
            raise ValueError(f"held: {CORRIDOR} is one scene, used for training; name another kind or set held = 0")
        if self.jpeg_quality_min > self.jpeg_quality_max:
            raise ValueError("expected jpeg_quality_min up to jpeg_quality_max")


@dataclass(frozen=True)
class AugmentConfig(Checked):
    """Image augmentation; a `..._share` is the probability for each image."""

    brightness: Fraction = 0.3
    """Largest relative change of brightness."""
    contrast: Fraction = 0.25
    """Largest relative change of the differences from the mean."""
    colour: Fraction = 0.08
    """Largest relative change of each of red, green and blue."""
    blur_share: Share = 0.3
    blur_px: Annotated[float, Range(0, 5, above=True)] = 0.9
    """Largest standard deviation of the blur, px."""
    noise_share: Share = 0.3
    noise: Annotated[float, Range(0, 64)] = 6.0
    """Largest standard deviation of the noise, grey levels of 255."""
    jpeg_share: Share = 0.5
    jpeg_quality_min: Quality = 40
    jpeg_quality_max: Quality = 95

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.jpeg_quality_min > self.jpeg_quality_max:
            raise ValueError("expected jpeg_quality_min up to jpeg_quality_max")


@dataclass(frozen=True)
class EncoderConfig(Checked):
    """Training of the vision encoder on the simulator's labels."""

    frames: FramesConfig = field(default_factory=FramesConfig)
    epochs: Count = 2
    batch: Count = 64
    """Images per step over all ranks."""
    optim: OptimConfig = field(
        default_factory=lambda: OptimConfig(
            lr=1e-3, final_lr_share=0.02, weight_decay=0.02, warmup_steps=500, bf16=True
        )
    )
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    mirrored: Share = 0.5
    """Share of mirrored images: later stages train on mirrored drives."""
    checkpoint_steps: Count = 500
    """Steps between two checkpoints."""
    look_steps: Count = 500
    """Steps between two evaluations on held-out images."""
    look_frames: Natural = 768
    """Held-out images of such an evaluation; the last one uses all."""
