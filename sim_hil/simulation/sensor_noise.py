"""Noise of a camera sensor: consecutive images of a real camera always differ, rendered ones do not."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

SIGMA_LEVELS: Final = 1.5  # our choice, of 256 grey levels: a well-lit picture


class SensorNoise:
    """Gaussian noise for images of one size; drawn once and then shifted, because drawing takes milliseconds."""

    def __init__(self, width: int, height: int, seed: int) -> None:
        """`width`, `height` of the pictures, pixels."""
        self._rng = np.random.default_rng(seed)
        drawn = self._rng.normal(0.0, SIGMA_LEVELS, (2 * height, 2 * width, 3))
        self._noise = np.rint(drawn).astype(np.int16)

    def add(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the image [h, w, 3] with new noise."""
        height, width = rgb.shape[:2]
        y, x = self._rng.integers(0, (height, width))
        noise = self._noise[y : y + height, x : x + width]
        noisy: NDArray[np.uint8] = np.clip(rgb + noise, 0, 255).astype(np.uint8)
        return noisy
