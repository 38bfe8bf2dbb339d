"""Augmentation of images (light, colour, blur, noise, JPEG), and of the language model's samples.

Images are neither mirrored nor shifted, because left, right and position matter for navigation. A small language model
would memorise the tokens of a thousand places: its frames are shifted by up to 0.3 s, within which an anchor's text is
valid, and its visual tokens have noise.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.core.geometry import SE2
from edge.reasoning.path_memory import prompt_point
from tools.train.config.encoder import AugmentConfig
from tools.train.config.sft import AROUND, ShowConfig
from tools.train.samples.anchors import Anchor, frames_at

if TYPE_CHECKING:  # workers that draw pictures start without torch
    from tools.train.samples.language_batch import Halves

Picture = NDArray[np.uint8]


def augmented(picture: Picture, config: AugmentConfig, rng: np.random.Generator) -> Picture:
    """Return a randomly changed copy of an image [height, width, 3]."""
    turned = rng.uniform(-1.0, 1.0, 5)
    chance = rng.uniform(size=3)
    amount = rng.uniform(size=3)
    seen = picture
    if chance[0] < config.blur_share:
        seen = np.asarray(cv2.GaussianBlur(seen, (0, 0), 0.2 + amount[0] * config.blur_px), np.uint8)
    light = seen.astype(np.float32)
    gains = (1 + config.brightness * turned[0]) * (1 + config.colour * turned[1:4])
    middle = light.mean()
    light = (middle + (light - middle) * np.float32(1 + config.contrast * turned[4])) * gains.astype(np.float32)
    if chance[1] < config.noise_share:
        light += rng.standard_normal(light.shape, np.float32) * np.float32(amount[1] * config.noise)
    changed: Picture = np.clip(np.rint(light), 0, 255).astype(np.uint8)
    if chance[2] < config.jpeg_share:
        span = config.jpeg_quality_max - config.jpeg_quality_min
        changed = through_jpeg(changed, config.jpeg_quality_min + round(float(amount[2]) * span))
    return changed


def encoded(picture: Picture, quality: int) -> NDArray[np.uint8]:
    """Encode an RGB image [height, width, 3] as JPEG bytes. Raises ValueError."""
    done, data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ValueError(f"an image of shape {picture.shape} cannot be encoded as JPEG")
    return np.asarray(data, np.uint8).ravel()


def decoded(data: NDArray[np.uint8]) -> Picture:
    """Decode JPEG bytes to an RGB image [height, width, 3]. Raises ValueError."""
    picture = cv2.imdecode(data, cv2.IMREAD_COLOR)
    if picture is None:
        raise ValueError(f"expected a JPEG, found {len(data)} other bytes")
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), np.uint8)


def through_jpeg(picture: Picture, quality: int) -> Picture:
    """Encode and decode an image with JPEG."""
    return decoded(encoded(picture, quality))


def shifted(anchor: Anchor, config: ShowConfig, rng: np.random.Generator) -> Anchor:
    """Shift an anchor by a few frames if the drive has them; the number of draws from `rng` is always the same."""
    by = int(rng.integers(-config.shift_frames, config.shift_frames + 1))
    jitter = rng.integers(-config.jitter_frames, config.jitter_frames + 1, 8)
    points = anchor.around[AROUND + by] if anchor.around else None
    T_shown_anchor = anchor.moved[AROUND + by] if anchor.moved else None
    if anchor.waited or points is None or T_shown_anchor is None:
        return anchor
    return replace(
        anchor,
        k=anchor.k + by,
        way=tuple(prompt_point(T_shown_anchor @ SE2(x_m, y_m, 0.0)) for x_m, y_m in anchor.way),
        frames=_jittered(frames_at(anchor.k + by), jitter),
        points=points,
        reasoning=replace(anchor.reasoning, waypoints=points),
    )


def _jittered(frames: tuple[int, ...], jitter: NDArray[np.int64]) -> tuple[int, ...]:
    """Shift the older frames; their order is kept."""
    found: list[int] = []
    for frame, by in zip(frames[:-1], jitter, strict=False):
        found.append(min(max(frame + int(by), found[-1] + 1 if found else 0), frames[-1] - 1))
    return (*found, frames[-1]) if len(set(found)) == len(found) else frames


def disturbed(frames: tuple[Halves, ...], config: ShowConfig, rng: np.random.Generator) -> tuple[Halves, ...]:
    """Add noise to the visual tokens [N, D] of each frame and set some of them to zero."""
    shown: list[Halves] = []
    for tokens in frames:
        values = tokens.astype(np.float32)
        noise = rng.standard_normal(values.shape, np.float32) * np.float32(config.noise * float(values.std()))
        kept = rng.uniform(size=(len(values), 1)) >= config.drop
        shown.append(np.asarray((values + noise) * kept, np.float16))
    return tuple(shown)
