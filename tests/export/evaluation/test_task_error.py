"""The metric that decides about rounding: exact for the same model, growing with damage, told by age of the state."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import pytest
import torch

from edge.core.geometry import SE2
from edge.motion.controller import arc_to
from edge.reasoning.prompt import Segment
from export.evaluation.calibration import CalibrationError, CalibrationSet, load_calibration
from export.evaluation.precision_search import search_samples
from export.evaluation.task_error import (
    StageOutputs,
    TaskErrorError,
    TaskResult,
    TorchStages,
    compare,
    compare_plans,
    empty_past,
    prompt_parts,
    prompt_tensors,
    run_stages,
    spread,
)
from export.evaluation.task_samples import DELAYS_S, SampleSet, check_clips, samples_from
from export.model.config import PRESETS
from export.model.network import TicVla, build
from export.model.tokenizers.nano import NANO_TOKENIZER
from export.quantize.precision import Precision

NANO = PRESETS["nano"]
OFFSETS_S = (0.0, 3.0, 6.0, 9.0)
GRAPHS = ("vision_encoder", "language_model", "semantic_context", "action_expert")


@pytest.fixture(scope="module")
def model() -> TicVla:
    torch.set_num_threads(1)
    return build(NANO, 0)


@pytest.fixture(scope="module")
def calibration() -> CalibrationSet:
    return load_calibration("corridor-go2")


@pytest.fixture(scope="module")
def samples(calibration: CalibrationSet) -> SampleSet:
    return samples_from(calibration, NANO, OFFSETS_S, NANO_TOKENIZER.read_bytes(), anchors_per_clip=1)


@pytest.fixture(scope="module")
def reference(model: TicVla, samples: SampleSet) -> StageOutputs:
    return run_stages(TorchStages(model), samples, new_tokens=4)


@pytest.fixture(scope="module")
def few(calibration: CalibrationSet) -> SampleSet:
    """Two generations of two frames, three delays: for laws that hold on any samples."""
    clips = dataclasses.replace(calibration, clips=calibration.clips[:2])
    delays_s, tokenizer = (0.0, 3.0, 10.0), NANO_TOKENIZER.read_bytes()
    return samples_from(clips, NANO, (0.0, 3.0), tokenizer, delays_s=delays_s, anchors_per_clip=1)


@pytest.fixture(scope="module")
def few_reference(model: TicVla, few: SampleSet) -> StageOutputs:
    return run_stages(TorchStages(model), few)


class BrokenKv(TorchStages):
    """A language model whose last-layer K and V are wrong by a share of their size."""

    def __init__(self, model: TicVla, share: float) -> None:
        super().__init__(model)
        self._share = share

    def language(self, prompt: Sequence[Segment], new_tokens: int) -> tuple[np.ndarray, tuple[int, ...]]:
        kv, ids = super().language(prompt, new_tokens)
        noise = np.random.default_rng(0).standard_normal(kv.shape).astype(np.float32)
        return kv + self._share * float(kv.std()) * noise, ids


class DeafToAge(TorchStages):
    """An action expert that does not hear how old its semantic state is."""

    def act(
        self, visual_tokens: np.ndarray, state: np.ndarray, latency: np.ndarray, *context: np.ndarray
    ) -> np.ndarray:
        return super().act(visual_tokens, state, np.zeros_like(latency), *context)


def error_of(stages: TorchStages, reference: StageOutputs, samples: SampleSet, new_tokens: int = 0) -> TaskResult:
    return compare(reference, run_stages(stages, samples, new_tokens=new_tokens), samples)


def test_a_generation_sees_four_frames_and_drives_a_moment_of_every_delay(
    calibration: CalibrationSet, samples: SampleSet
) -> None:
    assert all([moment.delay_s for moment in sample.moments] == list(DELAYS_S) for sample in samples.samples)
    seen = [part.frame for part in samples.samples[0].prompt if part.frame is not None]
    assert len(seen) == 4
    # The newest of them is the frame at Δt = 0: nothing is encoded twice.
    assert samples.samples[0].moments[0].frame == seen[-1]
    assert len(samples.frames) == 3 * (4 + len(DELAYS_S) - 1)


def test_the_motion_offset_is_how_far_the_robot_has_moved(calibration: CalibrationSet, samples: SampleSet) -> None:
    frames = calibration.clips[0].frames
    first, *_, last = samples.samples[0].moments
    assert first.offset.as_tuple() == pytest.approx((0, 0, 0), abs=1e-9)
    moved = frames[9].T_odom_base.inverse() @ frames[19].T_odom_base
    assert last.offset.as_tuple() == pytest.approx(moved.as_tuple(), abs=1e-6)
    assert last.latency[0] == 10.0
    assert last.state == frames[19].velocity


def test_the_large_model_gets_one_sample_a_clip(calibration: CalibrationSet) -> None:
    large = samples_from(calibration, PRESETS["1b"], OFFSETS_S, NANO_TOKENIZER.read_bytes())
    assert len(large.samples) == 3 and len(large.frames) == 30
    assert len(samples_from(calibration, NANO, OFFSETS_S, NANO_TOKENIZER.read_bytes()).samples) == 6


@pytest.mark.parametrize("model", ["1b", "nano"])
def test_one_clip_is_enough_for_either_model(calibration: CalibrationSet, model: str) -> None:
    one, tokenizer = dataclasses.replace(calibration, clips=calibration.clips[:1]), NANO_TOKENIZER.read_bytes()
    check_clips(one, OFFSETS_S)
    assert len(samples_from(one, PRESETS[model], OFFSETS_S, tokenizer).samples) == 2
    assert len(search_samples(one, PRESETS[model], OFFSETS_S, tokenizer).samples) == 2


def test_clips_too_short_for_a_targets_frames_are_refused_before_any_work(calibration: CalibrationSet) -> None:
    with pytest.raises(CalibrationError, match="too short for frames 12 s back and a delay of 10 s"):
        check_clips(calibration, (0.0, 12.0))
    one = dataclasses.replace(calibration, clips=calibration.clips[:1])
    with pytest.raises(CalibrationError, match=r"has one clip of 20 s, .* give pictures of 42 s, or smaller runtime"):
        check_clips(one, (0.0, 10.0))


def test_one_clip_with_one_anchor_cannot_be_compared(calibration: CalibrationSet) -> None:
    one = dataclasses.replace(calibration, clips=calibration.clips[:1])
    with pytest.raises(CalibrationError, match="two samples are needed"):
        samples_from(one, NANO, OFFSETS_S, NANO_TOKENIZER.read_bytes(), anchors_per_clip=1)


@pytest.mark.slow
def test_the_same_stages_have_no_error(model: TicVla, reference: StageOutputs, samples: SampleSet) -> None:
    error = error_of(TorchStages(model), reference, samples, new_tokens=4)
    assert (error.waypoint_cm, error.heading_deg, error.speed_mps, error.turn_radps, error.relative) == (0,) * 5
    assert (error.kv_cosine, error.token_agreement) == (1, 1)


@pytest.mark.slow
def test_a_prompt_in_one_call_gives_what_the_runtimes_chunks_give(
    model: TicVla, reference: StageOutputs, samples: SampleSet
) -> None:
    past, parts = empty_past(model), []
    for segment in prompt_parts(samples.samples[0], reference.visual):
        with torch.no_grad():
            _, past, kv = model.language.hidden_states(*prompt_tensors(model, [segment]), past)
        parts.append(kv.numpy())
    assert np.concatenate(parts, axis=1) == pytest.approx(reference.kv[0], abs=1e-4)


@pytest.mark.slow
def test_every_delay_has_a_figure_of_its_own(model: TicVla, reference: StageOutputs, samples: SampleSet) -> None:
    error = error_of(BrokenKv(model, 0.5), reference, samples)
    assert [delay_s for delay_s, _ in error.by_delay_cm] == list(DELAYS_S)
    assert error.waypoint_cm == max(worst_cm for _, worst_cm in error.by_delay_cm)


@pytest.mark.slow
def test_forgetting_the_age_of_the_state_hurts_more_the_older_it_is(
    model: TicVla, few_reference: StageOutputs, few: SampleSet
) -> None:
    worst_cm = [cm for _, cm in error_of(DeafToAge(model), few_reference, few).by_delay_cm]
    assert worst_cm[0] == 0 < worst_cm[1] < worst_cm[2]


@pytest.mark.slow
def test_the_more_the_cache_is_broken_the_larger_the_error(
    model: TicVla, few_reference: StageOutputs, few: SampleSet
) -> None:
    errors = [error_of(BrokenKv(model, share), few_reference, few) for share in (0.01, 0.1, 1.0)]
    for figure in ("waypoint_cm", "relative"):
        values = [getattr(error, figure) for error in errors]
        assert values == sorted(values) and values[0] < values[-1]
    assert errors[0].kv_cosine > errors[1].kv_cosine > errors[2].kv_cosine


@pytest.mark.slow
@pytest.mark.parametrize("graph", GRAPHS)
def test_fewer_bits_mean_more_error(model: TicVla, few_reference: StageOutputs, few: SampleSet, graph: str) -> None:
    def of(precision: str) -> float:
        relative = error_of(TorchStages(model, {graph: Precision(precision)}), few_reference, few).relative
        assert relative is not None
        return relative

    assert 0 < of("fp16") <= of("int8") <= of("int4-b32")


@pytest.mark.slow
def test_a_share_of_the_spread_shows_what_centimetres_hide(
    model: TicVla, few_reference: StageOutputs, few: SampleSet
) -> None:
    # Untrained, the head moves plans by millimetres whatever it sees: rounding looks exact until it is compared.
    error = error_of(TorchStages(model, {g: Precision("int4-b32") for g in GRAPHS}), few_reference, few)
    assert error.waypoint_cm < 5
    assert error.relative is not None and error.relative > 0.5


def test_text_that_differs_late_agrees_in_part(reference: StageOutputs, samples: SampleSet) -> None:
    changed = tuple((*ids[:-1], ids[-1] + 1) for ids in reference.token_ids)
    found = dataclasses.replace(reference, token_ids=changed)
    lengths = [len(ids) for ids in reference.token_ids]
    expected = sum((n - 1) / n for n in lengths) / len(lengths)
    assert compare(reference, found, samples).token_agreement == pytest.approx(expected, abs=1e-3)


def _plans(samples: SampleSet, step: tuple[float, float, float]) -> list[np.ndarray]:
    one = np.cumsum(np.tile(np.array(step, np.float32), (30, 1)), axis=0)
    return [np.tile(one, (len(sample.moments), 1, 1)) for sample in samples.samples]


def test_the_figures_are_in_the_units_they_name(samples: SampleSet) -> None:
    straight, turning = _plans(samples, (0.05, 0.0, 0.0)), _plans(samples, (0.05, 0.001, math.radians(1)))
    errors = compare_plans(straight, turning, samples)
    assert errors["waypoint_cm"] == pytest.approx(1.55, rel=1e-3)
    assert errors["heading_deg"] == pytest.approx(30, rel=1e-3)
    speed, turn = arc_to(SE2(0.5, 0.01, math.radians(10)), 1.0)
    assert errors["speed_mps"] == pytest.approx(abs(speed - 0.5), abs=1e-6)
    assert errors["turn_radps"] == pytest.approx(abs(turn), rel=1e-3)


def test_the_spread_is_the_plans_distance_to_their_mean() -> None:
    plans = np.zeros((2, 30, 3), np.float32)
    plans[0, :, 1], plans[1, :, 1] = 0.02, -0.02
    plans[:, -1, 2] = math.radians(3), -math.radians(3)
    assert spread(plans) == pytest.approx((2.0, 3.0), rel=1e-3)


@pytest.mark.parametrize("damage", [lambda p: p * np.nan, lambda p: p[:, :20]])
def test_plans_that_cannot_be_compared_are_refused(reference: StageOutputs, samples: SampleSet, damage: object) -> None:
    found = dataclasses.replace(reference, trajectories=tuple(damage(p) for p in reference.trajectories))  # type: ignore[operator]
    with pytest.raises(TaskErrorError):
        compare(reference, found, samples)


def test_a_heading_error_across_half_a_turn_is_small(samples: SampleSet) -> None:
    a, b = _plans(samples, (0.0, 0.0, 0.0)), _plans(samples, (0.0, 0.0, 0.0))
    for plan_a, plan_b in zip(a, b, strict=True):
        plan_a[..., 2], plan_b[..., 2] = math.pi - 0.01, -math.pi + 0.01
    assert compare_plans(a, b, samples)["heading_deg"] == pytest.approx(math.degrees(0.02), rel=1e-2)
