"""Camera frames in the vision encoder's input format."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np
import numpy.typing as npt


@dataclass(frozen=True)
class Frame:
    """One frame in the encoder's format, with its capture stamp and source JPEG."""

    stamp_ns: int
    pixels: npt.NDArray[np.uint8]
    """[1, px, px, 3], RGB."""
    jpeg: bytes


def fit_frame(rgb: npt.NDArray[np.uint8], image_px: int) -> npt.NDArray[np.uint8]:
    """Resize a camera image [h, w, 3] to [1, px, px, 3]: the whole field of view, as InternVL's single tile."""
    if rgb.ndim != 3 or rgb.shape[2] != 3 or rgb.dtype != np.uint8:
        raise ValueError(f"expected a uint8 image [h, w, 3], found {rgb.dtype}{list(rgb.shape)}")
    shrinks = rgb.shape[0] > image_px
    resized = cv2.resize(rgb, (image_px, image_px), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
    return cast(npt.NDArray[np.uint8], resized[None])
