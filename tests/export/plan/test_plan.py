"""The plan: what a target's figures say that a model takes, and that it refuses what does not fit."""

from __future__ import annotations

import dataclasses
import io

import pytest
from rich.console import Console

from edge.artifacts.manifest import MOST_ROWS
from export.graphs.build import linear_layers
from export.model.config import PRESETS
from export.plan.cost import DECODE, PREFILL, action_call, context_call, language_call, vision_call
from export.plan.plan import Plan, PlanError, plan
from export.plan.table import plan_table
from export.quantize.precision import Precision
from export.targets.file import Target, load_target, with_settings
from export.targets.sections import MEASURED, MODELLED, Measured

BIG, NANO = PRESETS["1b"], PRESETS["nano"]
FP32 = Precision("fp32")


def target(name: str, *settings: str, model: str = "1b") -> Target:
    return with_settings(load_target(name, model), settings)


def planned(name: str, *settings: str, tokens: int | None = None, text_tokens: int | None = None) -> Plan:
    return plan(target(name, *settings), BIG, tokens=tokens, text_tokens=text_tokens)


def stage(made: Plan, name: str) -> dict:
    return made.to_dict()["per_graph"][name]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["orin", "rtx4060"])
def test_the_paper_size_model_fits_the_two_boards_by_the_model(name: str) -> None:
    made = planned(name)
    assert made.fits, made.reasons
    assert made.tick.ms <= made.period_ms
    assert made.tokens > 0
    assert made.tagged == MODELLED


@pytest.mark.slow
def test_the_stock_25_watt_mode_is_refused_with_the_excess_and_advice() -> None:
    made = planned("orin", "power.mode=25W")
    assert not made.fits
    with pytest.raises(PlanError) as refusal:
        made.require()
    line = str(refusal.value)
    assert "\n" not in line
    for part in ("1b does not fit orin (25W)", "exceeds the period of 100 ms by", "vision_encoder takes", "40W"):
        assert part in line


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "setting", "reason"),
    [
        ("orin", "power.budget_w=20", "of a budget of 20 W"),
        ("orin", "runtime.max_delay_s=1", "the ceiling is 1 s"),
        ("rtx4060", "device.memory_gib=4", "exceeds the 3.00 GiB"),
    ],
)
def test_a_plan_that_exceeds_power_age_or_memory_names_the_limit(name: str, setting: str, reason: str) -> None:
    made = planned(name, setting)
    assert not made.fits and any(reason in line for line in made.reasons)


@pytest.mark.slow
@pytest.mark.parametrize("budget_w", [23.0, 25.0, 27.0])
def test_reasoning_gets_what_the_budget_leaves_and_never_more(budget_w: float) -> None:
    made = planned("orin", f"power.budget_w={budget_w}", "runtime.max_delay_s=60")
    assert made.average_w is not None
    assert made.average_w <= budget_w + 1e-6
    assert 0 < made.duty <= 1


@pytest.mark.slow
def test_tokens_are_cut_so_that_the_state_stays_young_enough() -> None:
    made = planned("orin", "runtime.max_delay_s=6")
    assert 0 < made.tokens < target("orin").runtime.max_new_tokens
    assert made.delay_s is not None and made.delay_s <= 6
    one_more = planned("orin", "runtime.max_delay_s=6", tokens=made.tokens + 1)
    assert one_more.delay_s is not None and one_more.delay_s > 6
    assert any("keep Δt in bounds" in warning for warning in made.warnings)


@pytest.mark.slow
def test_a_tick_waits_at_most_for_the_call_in_flight_where_both_threads_share_a_device() -> None:
    made = planned("orin")
    longest = max(stage(made, name)["call_ms"] for name in ("prefill", "decode", "semantic_context"))
    assert made.tick.ms == pytest.approx(made.tick_alone.ms + longest, abs=1e-3)


@pytest.mark.slow
def test_a_development_machine_reports_its_late_stages_and_is_not_refused() -> None:
    made = planned("cpu")
    assert not made.fits
    assert not target("cpu").runtime.enforce_plan


def test_average_power_is_idle_power_and_the_stages_energy_over_time() -> None:
    made = planned("orin", "runtime.max_delay_s=60", tokens=32)
    energy = {name: entry["energy_j"] for name, entry in made.to_dict()["per_graph"].items()}
    control_w = (energy["vision_encoder"] + energy["action_expert"]) / (made.period_ms / 1e3)
    generation_j = energy["prefill"] + energy["decode"] + energy["semantic_context"]
    assert made.generation is not None
    generation_w = generation_j / (made.generation.ms / 1e3 / made.duty)
    assert 4.6 + control_w + generation_w == pytest.approx(made.average_w, rel=0.01)


def with_point(base: Target, **changes: object) -> Target:
    point = Measured(
        **{
            "model": "1b",
            "graph": "vision_encoder",
            "precision": "fp16",
            "form": "plain",
            "provider": "tensorrt",
            "machine": "the board in the laboratory",
            "date": "2026-11-21",
            "ms": 61.5,
            **changes,
        }
    )
    return dataclasses.replace(base, measured=(point,))


@pytest.mark.slow
def test_a_measured_point_replaces_the_model_and_names_its_device() -> None:
    entry = stage(plan(with_point(target("orin")), BIG), "vision_encoder")
    assert (entry["ms"], entry["tagged"], entry["bound"]) == (61.5, MEASURED, MEASURED)
    assert "the board in the laboratory, 2026-11-21" in entry["source"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {"precision": "fp32"},
        {"form": "fused"},
        {"provider": "cuda"},
        {"graph": "action_expert"},
        {"model": "nano"},
        {"mode": "25W"},
        {"overrides": {"blocks.0.fc1": "fp32"}},
    ],
)
def test_a_point_of_anything_else_replaces_nothing(changes: dict) -> None:
    entry = stage(plan(with_point(target("orin"), **changes), BIG), "vision_encoder")
    assert entry["tagged"] == MODELLED


@pytest.mark.slow
def test_a_point_at_another_length_only_scales_the_model() -> None:
    point = {"graph": "language_model", "precision": "int4-b32", "form": "fused", "provider": "cuda"}
    overridden = {"lm_head": "int8-b32"}
    base = with_point(target("orin"), **point, ms=50.0, tokens=400, chunk_tokens=128, overrides=overridden)
    entry = stage(plan(base, BIG), "prefill")
    assert entry["tagged"] == MODELLED
    assert "scaled by" in entry["source"]
    assert stage(plan(base, BIG), "decode")["source"].startswith("roofline of")
    assert 50.0 < entry["ms"] < 50.0 * (1100 / 400) ** 2


@pytest.mark.parametrize("config", [BIG, NANO], ids=["1b", "nano"])
def test_the_counted_layers_are_the_layers_of_the_graphs(config: object) -> None:
    calls = {
        "vision_encoder": vision_call(config),
        "language_model": language_call(config, "language_model", tokens=2, past=0),
        PREFILL: language_call(config, PREFILL, tokens=2, past=0),
        DECODE: language_call(config, DECODE, tokens=1, past=0),
        "semantic_context": context_call(config, tokens=3),
        "action_expert": action_call(config, context=3),
    }
    for graph, call in calls.items():
        counted = {linear.name for linear in call.linears if not (linear.name.startswith("embed") and graph[0] == "v")}
        assert counted == set(linear_layers(config, graph)) - ({"embed"} if graph[0] == "v" else set())


@pytest.mark.parametrize(("tokens", "scored"), [(1, 1), (4, 4), (128, MOST_ROWS)])
@pytest.mark.parametrize("graph", ["language_model", DECODE])
def test_a_call_projects_its_last_positions_onto_the_vocabulary(graph: str, tokens: int, scored: int) -> None:
    call, blind = (language_call(BIG, name, tokens=tokens, past=0) for name in (graph, PREFILL))
    head = next(linear for linear in call.linears if linear.name == "lm_head")
    assert head.tokens == scored
    assert call.workspace - blind.workspace == scored * BIG.language.vocab


@pytest.mark.slow
@pytest.mark.parametrize("name", ["orin", "cpu"])
def test_a_context_of_waypoints_has_three_tokens_and_belongs_to_the_tick(name: str) -> None:
    config = dataclasses.replace(BIG, action=dataclasses.replace(BIG.action, semantic_interface="waypoints"))
    made, by_kv = (plan(target(name), each, tokens=32) for each in (config, BIG))
    entries = made.to_dict()["per_graph"]
    tick, generation = ("vision_encoder", "action_expert", "semantic_context"), ("prefill", "decode")
    assert made.tick_alone.ms == pytest.approx(sum(entries[part]["ms"] for part in tick), abs=0.01)
    assert made.generation_alone.ms == pytest.approx(sum(entries[part]["ms"] for part in generation), abs=0.01)
    work = {"semantic_context": context_call(config, tokens=3), "action_expert": action_call(config, context=3)}
    for part, call in work.items():
        assert entries[part]["gflop"] == pytest.approx(call.flops() / 1e9, abs=1e-3)
    assert made.memory.caches < by_kv.memory.caches


@pytest.mark.parametrize("name", ["orin", "cpu"])
def test_guesses_shorten_decoding_and_the_semantic_states_age_alike_and_are_tagged_modelled(name: str) -> None:
    made = planned(name, tokens=40)
    with_guesses = made.to_dict()["speculation"]
    assert with_guesses["tagged"] == MODELLED and with_guesses["acceptance"] == 0.89
    share = with_guesses["generation_alone_ms"] / made.generation_alone.ms
    assert share < 1 and made.delay_s is not None
    assert with_guesses["delay_s"] == pytest.approx(made.delay_s * share, rel=1e-3)


def test_a_target_without_speculation_plans_none() -> None:
    assert planned("orin", "runtime.speculation=off", tokens=40).to_dict()["speculation"] is None


def test_counted_work_is_that_of_the_paper_size_model() -> None:
    """724 GFLOP an image, 839 a prompt of 1,100 tokens (counted independently when the runtimes were compared)."""
    assert vision_call(BIG).flops() == pytest.approx(724e9, rel=0.01)
    causal = language_call(BIG, PREFILL, tokens=1100, past=0)
    assert causal.flops() - causal.attention_flops / 2 == pytest.approx(839e9, rel=0.01)


@pytest.mark.parametrize(
    ("stage_name", "settings", "measured_ms", "tolerance"),
    [
        ("vision_encoder", ["graphs.vision_encoder.precision=fp32"], 3400, 0.15),
        ("prefill", ["graphs.language_model.precision=fp32"], 3993, 0.25),
        ("decode", ["graphs.language_model.precision=fp32"], 1000 / 8.8, 0.5),
        ("decode", ["graphs.language_model.decode.precision=int8-b128"], 1000 / 23.2, 0.25),
        ("action_expert", [], 16.1, 0.3),
        ("semantic_context", [], 40, 0.4),
    ],
)
def test_the_model_of_a_cpu_comes_near_what_was_measured_there(
    stage_name: str, settings: list[str], measured_ms: float, tolerance: float
) -> None:
    made = planned("cpu", *settings, tokens=32, text_tokens=1100 - 4 * BIG.frame_tokens)
    entry = made.to_dict()["per_graph"][stage_name]
    assert entry["tagged"] == MODELLED
    each = entry["ms"] / (32 if stage_name == "decode" else 1)
    assert each == pytest.approx(measured_ms, rel=tolerance)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ({"tokens": 5000}, "the model has room for 346"),
        ({"tokens": -1}, "the model has room for 346"),
        ({"text_tokens": 5000}, "the prompt of 6024 tokens exceeds the context of 1536"),
        ({"precisions": {"vision": FP32}}, "no graph 'vision'"),
    ],
)
def test_arguments_that_make_no_plan_are_refused(arguments: dict, line: str) -> None:
    with pytest.raises(PlanError, match=line):
        plan(target("orin"), BIG, **arguments)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["orin", "cpu"])
def test_a_person_sees_every_stage_and_the_verdict(name: str) -> None:
    console = Console(file=io.StringIO(), width=160)
    made = planned(name)
    console.print(plan_table(made))
    text = console.file.getvalue()
    assert all(s.stage in text for s in made.stages)
    assert ("verdict     fits" in text) == made.fits
    assert text.count(MODELLED) >= 1


@pytest.mark.parametrize(
    ("settings", "context", "line"),
    [
        ((), 4096, r"semantic_context\.profile\.T covers 1 to 1536, 1b needs 256 to 4096"),
        (("graphs.action_expert.profile.T=1,64,512",), 1536, r"action_expert\.profile\.T covers 1 to 512, 1b needs"),
        (("graphs.action_expert.profile.T=900,900,1536",), 1536, r"action_expert\.profile\.T covers 900 to 1536"),
    ],
)
def test_an_engine_that_the_context_would_outgrow_is_refused_before_anything_is_built(
    settings: tuple[str, ...], context: int, line: str
) -> None:
    config = dataclasses.replace(BIG, language=dataclasses.replace(BIG.language, max_context=context))
    with pytest.raises(PlanError, match=line) as refusal:
        plan(target("orin", *settings), config)
    assert "\n" not in str(refusal.value)
