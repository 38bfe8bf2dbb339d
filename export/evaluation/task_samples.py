"""Samples of the task error: situations in which the robot drives with an old semantic state (paper §3.2).

A sample is one generation (prompt with frames at t, t−3, t−6, t−9 s) and moments after it, Δt = 0…10 s: the frame of
that moment, the robot's state, and its motion since the capture of the generation's newest frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from tokenizers import Tokenizer

from edge.core.geometry import SE2, interpolate
from edge.reasoning.path_memory import past_path_of
from edge.reasoning.prompt import PromptBuilder, PromptIds
from edge.state.frame import fit_frame
from edge.state.reasoning_text import WAYPOINT_TIMES_S
from edge.state.ring import EncodedFrame
from export.evaluation.calibration import CLIP_S, CalibrationError, CalibrationSet, Clip
from export.model.config import TicVlaConfig

Picture = npt.NDArray[np.uint8]

DELAYS_S = (0.0, 1.0, 2.0, 3.0, 5.0, 7.0, 10.0)
LARGE_FRAME_MACS = 2e10
"""Multiply-adds of one encoder frame above which a model counts as large: one sample per clip then takes minutes."""
FRAME_TOLERANCE_S = 0.6


@dataclass(frozen=True)
class Moment:
    """One control tick Δt after the anchor; `frame` is an index into `SampleSet.frames`."""

    delay_s: float
    frame: int
    state: tuple[float, float, float]
    """(vx m/s, vy m/s, ωz rad/s)."""
    offset: SE2
    """Motion offset (Δx, Δy, Δθ) in the robot frame at the anchor."""

    @property
    def latency(self) -> tuple[float, float, float, float]:
        """(Δt, Δx, Δy, Δθ), the action expert's latency input."""
        return (self.delay_s, *self.offset.as_tuple())


@dataclass(frozen=True)
class PromptPart:
    """Consecutive prompt tokens and the frame (index into `SampleSet.frames`) whose tokens they contain."""

    ids: tuple[int, ...]
    frame: int | None


@dataclass(frozen=True)
class Sample:
    """One generation and the moments that use its semantic state."""

    name: str
    prompt: tuple[PromptPart, ...]
    moments: tuple[Moment, ...]
    waypoints: tuple[tuple[float, float], ...] | None = None
    """For a model guided by waypoints: the recorded positions 3, 6 and 9 s after the anchor, in the robot frame at the
    anchor, in place of the language model's waypoints; None for a model guided by K‖V."""


@dataclass(frozen=True)
class SampleSet:
    """Samples over shared frames, uint8 RGB [1, px, px, 3] each."""

    frames: tuple[Picture, ...]
    samples: tuple[Sample, ...]
    step_s: float
    """Time between two points of a planned trajectory, s."""

    @property
    def moments(self) -> int:
        """Number of compared trajectories."""
        return sum(len(sample.moments) for sample in self.samples)


def is_large(config: TicVlaConfig) -> bool:
    """Return whether one encoder frame of the model takes seconds on a CPU."""
    vision = config.vision
    block = 4 * vision.hidden**2 + 2 * vision.hidden * vision.mlp
    return vision.layers * block * vision.grid**2 > LARGE_FRAME_MACS


def samples_from(
    calibration: CalibrationSet,
    config: TicVlaConfig,
    frame_offsets_s: Sequence[float],
    tokenizer: bytes,
    *,
    delays_s: Sequence[float] = DELAYS_S,
    anchors_per_clip: int | None = None,
) -> SampleSet:
    """Build samples of every clip: two anchors per clip, one for a large model unless there is a single clip.

    All delays of an anchor share its prefill, so a large model needs ten encoder frames and one prefill per clip.
    Raises CalibrationError.
    """
    language = config.language
    ids = PromptIds(
        language.im_start_id, language.im_end_id, language.img_start_id, language.img_end_id, language.img_context_id
    )
    builder = PromptBuilder(Tokenizer.from_buffer(tokenizer), ids, config.frame_tokens)
    count = anchors_per_clip or (1 if is_large(config) and len(calibration.clips) > 1 else 2)
    frames: dict[tuple[int, int], int] = {}
    pictures: list[Picture] = []

    def index_of(clip: int, frame: int) -> int:
        if (clip, frame) not in frames:
            frames[clip, frame] = len(pictures)
            pictures.append(fit_frame(calibration.clips[clip].frames[frame].image, config.vision.image_px))
        return frames[clip, frame]

    samples: list[Sample] = []
    for number, clip in enumerate(calibration.clips):
        for anchor_s in _anchors(clip, max(frame_offsets_s), max(delays_s), count):
            indices = sorted({_nearest(clip, anchor_s - offset_s) for offset_s in frame_offsets_s})
            encoded = [
                EncodedFrame(clip.frames[i].stamp_ns, clip.frames[i].T_odom_base, np.zeros(1, np.float32))
                for i in indices
            ]
            # The builder returns one segment per frame, then the tail, so the order gives each frame's tokens.
            way = past_path_of((frame.stamp_ns, frame.T_odom_base) for frame in clip.frames[: indices[-1] + 1])
            segments = builder.build(encoded, clip.instruction, way)
            places = [index_of(number, i) for i in indices]
            prompt = tuple(
                PromptPart(segment.ids, places[i] if segment.tokens is not None else None)
                for i, segment in enumerate(segments)
            )
            moments = []
            for delay_s in delays_s:
                i = _nearest(clip, anchor_s + delay_s)
                offset = _offset(clip, anchor_s, delay_s)
                moments.append(Moment(delay_s, index_of(number, i), clip.frames[i].velocity, offset))
            guided = config.action.semantic_interface == "waypoints"
            offsets = [_offset(clip, anchor_s, time_s) for time_s in WAYPOINT_TIMES_S] if guided else None
            waypoints = None if offsets is None else tuple((offset.x_m, offset.y_m) for offset in offsets)
            samples.append(Sample(f"{clip.name}@{anchor_s:g}s", prompt, tuple(moments), waypoints))
    if len(samples) < 2:
        raise CalibrationError(
            f"calibration set {calibration.name}: gives one sample, two samples are needed to compare"
        )
    longest = max(sum(len(part.ids) for part in sample.prompt) for sample in samples)
    if longest > language.max_context:
        raise CalibrationError(
            f"calibration set {calibration.name}: a prompt has {longest} tokens, the model reads {language.max_context}"
        )
    return SampleSet(tuple(pictures), tuple(samples), config.action.step_s)


def _anchors(clip: Clip, history_s: float, future_s: float, count: int) -> list[float]:
    first_s = clip.frames[0].stamp_ns / 1e9 + history_s
    last_s = clip.frames[-1].stamp_ns / 1e9 - future_s
    if last_s < first_s - FRAME_TOLERANCE_S:
        raise CalibrationError(
            f"clip {clip.name}: too short for frames {history_s:g} s back and a delay of {future_s:g} s"
        )
    last_s = max(first_s, last_s)
    if last_s - first_s < FRAME_TOLERANCE_S:
        count = 1  # all would use the same frames
    return [first_s + i * (last_s - first_s) / max(1, count - 1) for i in range(count)]


def check_clips(calibration: CalibrationSet, frame_offsets_s: Sequence[float]) -> None:
    """Check that the clips are long enough for a target's frames and every delay. Raises CalibrationError."""
    history_s, future_s = max(frame_offsets_s), max(DELAYS_S)
    anchors = [anchor_s for clip in calibration.clips for anchor_s in _anchors(clip, history_s, future_s, 2)]
    if len(anchors) < 2:
        raise CalibrationError(
            f"calibration set {calibration.name}: has one clip of {CLIP_S:g} s, which gives one sample and two are "
            f"needed to compare: give pictures of {2 * CLIP_S + 2:g} s, or smaller runtime.frame_offsets_s"
        )


def _nearest(clip: Clip, time_s: float) -> int:
    return min(range(len(clip.frames)), key=lambda i: abs(clip.frames[i].stamp_ns / 1e9 - time_s))


def _pose(clip: Clip, time_s: float) -> SE2:
    after = next((i for i, f in enumerate(clip.frames) if f.stamp_ns / 1e9 >= time_s), len(clip.frames) - 1)
    a, b = clip.frames[max(0, after - 1)], clip.frames[after]
    if a is b:
        return b.T_odom_base
    fraction = (time_s - a.stamp_ns / 1e9) / ((b.stamp_ns - a.stamp_ns) / 1e9)
    return interpolate(a.T_odom_base, b.T_odom_base, min(1.0, max(0.0, fraction)))


def _offset(clip: Clip, anchor_s: float, time_s: float) -> SE2:
    """Return the motion from the anchor to `time_s` after it, in the robot frame at the anchor."""
    return _pose(clip, anchor_s).inverse() @ _pose(clip, anchor_s + time_s)
