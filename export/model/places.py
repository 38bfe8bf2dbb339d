"""Codes of places that a network begins with: sines of every length, smooth along a line or over a picture.

Learned from nearly nothing they were still nearly nothing after a thousand steps, beside tokens forty times as large: a
short training does not find out where in a picture or in a sentence a token stands.
"""

from __future__ import annotations

from math import isqrt, pi
from typing import Final

import torch
from torch import Tensor

RMS: Final = 0.5
"""Of a code's numbers; those of tokens are about 1."""
_SHORTEST: Final = 4.0  # wavelength, places


def line_codes(count: int, width: int) -> Tensor:
    """[count, width] float32: codes of the places 0, 1, … on a line."""
    pairs = (width + 1) // 2
    lengths = _SHORTEST * float(count) ** (torch.arange(pairs) / max(pairs - 1, 1))
    angle = 2 * pi * torch.arange(count)[:, None] / lengths
    return (RMS * 2**0.5 * torch.stack([angle.sin(), angle.cos()], dim=-1)).flatten(1)[:, :width]


def grid_codes(count: int, width: int) -> Tensor:
    """[count, width] float32: codes of a square's places, row by row; its rows in one half of the numbers.

    Raises ValueError for a count that is no square.
    """
    side = isqrt(count)
    if side * side != count:
        raise ValueError(f"places: expected a square number of tokens, found {count}")
    rows, columns = line_codes(side, width // 2), line_codes(side, width - width // 2)
    return torch.cat([rows.repeat_interleave(side, 0), columns.repeat(side, 1)], dim=1)
