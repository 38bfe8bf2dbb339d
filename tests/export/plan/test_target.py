"""Targets are data: every key is known, every figure names its source, and settings are typed."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from export.targets.file import load_target, parse_target, with_settings
from export.targets.sections import MEASURED, MODELLED, Figure, TargetError

PAIR = ("language_model.prefill", "language_model.decode")


def content(name: str = "cpu") -> dict[str, Any]:
    return copy.deepcopy(load_target(name).to_dict())


def edited(change: Callable[[dict[str, Any]], object], name: str = "cpu") -> dict[str, Any]:
    tables = content(name)
    change(tables)
    return tables


def figures(value: object) -> list[Figure]:
    if isinstance(value, Figure):
        return [value]
    if dataclasses.is_dataclass(value):
        return [f for field in dataclasses.fields(value) for f in figures(getattr(value, field.name))]
    return [f for item in value.values() for f in figures(item)] if isinstance(value, dict) else []


@pytest.mark.parametrize("name", ["cpu", "orin", "rtx4060"])
def test_a_target_read_back_from_its_own_tables_is_the_same(name: str) -> None:
    target = load_target(name)
    assert parse_target(target.to_dict(), name) == target


@pytest.mark.parametrize("name", ["cpu", "orin", "rtx4060"])
def test_every_figure_names_its_source_and_whether_it_was_measured(name: str) -> None:
    target = load_target(name)
    found = figures(target)
    assert len(found) > 15
    assert all(figure.source.strip() and figure.tag in (MODELLED, MEASURED) for figure in found)


@pytest.mark.parametrize("name", ["orin", "rtx4060"])
def test_targets_without_a_device_have_no_measured_figure(name: str) -> None:
    target = load_target(name)
    assert {figure.tag for figure in figures(target)} == {MODELLED}
    assert not target.measured


@pytest.mark.parametrize("name", ["cpu", "orin", "rtx4060"])
@pytest.mark.parametrize("model", ["nano", "1b"])
def test_every_graph_has_a_provider_and_a_gate_for_both_models(name: str, model: str) -> None:
    target = load_target(name, model)
    for graph in target.graph_names:
        assert target.provider(graph).compute.roof(target.graphs[graph].precision)
        assert target.gate(graph).inputs >= 2


def test_an_unknown_target_is_refused_with_the_names() -> None:
    with pytest.raises(TargetError, match="expected one of: cpu, orin, rtx4060"):
        load_target("thor")


def test_a_user_may_bring_a_target_file(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(
        (Path(__file__).parents[3] / "export/targets/cpu.toml").read_text().replace('"cpu"\n', '"mine"\n', 1)
    )
    assert load_target(str(path)).name == "mine"


@pytest.mark.parametrize("text", ["schema = ", "\xff", ""])
def test_a_file_that_is_not_a_target_is_refused_by_name(tmp_path: Path, text: str) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="latin-1")
    with pytest.raises(TargetError, match=r"mine\.toml: (not TOML|schema must be 2)"):
        load_target(str(path))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda t: t.pop("roofline"), "key 'roofline' is missing"),
        (lambda t: t["power"].update(moed="x"), "unknown key 'moed'; did you mean mode"),
        (lambda t: t["power"].update(mode="MAXN"), "power.mode 'MAXN' is not known; expected one of: default"),
        (lambda t: t["runtime"].update(tick_period_ms="fast"), "expected a whole number, found 'fast'"),
        (lambda t: t["runtime"].update(tick_period_ms=True), "expected a whole number, found True"),
        (lambda t: t["runtime"].update(kv_dtype="int2"), "kv_dtype 'int2' is not known"),
        (lambda t: t["runtime"].update(prefill_chunk_tokens=99999999), "tokens 99999999 must be 1 to 8192"),
        (lambda t: t["runtime"].update(max_new_tokens=8193), "max_new_tokens 8193 must be 1 to 8192"),
        (lambda t: t["runtime"].update(tick_period_ms=0), "tick_period_ms 0 must be 20 to 150"),
        (lambda t: t["runtime"].update(tick_period_ms=1), "tick_period_ms 1 must be 20 to 150"),
        (lambda t: t["runtime"].update(tick_period_ms=151), "tick_period_ms 151 must be 20 to 150"),
        (lambda t: t["runtime"].update(frame_offsets_s=[0.0, 0.001]), "must grow by a tick of 0.1 s or more"),
        (lambda t: t["runtime"].update(control_priority=100), "control_priority 100 must be 0 to 59"),
        (
            lambda t: t["runtime"].update(control_priority=60),
            "control_priority 60 must be 0 to 59, below the bridge's 60",
        ),
        (lambda t: t["runtime"].update(control_cores=[-1]), r"control_cores \[-1\] must be 0 to 1023"),
        (
            lambda t: t["runtime"].update(control_cores=[1, 2], reasoning_cores=[2]),
            r"cores \[2\] are in control_cores and in",
        ),
        (lambda t: t["runtime"].update(frame_offsets_s=[3.0, 6.0]), "must begin with 0, the newest frame"),
        (lambda t: t["runtime"].update(max_delay_s=600.0), "max_delay_s 600.0 must be 0.1 to 60 s"),
        (lambda t: t["power"].update(budget_w=0.01), "budget_w 0.01 must be 0.1 to 1000 W"),
        (lambda t: t["runtime"].update(frame_offsets_s=[]), "names 0 frames, expected 1 to 16"),
        (lambda t: t["runtime"].update(frame_offsets_s=[0.0] * 17), "names 17 frames, expected 1 to 16"),
        (lambda t: t["gates"][PAIR[0]].update(top1=0.8), "language_model.prefill chooses no token; expected it of"),
        (lambda t: t["gates"]["vision_encoder"].update(top1=0.8), "vision_encoder chooses no token"),
        (lambda t: t["graphs"][PAIR[0]].update(form="plain"), "prefill.form 'plain': .* expected 'fused'"),
        (
            lambda t: t["graphs"]["action_expert"].update(form="plain", precision="int8-b32"),
            "the plain form has no 'int8-b32', blocks need the form 'fused'",
        ),
        (lambda t: t["graphs"]["vision_encoder"].update(precision="int5"), "precision 'int5' is not known"),
        (lambda t: t["graphs"]["vision_encoder"].update(provider="gpu"), r"provider 'gpu' is not in \[providers\]"),
        (lambda t: t["graphs"]["vision_encoder"].update(candidates=["int8", "fp32"]), "from most to least exact"),
        (lambda t: t["graphs"].pop("action_expert"), "graphs are .*expected"),
        (lambda t: t["graphs"].pop(PAIR[0]), "the pair language_model.prefill and language_model.decode"),
        (lambda t: t["gates"].pop("action_expert"), "gates.action_expert is missing"),
        (lambda t: t["gates"].pop("task"), "gates.task is missing"),
        (lambda t: t["gates"].update(extra=t["gates"]["vision_encoder"]), "gates.extra: no such graph"),
        (lambda t: t["roofline"]["memory_gbps"].update(source=" "), "source is empty"),
        (lambda t: t["roofline"]["memory_gbps"].update(value=0), "memory_gbps must be positive"),
        (lambda t: t["roofline"]["compute_efficiency"].pop("decode"), r"lacks \['decode'\]"),
        (lambda t: t["measured"][0].update(tokens_per_s=2.0), "give either ms or tokens_per_s"),
        (lambda t: t["models"]["nano"]["graphs"]["language_model"].update(form="plane"), "did you mean plain"),
        (lambda t: t["models"]["nano"].update(power={}), "unknown key 'power'"),
        (lambda t: t.update(schema=1), "schema must be 2"),
        (lambda t: t.update(power=3), "power: expected a table, found 3"),
    ],
)
def test_a_wrong_table_is_refused_with_one_line(change: Callable[[dict[str, Any]], object], line: str) -> None:
    with pytest.raises(TargetError, match=line) as refusal:
        parse_target(edited(change), "x.toml")
    assert str(refusal.value).startswith("x.toml")
    assert "\n" not in str(refusal.value)


def test_a_budget_cannot_be_planned_for_without_the_power_of_every_mode() -> None:
    with pytest.raises(TargetError, match=r"modes \['15W'\] have no busy_w"):
        parse_target(edited(lambda t: t["power"]["modes"]["15W"].pop("busy_w"), "orin"), "x.toml")


def test_settings_are_typed_by_their_field() -> None:
    target = with_settings(
        load_target("orin"),
        [
            "graphs.language_model.precision=int8-b32",
            "graphs.vision_encoder.overrides.blocks.3.fc1=fp32",
            "graphs.action_expert.profile.T=1,64,512",
            "graphs.vision_encoder.threads=2",
            "providers.cuda.options.gpu_mem_limit=4000000000",
            "power.mode=15W",
            "power.budget_w=14.5",
            "gates.task.waypoint_cm=3",
            "runtime.frame_offsets_s=0, 3",
            "runtime.enforce_plan=false",
            "roofline.memory_gbps=90",
        ],
    )
    assert target.graphs["language_model"].precision == "int8-b32"
    assert target.precision("vision_encoder").of("blocks.3.fc1") == "fp32"
    assert target.graphs["action_expert"].profile == {"T": (1, 64, 512)}
    assert target.graphs["vision_encoder"].threads == 2
    assert target.providers["cuda"].options["gpu_mem_limit"] == "4000000000"
    assert (target.power.mode, target.power.budget_w) == ("15W", 14.5)
    assert target.task_gate.waypoint_cm == 3.0
    assert target.runtime.frame_offsets_s == (0.0, 3.0)
    assert not target.runtime.enforce_plan
    assert target.roofline.memory_gbps == Figure(90.0, "set on the command line")


def test_a_setting_of_the_language_model_reaches_both_halves_of_a_pair() -> None:
    target = with_settings(load_target("cpu"), ["graphs.language_model.precision=fp32"])
    assert [target.graphs[name].precision for name in PAIR] == ["fp32", "fp32"]


def test_a_pair_is_held_to_the_tokens_of_the_half_that_chooses_them() -> None:
    target = with_settings(load_target("cpu"), ["gates.language_model.top1=0.9"])
    assert [target.gate(name).top1 for name in PAIR] == [None, 0.9]
    shared = {**target.to_dict(), "models": {}}
    shared["gates"] = {k: v for k, v in shared["gates"].items() if k != PAIR[0]}
    shared["gates"]["language_model"] = shared["gates"].pop(PAIR[1])
    assert [parse_target(shared, "x.toml").gate(name).top1 for name in PAIR] == [None, 0.9]


@pytest.mark.parametrize(
    ("setting", "line"),
    [
        ("graphs.vison_encoder.precision=int8", "did you mean vision_encoder"),
        ("power.mod=25W", "did you mean mode"),
        ("gates.task.waypoint_m=3", "did you mean waypoint_cm"),
        ("graphs.language_model.precison=int8", "did you mean precision"),
        ("zzz.qqq=1", "expected one of: arch, description"),
        ("runtime.tick_period_ms=soon", "expected a whole number, found 'soon'"),
        ("runtime.enforce_plan=maybe", "expected true or false, found 'maybe'"),
        ("roofline.memory_gbps=lots", "expected a finite number, found 'lots'"),
        ("device.memory_gib=inf", "expected a finite number, found inf"),
        ("runtime.max_delay_s=nan", "expected a finite number, found nan"),
        ("runtime=3", "is a table; name one of its keys"),
        ("power.mode.x=1", "mode is not a table"),
        ("power.mode=9W", "expected one of: default"),
        ("measured=1", "cannot be set"),
        ("models.nano.graphs=1", "cannot be set"),
        ("power.mode", "expected KEY=VALUE"),
        ("=1", "expected KEY=VALUE"),
    ],
)
def test_a_wrong_setting_is_refused_with_one_line_and_near_names(setting: str, line: str) -> None:
    with pytest.raises(TargetError, match=line) as refusal:
        with_settings(load_target("cpu"), [setting])
    assert "\n" not in str(refusal.value)


@pytest.mark.slow
def test_an_engine_gets_a_profile_for_every_free_axis_and_only_what_it_can_run() -> None:
    inputs = [{"name": "context_keys", "shape": [6, 8, 64, "T"]}, {"name": "state", "shape": [1, 3]}]
    session = load_target("orin").session("action_expert", inputs)
    assert session["engine"] is True
    assert session["options"]["trt_profile_min_shapes"] == "context_keys:6x8x64x1"
    assert session["options"]["trt_profile_max_shapes"] == "context_keys:6x8x64x1536"
    with pytest.raises(TargetError, match=r"graphs.action_expert.profile.S is missing"):
        load_target("orin").session("action_expert", [{"name": "ids", "shape": [1, "S"]}])
    with pytest.raises(TargetError, match="TensorrtExecutionProvider has no kernel for precision 'int4-b32'"):
        with_settings(load_target("orin"), ["graphs.action_expert.precision=int4-b32"])
    with pytest.raises(TargetError, match="TensorrtExecutionProvider takes plain"):
        with_settings(load_target("orin"), ["graphs.action_expert.form=fused"])


def test_the_encoder_may_run_on_openvino_in_the_form_that_it_reads() -> None:
    setting = "graphs.vision_encoder.provider=openvino"
    made = with_settings(load_target("cpu", "1b"), [setting, "graphs.vision_encoder.form=plain"])
    assert made.provider("vision_encoder").name == "OpenVINOExecutionProvider"
    assert not made.provider("vision_encoder").engine
    with pytest.raises(TargetError, match="OpenVINOExecutionProvider takes plain"):
        with_settings(load_target("cpu", "1b"), [setting])
