"""Recipes: strict tables of numbers, settings on top of them, and the paper's variants."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import isfinite
from pathlib import Path

import pytest

from export.model.config import PRESETS
from sim_hil.benchmark.conditions.variants import VARIANTS as BENCHMARK_VARIANTS
from tools.train.config import checks, collect, encoder, imitate, rl, sft
from tools.train.config.checks import ranges_of
from tools.train.config.recipe import (
    STAGES,
    VARIANTS,
    Recipe,
    RecipeError,
    filled,
    load_recipe,
    recipe_names,
    stage_seed,
)

NANO = PRESETS["nano"]


@pytest.mark.parametrize("name", recipe_names())
def test_a_recipe_survives_being_written_down(name: str, tmp_path: Path) -> None:
    recipe = load_recipe(name)
    path = tmp_path / "recipe.toml"
    path.write_text(recipe.to_toml())
    assert load_recipe(str(path)) == recipe


def test_a_setting_changes_one_number_of_a_stage_and_leaves_its_neighbours() -> None:
    plain, changed = load_recipe("nano"), load_recipe("nano", ["sft.optim.lr=0.5", "seed=3", "dagger.rounds=0"])
    assert changed.sft == replace(plain.sft, optim=replace(plain.sft.optim, lr=0.5))
    assert changed.seed == 3 and changed.dagger.rounds == 0 and changed.rl == plain.rl


def test_a_setting_changes_the_share_of_one_kind_of_scenes() -> None:
    settings = ["sft.tours.kinds.office=0.5", "collect.kinds.corridor=1"]
    plain, changed = load_recipe("nano"), load_recipe("nano", settings)
    assert changed.sft.tours.kinds == {**plain.sft.tours.kinds, "office": 0.5}
    assert changed.collect.kinds == {"corridor": 1.0}


def test_a_setting_may_change_the_network() -> None:
    changed = load_recipe("nano", ["model.action.latency_aware=false"]).model
    assert changed == replace(NANO, action=replace(NANO.action, latency_aware=False))


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("sft.epoch=3", "did you mean epochs"),
        ("stf.epochs=3", "did you mean sft"),
        ("sft.epochs=many", "a whole number"),
        ("sft.epochs", "KEY=VALUE"),
        ("sft=3", "STAGE.field"),
        ("sft.epochs.x=1", r"epochs is a value \(\d+\), so no key is expected below it"),
        ("sft.tours.kinds.ofice=1", "did you mean office"),
        ("sft.tours.kinds.office=-1", "shares of 0 or more"),
        ("model.action.layer=3", "not a number of the model"),
        ("sft.epochs=0", r"\[sft\]"),
        ("seed=-1", "seed from 0"),
    ],
)
def test_an_unknown_setting_is_one_clear_line(setting: str, message: str) -> None:
    with pytest.raises(RecipeError, match=message) as caught:
        load_recipe("nano", [setting])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("schema = 2", "schema = 1"),
        ('schema = 1\nname = "a"\nseed = 1', "table \\[model\\]"),
        ('schema = 1\nname = "a"\nseed = 1\n[model]\npreset = "nano"\nlayers = 3', "unknown key 'layers'"),
        ('schema = 1\nname = "a"\nseed = 1\n[model]\npreset = "nano"\n[sfd]', "unknown key 'sfd'"),
        ('schema = 1\nname = "a"\nseed = 1\n[model]\npreset = "nano"\n[sft]\nepoch = 1', "unknown key 'epoch'"),
        ('schema = 1\nname = "a"\nseed = "b"\n[model]\npreset = "nano"', "an integer as seed"),
        ('schema = 1\nname = ""\nseed = 1\n[model]\npreset = "nano"', "expected a name"),
        ("schema =", "recipe.toml"),
    ],
)
def test_a_wrong_recipe_is_one_clear_line(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "recipe.toml"
    path.write_text(text)
    with pytest.raises(RecipeError, match=message) as caught:
        load_recipe(str(path))
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["nono", "nowhere.toml", "recipe.json"])
def test_a_missing_recipe_is_reported(name: str) -> None:
    with pytest.raises(RecipeError, match=name):
        load_recipe(name)


@dataclass(frozen=True)
class Inner:
    a: int = 1
    b: int = 2


@dataclass(frozen=True)
class Outer:
    inner: Inner = field(default_factory=lambda: Inner(a=5))
    c: int = 3


def test_a_nested_table_is_filled_with_its_own_defaults() -> None:
    assert filled(Outer(), {"inner": {"b": 7}}) == {"inner": {"a": 5, "b": 7}, "c": 3}


def test_stages_have_seeds_of_their_own_that_follow_from_the_runs() -> None:
    recipe = Recipe("r", 1, NANO)
    seeds = {stage_seed(recipe, stage) for stage in ("collect", "sft", "imitate")}
    assert len(seeds) == 3 and stage_seed(replace(recipe, name="other"), "sft") in seeds
    assert stage_seed(replace(recipe, seed=2), "sft") not in seeds


@pytest.mark.slow
def test_a_variant_of_the_benchmark_is_trained_as_the_benchmark_checks_it() -> None:
    fields = {"head", "layers", "latency_aware", "motion_offset", "semantic_interface"}
    for name, wanted in BENCHMARK_VARIANTS.items():
        action = load_recipe("nano", VARIANTS[name]).model.action
        assert {key: getattr(action, key) for key in fields} == {key: wanted[key] for key in fields}
        assert action.steps * action.step_s == pytest.approx(wanted["horizon_s"])


CONFIGS = [*STAGES.values(), *(getattr(module, name) for module in (checks, collect, encoder, imitate, rl, sft)
           for name in vars(module) if name.endswith("Config"))]  # fmt: skip


@pytest.mark.parametrize("kind", sorted(set(CONFIGS), key=lambda kind: kind.__name__), ids=lambda kind: kind.__name__)
def test_numbers_outside_their_range_are_refused_by_name(kind: type) -> None:
    for name, allowed in ranges_of(kind).items():
        step = 1 if isinstance(getattr(kind(), name), int) else 0.01
        below, above = allowed.low - step * (not allowed.above), allowed.high + step * (not allowed.below)
        for value in (below, *((above,) if isfinite(above) else ())):
            with pytest.raises(ValueError, match=f"{name}: expected a number"):
                kind(**{name: value})


@pytest.mark.parametrize(
    ("kind", "changed", "message"),
    [
        (collect.CollectConfig, {"typical_drift_share": 0.7, "severe_drift_share": 0.4}, "shares"),
        (collect.CollectConfig, {"jpeg_quality_min": 96}, "jpeg_quality"),
        (collect.CollectConfig, {"kinds": {"castle": 1.0}}, "castle"),
        (collect.TourConfig, {"kinds": {"office": 0.0}}, "one of them positive"),
        (encoder.FramesConfig, {"kinds": ("castle",)}, "kinds"),
        (encoder.FramesConfig, {"kinds": ("corridor",)}, "held"),
        (encoder.FramesConfig, {"count": 60_000, "per_scene": 1}, "scenes"),
        (encoder.AugmentConfig, {"jpeg_quality_min": 96}, "jpeg_quality"),
        (imitate.DelayConfig, {"low_s": 3.0, "high_s": 3.0}, "low_s < high_s"),
        (imitate.DelayConfig, {"near_share": 0.5, "near_s": 11.0}, "near_s"),
        (imitate.SampleConfig, {"cut_text": 0.4, "prompt_only": 0.2, "text_only": 0.5}, "together 1 at most"),
        (imitate.KvConfig, {"every": 15}, "multiple of"),
        (imitate.ImitateEvalConfig, {"edges_s": (0.0, 2.0, 2.0)}, "rising"),
        (imitate.ImitateConfig, {"batch": 6}, "multiple of"),
        (imitate.ImitateConfig, {"policy": "rl"}, "point-goal"),
        (rl.RlConfig, {"rotation": ("castle",)}, "castle"),
        (rl.RlConfig, {"log_std": (-1.0, 2.0)}, "log_std"),
        (rl.EvaluateConfig, {"drift": "wild"}, "drift"),
        (sft.DrawConfig, {"before_min_s": 5.0}, "before_min_s"),
        (sft.EvalConfig, {"gap_s": 1.5}, "whole seconds"),
    ],
)  # fmt: skip
def test_numbers_that_contradict_each_other_are_refused(kind: type, changed: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        kind(**changed)
