"""Training pictures look different each time and show the same: nothing is moved, turned or mirrored."""

from __future__ import annotations

import numpy as np
import pytest

from tools.train.config.encoder import AugmentConfig
from tools.train.samples.augment import augmented, decoded, encoded, through_jpeg

STILL = AugmentConfig(brightness=0.0, contrast=0.0, colour=0.0, blur_share=0.0, noise_share=0.0, jpeg_share=0.0)


def picture() -> np.ndarray:
    """Dark on the left and below, bright on the right; a red square in the upper left."""
    shown = np.tile(np.linspace(40, 200, 128), (128, 1))[..., None].repeat(3, axis=2)
    shown[20:50, 20:50] = (220, 30, 30)
    shown[100:] *= 0.5
    return shown.astype(np.uint8)


def test_with_nothing_to_change_it_stays_as_it_is() -> None:
    assert np.array_equal(augmented(picture(), STILL, np.random.default_rng(1)), picture())


def test_the_same_numbers_give_the_same_picture_and_others_another() -> None:
    one, same, other = (augmented(picture(), AugmentConfig(), np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert one.dtype == np.uint8 and one.shape == (128, 128, 3)
    assert np.array_equal(one, same) and not np.array_equal(one, other)


def test_left_stays_left_and_things_stay_where_they_are() -> None:
    for seed in range(40):
        seen = augmented(picture(), AugmentConfig(), np.random.default_rng(seed)).astype(float)
        assert seen[60:90, :40].mean() < seen[60:90, 88:].mean()
        red = seen[..., 0] - seen[..., 1]
        assert red[25:45, 25:45].mean() > 60 and red[60:, 60:].mean() < 30


def test_jpeg_comes_back_as_the_picture_in_the_same_colours() -> None:
    off = np.abs(decoded(encoded(picture(), 95)).astype(int) - picture())
    assert off.mean() < 3
    assert off.mean() < np.abs(through_jpeg(picture(), 10).astype(int) - picture()).mean()


def test_what_is_no_jpeg_is_refused() -> None:
    with pytest.raises(ValueError, match="expected a JPEG"):
        decoded(np.zeros(10, np.uint8))
