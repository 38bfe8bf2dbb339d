"""Augmentation of the language model's samples: frames shifted by up to 0.3 s, and noise on visual tokens.

A small model would memorise the tokens of a thousand places. The text of an anchor is valid for 0.3 s before and after
it; the waypoints are those of the shifted frame.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from edge.core.geometry import SE2
from edge.reasoning.path_memory import prompt_point
from tools.train.config.sft import AROUND, ShowConfig
from tools.train.samples.anchors import Anchor, frames_at
from tools.train.samples.language_batch import Halves


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
