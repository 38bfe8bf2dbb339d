"""Configuration of stage `encoder`: images, augmentation and training."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from tools.train.config.optim import OptimConfig
from tools.train.config.scenes import CORRIDOR, KINDS

MOST_SCENES: Final = 50_000
"""Upper limit of scenes per split; a layout that cannot be built is replaced by the one this many further on."""
OUTDOORS_LEAST: Final = 20
"""Fewest people in an outdoor scene."""


@dataclass(frozen=True)
class FramesConfig:
    """Number, scenes and rendering of images. A kind that is listed twice has twice as many scenes."""

    count: int = 120_000
    """Training images; 0: the encoder is not trained."""
    held: int = 6_000
    """Held-out images, in layouts that are never trained on."""
    per_scene: int = 600
    kinds: tuple[str, ...] = (
        "hospital", "office", "warehouse", "sidewalk", "hospital", "office", "warehouse", "sidewalk",
        "hospital", "office", "warehouse", "sidewalk", "hospital", "office", "warehouse", "corridor",
    )  # fmt: skip
    people_indoors: int = 60
    """Upper limit of people in one scene."""
    people_outdoors: int = 120
    moment: int = 8
    """Images taken before the people move."""
    moment_s: float = 0.5
    """Duration of each movement, s."""
    sharp_share: float = 0.3
    """Share of images rendered at twice the size and reduced, which resembles a real camera."""
    jpeg_quality_min: int = 85
    jpeg_quality_max: int = 100
    jobs: int = 0
    """Parallel processes; 0: one per core. Does not change the images."""

    def __post_init__(self) -> None:
        if not (0 <= self.count <= 10_000_000 and 0 <= self.held <= 1_000_000 and 1 <= self.per_scene <= 100_000):
            raise ValueError("expected count up to 10000000, held up to 1000000 and per_scene from 1 to 100000")
        if max(self.count, self.held) > MOST_SCENES * self.per_scene:
            raise ValueError(f"expected {MOST_SCENES} scenes at most; set per_scene higher")
        if not self.kinds or not set(self.kinds) <= set(KINDS):
            raise ValueError(f"kinds: expected some of {', '.join(KINDS)}, found {', '.join(self.kinds) or 'none'}")
        if self.held and set(self.kinds) <= {CORRIDOR}:
            raise ValueError(f"held: {CORRIDOR} is one scene, used for training; name another kind or set held = 0")
        if not (0 <= self.people_indoors <= 200 and OUTDOORS_LEAST <= self.people_outdoors <= 200):
            raise ValueError(f"expected up to 200 people, {OUTDOORS_LEAST} or more outdoors")
        if not (1 <= self.moment <= 1000 and 0 < self.moment_s <= 60 and 0 <= self.sharp_share <= 1):
            raise ValueError("expected moment from 1 to 1000, moment_s above 0 to 60 and sharp_share from 0 to 1")
        if not 30 <= self.jpeg_quality_min <= self.jpeg_quality_max <= 100 or not 0 <= self.jobs <= 1024:
            raise ValueError("expected jpeg_quality 30 <= min <= max <= 100 and 0 to 1024 jobs")


@dataclass(frozen=True)
class AugmentConfig:
    """Image augmentation; a `..._share` is the probability for each image."""

    brightness: float = 0.3
    """Largest relative change of brightness."""
    contrast: float = 0.25
    """Largest relative change of the differences from the mean."""
    colour: float = 0.08
    """Largest relative change of each of red, green and blue."""
    blur_share: float = 0.3
    blur_px: float = 0.9
    """Largest standard deviation of the blur, px."""
    noise_share: float = 0.3
    noise: float = 6.0
    """Largest standard deviation of the noise, grey levels of 255."""
    jpeg_share: float = 0.5
    jpeg_quality_min: int = 40
    jpeg_quality_max: int = 95

    def __post_init__(self) -> None:
        if not all(0 <= amount < 1 for amount in (self.brightness, self.contrast, self.colour)):
            raise ValueError("expected brightness, contrast and colour from 0 to below 1")
        if not all(0 <= share <= 1 for share in (self.blur_share, self.noise_share, self.jpeg_share)):
            raise ValueError("expected shares from 0 to 1")
        if not (0 < self.blur_px <= 5 and 0 <= self.noise <= 64):
            raise ValueError("expected blur_px above 0 to 5 and noise from 0 to 64")
        if not 1 <= self.jpeg_quality_min <= self.jpeg_quality_max <= 100:
            raise ValueError("jpeg_quality: expected 1 <= min <= max <= 100")


@dataclass(frozen=True)
class EncoderConfig:
    """Training of the vision encoder on the simulator's labels."""

    frames: FramesConfig = field(default_factory=FramesConfig)
    epochs: int = 2
    batch: int = 64
    """Images per step over all ranks."""
    optim: OptimConfig = field(
        default_factory=lambda: OptimConfig(
            lr=1e-3, final_lr_share=0.02, weight_decay=0.02, warmup_steps=500, bf16=True
        )
    )
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    mirrored: float = 0.5
    """Share of mirrored images: later stages train on mirrored drives."""
    checkpoint_steps: int = 500
    """Steps between two checkpoints."""
    look_steps: int = 500
    """Steps between two evaluations on held-out images."""
    look_frames: int = 768
    """Held-out images of such an evaluation; the last one uses all."""

    def __post_init__(self) -> None:
        if min(self.epochs, self.batch, self.checkpoint_steps, self.look_steps) < 1 or self.look_frames < 0:
            raise ValueError("expected epochs, batch, checkpoint_steps and look_steps from 1 on, look_frames from 0 on")
        if not 0 <= self.mirrored <= 1:
            raise ValueError(f"expected mirrored to be a share from 0 to 1, found {self.mirrored}")
