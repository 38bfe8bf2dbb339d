"""Precision follows from what rounding does to the plan: small where it may be, exact where it must be; not random."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from export.evaluation.calibration import load_calibration
from export.evaluation.parity import reference_outputs, sample_inputs
from export.evaluation.precision_probe import Reading, Reference, group_of, probe
from export.evaluation.precision_search import Limits, Search, drop_dominated, search_samples
from export.evaluation.task_error import relative_error
from export.evaluation.task_samples import SampleSet
from export.graphs.build import linear_layers
from export.model.config import PRESETS
from export.model.network import TicVla, build
from export.model.tokenizers.nano import NANO_TOKENIZER
from export.model.weights import weights_sha256
from export.quantize.precision import Precision
from export.quantize.rounding import Rounder, round_u8
from export.targets.sections import Measured

NANO = PRESETS["nano"]
TINY = dataclasses.replace(
    NANO,
    vision=dataclasses.replace(NANO.vision, layers=2),
    language=dataclasses.replace(NANO.language, layers=3),
    action=dataclasses.replace(NANO.action, layers=2),
)
GRAPHS = ("vision_encoder", "language_model", "semantic_context", "action_expert")
LIMITS = Limits(waypoint_cm=5, heading_deg=3, speed_mps=0.05, turn_radps=0.05)


def point(precision: str, **time: float) -> Measured:
    return Measured("m", "g", precision, "fused", "cpu", "a machine", "2026-11-21", **time)


@pytest.fixture(scope="module")
def samples() -> SampleSet:
    torch.set_num_threads(1)
    calibration = load_calibration("corridor-go2")
    two = dataclasses.replace(calibration, clips=calibration.clips[:2])
    return search_samples(two, TINY, (0.0,), NANO_TOKENIZER.read_bytes())


@pytest.fixture(scope="module")
def model() -> TicVla:
    return build(TINY, 0)


@pytest.fixture(scope="module")
def search(model: TicVla, samples: SampleSet) -> Search:
    return Search(model, samples, trained=False)


@pytest.fixture(scope="module")
def reference(model: TicVla, samples: SampleSet) -> Reference:
    return Reference(model, samples, lambda _: None)


@pytest.fixture(scope="module")
def planted(samples: SampleSet) -> TicVla:
    """A model whose middle decoder layer has one huge weight in every block of 32, at inputs that are always zero."""
    model = build(TINY, 0)
    layer = model.language.layers[1]
    with torch.no_grad():
        for norm, readers in ((layer.input_norm, "qkv"), (layer.mlp_norm, ("gate", "up"))):
            norm.weight[::32] = 0
            for name in readers:
                getattr(layer, name).weight[:, ::32] = 3.0
    return model


def within(relative: float) -> Limits:
    return dataclasses.replace(LIMITS, relative=relative)


@pytest.mark.slow
@pytest.mark.parametrize("graph", GRAPHS)
def test_the_search_leaves_every_weight_as_it_was(model: TicVla, search: Search, graph: str) -> None:
    before = weights_sha256(model)
    search.choose(graph, ["fp16", "int8", "int4-b32"], within(1e-3))
    assert weights_sha256(model) == before
    assert not any(module._forward_hooks or module._forward_pre_hooks for module in model.modules())


@pytest.mark.slow
def test_an_interrupted_search_leaves_every_weight_as_it_was(model: TicVla) -> None:
    before, layers = weights_sha256(model), linear_layers(TINY, "language_model")
    model.language.layers[2].gate.register_forward_pre_hook(_interrupt)
    ids, past = torch.ones(1, 4, dtype=torch.long), [torch.zeros(1, 2, 0, 64)] * 6
    try:
        with (
            torch.no_grad(),
            pytest.raises(KeyboardInterrupt),
            Rounder().applied(model.language, Precision("int4-b32"), layers),
        ):
            model.language.hidden_states(ids, torch.zeros(1, 64, 256), past)
    finally:
        model.language.layers[2].gate._forward_pre_hooks.clear()
    assert weights_sha256(model) == before


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt


@pytest.mark.slow
@pytest.mark.parametrize("graph", GRAPHS)
def test_fewer_bits_mean_more_error(reference: Reference, graph: str) -> None:
    found = probe(reference, graph, Rounder(), activations=True)
    errors = [found.whole(Precision(p)).output_error for p in ("fp32", "fp16", "int8", "int4-b32")]
    assert errors == sorted(errors) and errors[0] == 0 < errors[1] < errors[-1]


@pytest.mark.slow
@pytest.mark.parametrize("graph", ["language_model", "language_model.decode"])
def test_rounding_one_layer_from_its_kept_input_is_rounding_it_in_the_whole(reference: Reference, graph: str) -> None:
    found = probe(reference, graph, Rounder(), activations=True)
    for group in ("layers.0.*", "layers.2.*", "lm_head"):
        alone = found.group(group, "int8")
        whole = found.whole(Precision("fp32", ((group, "int8"),)))
        assert dataclasses.astuple(alone) == pytest.approx(dataclasses.astuple(whole), rel=2e-3, abs=1e-5)


def test_rounding_one_block_of_the_encoder_from_its_kept_input_is_rounding_it_in_the_whole(
    reference: Reference,
) -> None:
    """In the order of the search: the first block's rounding must not enter the inputs that are kept for the others."""
    found = probe(reference, "vision_encoder", Rounder(), activations=True)
    for block in ("blocks.0.*", "blocks.1.*"):
        errors = []
        rounded = Precision("fp32", ((block, "int4-b32"),))
        with torch.no_grad(), Rounder().applied(reference.model.vision, rounded, found.layers):
            for frame in {sample.moments[0].frame for sample in reference.samples.samples}:
                tokens = reference.model.vision(torch.from_numpy(reference.samples.frames[frame])).numpy()
                errors.append(relative_error(reference.visual[frame], tokens))
        assert found.group(block, "int4-b32").output_error == pytest.approx(max(errors), rel=1e-3)


@pytest.mark.slow
def test_decoding_is_held_to_the_tensors_of_the_gate(reference: Reference) -> None:
    """The gate has refused a decoding graph in which the text after exact frames looked well."""
    precision = Precision("int4-b32")
    found = probe(reference, "language_model.decode", Rounder(), activations=True).whole(precision)
    errors = []
    for index in range(8):
        feeds = sample_inputs(reference.model.config, "language_model.decode", index)
        layers = linear_layers(reference.model.config, "language_model.decode")
        with torch.no_grad():
            exact = reference_outputs(reference.model, "language_model.decode", feeds)
        with torch.no_grad(), Rounder().applied(reference.model.language, precision, layers):
            rounded = reference_outputs(reference.model, "language_model.decode", feeds)
        errors += [relative_error(exact[name], rounded[name]) for name in ("logits", "last_layer_kv")]
    assert found.output_error == pytest.approx(max(errors), rel=1e-3)


@pytest.mark.slow
def test_prefill_chooses_no_token_and_decoding_does(reference: Reference) -> None:
    prefill = probe(reference, "language_model.prefill", Rounder(), activations=True)
    decode = probe(reference, "language_model.decode", Rounder(), activations=True)
    assert prefill.whole(Precision("int8")).top1 is None
    assert decode.whole(Precision("fp16")).top1 == 1.0


def test_the_vocabulary_matters_to_the_token_and_not_to_the_plan(reference: Reference) -> None:
    reading = probe(reference, "language_model", Rounder(), activations=True).group("lm_head", "int4-b32")
    assert reading.relative == reading.output_error == 0
    assert reading.top1 is not None and reading.top1 < 1


@pytest.mark.slow
def test_when_even_the_most_exact_candidate_is_outside_the_decision_reports_it(search: Search) -> None:
    decision = search.choose("language_model", ["int8-b32", "int4-b32"], within(1e-6))
    assert decision.precision == Precision("int8-b32") and not decision.within_limits
    assert "outside the limits" in decision.reason


@pytest.mark.slow
def test_a_planted_sensitive_layer_is_found_and_raised(planted: TicVla, samples: SampleSet) -> None:
    search = Search(planted, samples, trained=True)
    candidates = ["fp16", "int4-b32"]
    spoilt = search.choose("language_model", candidates, within(10)).table
    assert spoilt[1].group == "layers.1.*"
    assert spoilt[1].output_error > 2 * spoilt[2].output_error
    # Limits that int4 keeps everywhere else: that one layer is raised, and no other.
    limit = 1.2 * max(row.relative for row in spoilt[2:] if row.relative is not None)
    whole = next(row.relative for row in spoilt if row.group == "*")
    assert whole is not None and limit < whole
    decision = search.choose("language_model", candidates, within(max(limit, 0.75 * whole)))
    assert decision.precision == Precision("int4-b32", (("layers.1.*", "fp16"),))
    assert "layers.1.* raised to fp16, the most sensitive of" in decision.reason
    exact = search.bytes_of("language_model", Precision("fp16"))
    assert search.bytes_of("language_model", Precision("int4-b32")) < decision.weight_bytes < exact


@pytest.mark.slow
def test_the_table_ranks_every_group_of_layers(search: Search) -> None:
    decision = search.choose("language_model", ["fp16", "int4-b32"], LIMITS)
    rows = [row for row in decision.table if row.group != "*"]
    names = {group_of(layer) for layer in linear_layers(TINY, "language_model")}
    assert {row.group for row in rows} == names
    loads = [row.load for row in rows]
    assert None not in loads and loads == sorted(loads, reverse=True)  # type: ignore[type-var]


@pytest.mark.slow
def test_a_single_candidate_is_measured_and_kept(search: Search) -> None:
    decision = search.choose("action_expert", ["int8"], LIMITS)
    assert decision.precision == Precision("int8") and len(decision.table) == 1
    assert search.choose("action_expert", ["fp32"], LIMITS).reason == "fp32: the only candidate"


def test_tokens_are_only_judged_when_the_weights_are_trained() -> None:
    limits, reading = dataclasses.replace(LIMITS, top1=0.9), Reading(0, 0, 0, 0, 0, 0, 0.7)
    assert limits.load(reading, trained=False) == 0
    assert limits.load(reading, trained=True) == pytest.approx(3)


def test_no_share_of_equal_tokens_may_be_asked_for() -> None:
    reading = Reading(0, 0, 0, 0, 0, 0, 0.7)
    assert dataclasses.replace(LIMITS, top1=0.0).load(reading, trained=True) < 1


@pytest.mark.parametrize("field", ["waypoint_cm", "relative"])
def test_limits_must_be_positive(field: str) -> None:
    with pytest.raises(ValueError, match=field):
        dataclasses.replace(LIMITS, **{field: 0})


SIZES = {"fp32": 400, "fp16": 200, "int8-b128": 103, "int8-b32": 112}


def test_a_variant_that_is_neither_smaller_nor_measured_faster_is_dropped() -> None:
    kept, dropped = drop_dominated("g", list(SIZES), SIZES, ())
    assert kept == ("fp32", "fp16", "int8-b128")
    assert [item.precision for item in dropped] == ["int8-b32"]
    assert "not smaller than the more exact int8-b128" in dropped[0].reason


def test_a_larger_variant_stays_when_it_was_measured_faster() -> None:
    measured = [point("int8-b128", tokens_per_s=20.0), point("int8-b32", ms=40.0)]
    assert drop_dominated("g", list(SIZES), SIZES, measured)[0] == tuple(SIZES)
    assert "int8-b32" not in drop_dominated("other", list(SIZES), SIZES, measured)[0]


def test_where_time_counts_a_smaller_variant_that_was_measured_slower_is_dropped() -> None:
    measured = [point("fp32", ms=802.0), point("fp16", ms=2307.0)]
    assert drop_dominated("g", ["fp32", "fp16"], SIZES, measured)[0] == ("fp32", "fp16")
    kept, dropped = drop_dominated("g", ["fp32", "fp16"], SIZES, measured, speed_first=True)
    assert kept == ("fp32",) and "slower than the more exact fp32 (2307 against 802 ms)" in dropped[0].reason


def test_rounding_to_eight_bits_keeps_zero_and_the_extremes() -> None:
    x = torch.tensor([-1.0, 0.0, 0.1234, 3.0])
    rounded = round_u8(x)
    assert rounded[1] == 0
    assert torch.allclose(rounded, x, atol=4 / 255 / 2 + 1e-6)
    assert torch.equal(round_u8(torch.zeros(3)), torch.zeros(3))


def test_the_large_model_is_searched_with_two_short_prompts() -> None:
    samples = search_samples(
        load_calibration("corridor-go2"), PRESETS["1b"], (0.0, 3.0, 6.0, 9.0), NANO_TOKENIZER.read_bytes()
    )
    assert len(samples.samples) == 2 and len(samples.frames) == 6
    assert all(sum(part.frame is not None for part in sample.prompt) == 1 for sample in samples.samples)


def test_a_graph_whose_own_output_moves_too_far_is_outside_although_its_plans_are_not() -> None:
    calm = Reading(0.1, 0.1, 0.001, 0.001, 0.01, output_error=0.3, top1=None)
    assert Limits(5, 3, 0.05, 0.05).load(calm, trained=False) < 1
    assert LIMITS.load(dataclasses.replace(calm, waypoint_cm=10.0), trained=False) == pytest.approx(2)
    assert Limits(5, 3, 0.05, 0.05, output_error=0.2).load(calm, trained=False) == pytest.approx(1.5)
