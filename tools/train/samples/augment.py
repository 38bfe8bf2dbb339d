"""Image augmentation: light, colour, blur, noise and JPEG, as from other cameras.

Images are neither mirrored nor shifted, because left, right and position matter for navigation.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tools.train.config.encoder import AugmentConfig

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
    return np.ascontiguousarray(picture[..., ::-1])


def through_jpeg(picture: Picture, quality: int) -> Picture:
    """Encode and decode an image with JPEG."""
    return decoded(encoded(picture, quality))
